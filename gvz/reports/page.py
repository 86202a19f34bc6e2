"""A report from results directories: reads, computes, draws, writes."""

import platform
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

from gvz.core.errors import ConfigError
from gvz.reports.abstract import MOST_NAMES, caveats, what_was_run, who_has_more
from gvz.reports.document import Block, Document, Section
from gvz.reports.experiment_section import experiment_section
from gvz.reports.joint_section import joint_sections
from gvz.reports.results import read_results
from gvz.reports.run_section import run_sections
from gvz.reports.scenario_section import scenario_sections
from gvz.reports.write import leftovers, write_document

_PACKAGES = ("gvizdoom", "vizdoom", "jax", "numpy", "polars", "matplotlib")


def make_report(paths: Sequence[Path], out: Path, title: str | None = None) -> tuple[list[Path], tuple[str, ...]]:
    """Makes the report of some results directories, run directories or record files.

    Args:
        paths: what to report on, together.
        out: directory for report.html, report.md, tables/ and figures/.
        title: default: the names of `paths`.

    Returns: the files written, figures aside; and what could not be read, is missing, or is of an earlier report.

    Raises:
        ConfigError: a path does not exist, there is nothing in any of them, `out` cannot be written, or two of the
            paths are results of one experiment.
    """
    results = read_results(paths)
    if results.episodes.is_empty() and not results.runs:
        found = "".join(f"\n  {problem}" for problem in results.problems)
        raise ConfigError(
            f"report: nothing to report in {', '.join(map(str, paths))}; want run directories, results of "
            f"`gvz experiment run`, or record files of `gvz evaluate`{found}"
        )
    names = [asked.experiment.name for asked in results.asked]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ConfigError(
            f"report: more than one of the paths has results of {', '.join(twice)}; report them one by one"
        )
    try:
        (out / "figures").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"--out: {out} cannot be written: {error.strerror}") from error
    sections = [experiment_section(results, asked, out) for asked in results.asked]
    sections += [*joint_sections(results, out), *scenario_sections(results, out), *run_sections(results, out)]
    if results.problems:
        text = ("What could not be read or is not there. Everything else was.", *results.problems)
        sections.append(Section(id="problems", title="Problems", blocks=(Block(text=text),)))
    versions = ", ".join(f"{name} {version(name)}" for name in _PACKAGES)
    document = Document(
        title=title or "Report on " + ", ".join(path.resolve().name for path in paths),
        abstract=(*what_was_run(results), *who_has_more(results)),
        warnings=tuple(caveats(results)),
        sections=tuple(sections),
        out=out,
        made_with=f"This report was made with Python {platform.python_version()}, {versions}.",
    )
    files, problems = write_document(document), results.problems
    if others := [file.name for file in leftovers(document)]:
        names = ", ".join(others[:MOST_NAMES]) + (f" and {len(others) - MOST_NAMES} more" * (len(others) > MOST_NAMES))
        problems += (f"{out}: holds tables or figures that are not of this report: {names}; they are left as they are",)
    return files, problems
