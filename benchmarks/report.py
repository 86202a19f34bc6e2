"""docs/PERFORMANCE.md from the committed records: its tables, between markers, and its plots.

    python -m benchmarks.report

Text outside the markers is written by hand.
"""

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from benchmarks import record, rounds
from benchmarks.plots import PICTURES, draw
from benchmarks.record import Record
from benchmarks.rounds import Row, Spread
from gvz.core.errors import ConfigError

PAGE = record.ROOT / "docs" / "PERFORMANCE.md"
PLOTS = record.ROOT / "docs" / "images"
GOALS = {
    1: ("actors", "Actor pool against the engine and peers"),
    2: ("acting", "The full network acting"),
    3: ("transport", "Ring and broadcast queue"),
    4: ("sum_tree", "Sum tree"),
    5: ("learner_update", "Learner step"),
    6: ("whole", "Learner and actors together"),
    7: ("growth", "Growth"),
    8: ("startup", "Start-up"),
    9: ("encoders", "Encoders"),
    10: ("vector", "Vector environment"),
    11: ("placement", "Placement"),
    12: ("gpu", "GPU"),
    13: ("cluster", "Actor hosts"),
    14: ("augmentations", "Augmentations"),
}
"""number -> (benchmark, title); a benchmark may have figures and no goal"""
RATES = ("decisions", "frames", "updates", "samples")


def number(value: float) -> str:
    """Three significant digits, with separators of thousands."""
    if value == 0:
        return "0"
    digits = f"{value:.3g}"
    return f"{float(digits):,.0f}" if abs(value) >= 100 else f"{float(digits):g}"


def cell(spread: Spread | None) -> str:
    """Median [min, max]; a dash if there is no such rate, the value alone if it was measured once."""
    if spread is None:
        return "-"
    if len(spread["values"]) == 1:
        return number(spread["median"])
    return f"{number(spread['median'])} [{number(spread['min'])}, {number(spread['max'])}]"


_CALLED = {"peak memory off the bill": "difference between peak memory and the memory announced at the start"}
"""name of a goal in the records -> on the page"""


def goals_table(records: Sequence[Record]) -> str:
    """All goals: the bound, the measurement, and the verdict."""
    lines = ["| goal | | wanted | measured | |", "|---|---|---|---|---|"]
    for goal, (benchmark, title) in GOALS.items():
        mine = [r for r in records if r.benchmark == benchmark]
        rows = [(r, row) for r in mine for row in r.rows if row["kind"] == "goal"]
        head = f"[{goal}. {title}](#{goal}-{title.lower().replace(' ', '-')})"
        if not rows and not mine:
            lines.append(f"| {head} | | | not measured | |")
        for i, (made, row) in enumerate(rows):
            where = f" ({made.variant})" if made.variant else ""
            verdict = "met" if rounds.met(row) else "**missed**"
            unit = f" {row['unit']}" if row["unit"] else ""
            name = _CALLED.get(row["name"], row["name"])
            lines.append(
                f"| {'' if i else head} | {name}{where} | {_bound(row)}{unit} | {cell(row)}{unit} | {verdict} |"
            )
    return "\n".join(lines)


def section(records: Sequence[Record], benchmark: str) -> str:
    """Everything the records of one benchmark hold."""
    mine = [r for r in records if r.benchmark == benchmark]
    if not mine:
        return f"There is no record of this benchmark; `python -m benchmarks {benchmark}` makes one."
    parts = [part for made in mine for part in _parts(made)]
    if benchmark in PICTURES and any(not made.variant for made in mine):
        which = "the figures above" if len(mine) == 1 else "the first of the records above"
        parts.append(f"![{benchmark}: {which} as a plot](images/{PICTURES[benchmark]})")
    return "\n\n".join(parts)


def _parts(made: Record) -> Iterator[str]:
    machine = made.machine
    devices = "" if made.device == "cpu" else f", {', '.join(machine['devices'])}"
    packages = ", ".join(f"{name} {made.versions[name]}" for name in ("jax", "vizdoom", "numpy", "python"))
    yield (
        f"*{made.date} UTC, commit {made.commit}, `{made.command}`, {made.seconds:.0f} s; {machine['cpu']}, "
        f"{machine['cores']} cores, {machine['memory_bytes'] / 2**30:.0f} GiB{devices}; load at the start "
        f"{machine['load'][0]:g}; {packages}.*"
    )
    rates = [row for row in made.rows if row["kind"] == "rates"]
    if rates:
        head = "| | decisions/s | frames/s | gradient steps/s | samples/s |\n|---|---|---|---|---|\n"
        yield head + "\n".join(
            f"| {row['name']} | {' | '.join(cell(row[f'{unit}_per_s']) for unit in RATES)} |" for row in rates
        )
    single = [row for row in made.rows if row["kind"] == "measured" and row["x"] is None]
    if single:
        yield "| | measured | |\n|---|---|---|\n" + "\n".join(
            f"| {row['name']} | {cell(row)} | {row['unit']} |" for row in single
        )
    for name, points in rounds.curves(made.rows).items():
        xs = " | ".join(f"{row['x']:,.0f}" for row in points)
        values = " | ".join(cell(row) for row in points)
        yield (
            f"| {name}, {points[0]['x_unit']} | {xs} |\n|{'---|' * (len(points) + 1)}\n"
            f"| {points[0]['unit']} | {values} |"
        )
    missing = [f"- {row['name']}: {row['why']}." for row in made.rows if row["kind"] == "absent"]
    if missing:
        yield "Not measured:\n\n" + "\n".join(missing)


def write_page(page: str, records: Sequence[Record]) -> str:
    """The page with the records' tables between its markers.

    Raises:
        ConfigError: a marker is missing.
    """
    command = "python -m benchmarks.report"
    page = between(page, PAGE, "goals", goals_table(records), command)
    for benchmark, _ in GOALS.values():
        page = between(page, PAGE, benchmark, section(records, benchmark), command)
    return page


def between(page: str, file: Path, name: str, text: str, command: str) -> str:
    """A page with `text` between the markers of `name`, which `command` writes.

    Raises:
        ConfigError: a marker is missing in the page, whose file is `file`.
    """
    begin, end = f"<!-- {name}: written by `{command}` -->", f"<!-- end of {name} -->"
    head, found_begin, rest = page.partition(begin)
    _, found_end, tail = rest.partition(end)
    if not found_begin or not found_end:
        raise ConfigError(f"{file}: the lines {begin!r} and {end!r} are missing; what is measured goes between them")
    return f"{head}{begin}\n\n{text}\n\n{end}{tail}"


def _bound(row: Row) -> str:
    return f">= {row['at_least']:,g}" if row["at_least"] is not None else f"<= {row['at_most']:,g}"


def main() -> int:
    """Writes the page and its plots; returns the exit code."""
    try:
        records = record.read_all()
        PAGE.write_text(write_page(PAGE.read_text(), records))
    except ConfigError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    for file in (PAGE, *draw(records, PLOTS)):
        print(Path(file).relative_to(record.ROOT))
    return 0


if __name__ == "__main__":
    sys.exit(main())
