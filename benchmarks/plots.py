"""The plots of docs/PERFORMANCE.md, drawn from records."""

from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from benchmarks.record import Record
from benchmarks.rounds import Row, Spread, curves

PICTURES = {
    "actors": "performance_actors.png",
    "learner_update": "performance_learner.png",
    "growth": "performance_growth.png",
}
"""benchmark -> the plot of its record of a CPU and the released engine, in docs/images"""
RATE_OF = {"actors": ("decisions_per_s", "decisions/s"), "learner_update": ("updates_per_s", "gradient steps/s")}


def draw(records: Sequence[Record], directory: Path) -> list[Path]:
    """Draws the plots of all records of a CPU and the released engine; returns the files."""
    files = []
    for made in records:
        if made.variant or made.benchmark not in PICTURES:
            continue
        files.append(directory / PICTURES[made.benchmark])
        if made.benchmark == "growth":
            figure = growth(made.rows)
        else:
            quantity, unit = RATE_OF[made.benchmark]
            rates = [row for row in made.rows if row["kind"] == "rates"]
            figure = _bars([(row["name"], row[quantity]) for row in rates], unit)
        figure.savefig(files[-1], dpi=120, metadata={"Software": None})
    return files


def _bars(bars: Sequence[tuple[str, Spread]], unit: str) -> Figure:
    """One bar each, with its range over the rounds."""
    figure = Figure(figsize=(8.0, 0.9 + 0.32 * len(bars)), layout="constrained")
    axes = figure.subplots()
    for place, (name, spread) in enumerate(bars):
        low, high = spread["median"] - spread["min"], spread["max"] - spread["median"]
        ours = any(word in name for word in ("actor pool", "learner"))
        axes.barh(place, spread["median"], xerr=[[low], [high]], color="C0" if ours else "0.7")
    axes.set_yticks(range(len(bars)), [name for name, _ in bars])
    axes.invert_yaxis()
    axes.set(xlabel=f"{unit}: median, with min and max of the rounds")
    return figure


def growth(measured: Sequence[Row]) -> Figure:
    """One panel for each growing size; both axes are logarithmic, so linear growth has a slope of one."""
    panels: dict[str, list[str]] = {}
    found = curves(measured)
    for name, points in found.items():
        panels.setdefault(points[0]["x_unit"], []).append(name)
    rows, columns = -(-len(panels) // 3), min(3, len(panels))  # a row of more is too small to read on a page
    figure = Figure(figsize=(3.2 * columns, 3.0 * rows), layout="constrained")
    all_axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in all_axes[len(panels) :]:
        axes.remove()
    for axes, (x_unit, names) in zip(all_axes, panels.items(), strict=False):
        for name in names:
            points = found[name]
            medians = [point["median"] for point in points]
            errors = [
                [point["median"] - point["min"] for point in points],
                [point["max"] - point["median"] for point in points],
            ]
            axes.errorbar([point["x"] for point in points], medians, yerr=errors, marker="o", capsize=3, label=name)
        axes.set(xscale="log", yscale="log", xlabel=x_unit, ylabel=found[names[0]][0]["unit"])
        sizes = sorted({point["x"] for name in names for point in found[name]})
        short = EngFormatter(sep="")
        axes.set_xticks(
            sizes, [short(float(f"{size:.3g}")) for size in sizes]
        )  # the axis's own labels may lie on each other
        axes.set_xticks([], minor=True)
        axes.grid(visible=True, which="both", alpha=0.3)
        axes.legend(fontsize=8, frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0))  # hides no point
    return figure
