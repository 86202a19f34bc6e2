"""Sections on the runs themselves: time and rates, configuration, raw records and videos."""

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import polars as pl

from gvz.core.files import files_below
from gvz.evaluation.dataset import evaluation_files
from gvz.reports.curves import SHARE_EPISODES, share_curve
from gvz.reports.document import Block, Figure, Link, Section, Table, count, missing, words
from gvz.reports.draw import draw_curves
from gvz.reports.experiment_section import what_id
from gvz.reports.results import Results
from gvz.reports.runs import Run, training_time_s

_SEVERAL_VALUES = (
    "Where runs of one agent differ, the value of the most runs is the first. Scenarios stand beside another value if "
    "none of their runs has the first."
)
_NOT_SHOWN = ("seed", "run_dir", "tasks", "scenario", "training_set", "name")
_VIDEOS = (".mp4", ".gif", ".webp", ".webm")


def run_sections(results: Results, out: Path) -> list[Section]:
    """What there is to say of the runs; nothing without any."""
    sections = []
    if results.runs:
        tables = [_rates(results.runs)]
        if any(run.starts for run in results.runs):
            tables.append(_machines(results.runs))
        sections.append(Section(id="runs", title="Time and throughput", blocks=(Block(tables=tuple(tables)),)))
        sections.append(
            Section(id="configuration", title="Configuration", blocks=(Block(tables=(_configurations(results),)),))
        )
    ids = [run.id for run in results.runs]
    if figures := [_shares(run, ids, out) for run in results.runs if run.curriculum != "fixed"]:
        text = "Scores of these tasks over time are among the curves of their scenarios."
        sections.append(
            Section(id="curriculum", title="Curriculum", blocks=(Block(text=(text,), figures=tuple(figures)),))
        )
    return [*sections, Section(id="records", title="Raw records", blocks=(_links(results, out),))]


def _shares(run: Run, ids: Sequence[str], out: Path) -> Figure:
    """Which tasks were played when. `ids` are those of all runs."""
    curves = [share_curve(run, task) for task in run.tasks]
    caption = f"{run.id}, curriculum {run.curriculum}: share of each task in the last {SHARE_EPISODES} episodes."
    id = f"shares_{what_id(run.id, ids)}"
    return draw_curves(out, id, run.id, curves, caption, what="share of episodes, %")


def _rates(runs: Sequence[Run]) -> Table:
    rows = []
    for run in runs:
        if run.metrics.is_empty():
            rows.append((words(run.id), *[missing("no metrics")] * 7))
            continue
        last = run.metrics.tail(1).row(0, named=True)
        medians = run.metrics.select(
            pl.median("learner/updates_per_s", "actors/decisions_per_s", "actors/frames_per_s")
        ).row(0)
        rows.append(
            (
                words(run.id),
                words(f"{last['num_updates']:,} of {run.total_updates:,}"),
                words("-" if last["actors/env_steps"] is None else f"{last['actors/env_steps']:,}"),
                words(_hours(training_time_s(run.metrics))),
                words("-" if run.processor_s is None else f"{run.processor_s:,.0f}"),
                *(words("-" if rate is None else f"{rate:,.0f}") for rate in medians),
            )
        )
    return Table(
        id="throughput",
        caption="Wall-clock time of training (pauses between a stop and the next start do not count), processor time "
        "of learner, actors and games together, and median rates.",
        columns=(
            *("run", "gradient steps", "env steps", "hours:minutes:seconds", "processor seconds"),
            *("updates/s", "decisions/s", "frames/s"),
        ),
        rows=tuple(rows),
    )


def _machines(runs: Sequence[Run]) -> Table:
    """Every machine with its software as a row; a run that was resumed elsewhere counts on both."""
    trained: dict[tuple[str, ...], dict[str, None]] = {}
    for run in runs:
        for cells in dict.fromkeys(map(_machine, run.starts)) or [("-",) * 6]:
            trained.setdefault(cells, {})[run.id] = None
    return Table(
        id="machines",
        caption="What the runs were trained on and with; `+changes`: the checkout differed from the commit.",
        columns=("runs", "processor", "cores", "memory", "devices", "commit", "versions"),
        rows=tuple(
            (words(", ".join(names) if len(names) <= 3 else count(len(names), "run")), *map(words, cells))
            for cells, names in trained.items()
        ),
    )


def _machine(start: dict[str, Any]) -> tuple[str, ...]:
    """The cells of a row of starts.jsonl."""
    memory_bytes, versions = start.get("memory_bytes"), start.get("versions") or {}
    return (
        f"{start.get('cpu', '-')}, {start.get('system', '-')}",
        str(start.get("cores", "-")),
        "-" if memory_bytes is None else f"{memory_bytes / 2**30:.0f} GiB",
        ", ".join(map(str, start.get("devices") or ["-"])),
        str(start.get("commit") or "-"),
        ", ".join(f"{name} {number}" for name, number in versions.items()),
    )


def _hours(seconds: float) -> str:
    if not math.isfinite(seconds):
        return "-"
    minutes, seconds = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02}:{seconds:02}"


def _configurations(results: Results) -> Table:
    """Every field as a row, every agent as a column; without seeds and directories; rows that differ come first."""
    agents: dict[str, list[tuple[Run, dict[str, Any]]]] = {}
    for run in results.runs:
        flat = {name: value for name, value in run.settings.items() if name not in _NOT_SHOWN}
        agents.setdefault(results.agents[str(run.path)], []).append((run, flat))
    fields = list(dict.fromkeys(field for of_agent in agents.values() for _, flat in of_agent for field in flat))
    rows = [(words(field), *(words(_values(field, of_agent)) for of_agent in agents.values())) for field in fields]
    differ = [row for row in rows if len({cell.text for cell in row[1:]}) > 1]
    return Table(
        id="configurations",
        caption="Configuration of each agent" + (", what differs first." if len(agents) > 1 else "."),
        columns=("field", *agents),
        rows=(*differ, *(row for row in rows if row not in differ)),
        notes=(_SEVERAL_VALUES,) if any(len(of_agent) > 1 for of_agent in agents.values()) else (),
    )


def _values(field: str, runs: Sequence[tuple[Run, dict[str, Any]]]) -> str:
    """ "0.95; 0.98 (health_gathering)": the field's values in an agent's runs, that of the most runs first."""
    found: dict[str, list[Run]] = {}
    for run, flat in runs:
        if field in flat:
            found.setdefault(str(flat[field]), []).append(run)
    texts, usual = [], set()
    for value, of_value in sorted(found.items(), key=lambda pair: -len(pair[1])):
        scenarios = dict.fromkeys(scenario for run in of_value for scenario in run.scenarios)
        usual = usual or set(scenarios)
        texts.append(value if usual & scenarios.keys() else f"{value} ({', '.join(scenarios)})")
    return "; ".join(texts) if texts else "-"


def _links(results: Results, out: Path) -> Block:
    """Every file that the report was made from, and the videos in the same directories."""
    files = evaluation_files(results.paths)
    for run in results.runs:
        files += [file for name in ("config.json", "metrics", "episodes") for file in sorted(run.path.glob(f"{name}*"))]
    for path in results.paths:
        files += [file for file in files_below(path, "*") if file.suffix in _VIDEOS]
    links = [Link(text=str(file), target=os.path.relpath(file.resolve(), out.resolve())) for file in files]
    text = "Every number above can be computed again from these files (see docs/REPORTS.md)."
    return Block(text=(text,), links=tuple(links))
