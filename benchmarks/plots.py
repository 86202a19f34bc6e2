"""The plots of docs/PERFORMANCE.md, drawn from records."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from benchmarks.record import Record
from benchmarks.report import PICTURES, curves
from benchmarks.rounds import Row, Spread

RATE_OF = {"actors": ("decisions_per_s", "decisions/s"), "learner_update": ("updates_per_s", "gradient steps/s")}


def draw(records: Sequence[Record], directory: Path) -> list[Path]:
    """Draws what there are CPU records of; returns the files."""
    files = []
    for made in records:
        if made.device != "cpu" or made.benchmark not in PICTURES:
            continue
        files.append(directory / PICTURES[made.benchmark])
        if made.benchmark == "growth":
            _growth(made.rows, files[-1])
        else:
            quantity, unit = RATE_OF[made.benchmark]
            rates = [row for row in made.rows if row["kind"] == "rates"]
            _bars([(row["name"], row[quantity]) for row in rates], unit, files[-1])
    return files


def _bars(bars: Sequence[tuple[str, Spread]], unit: str, out: Path) -> None:
    """A bar each, with its range over the rounds."""
    figure, axes = plt.subplots(figsize=(8.0, 0.9 + 0.32 * len(bars)), layout="constrained")
    for place, (name, spread) in enumerate(bars):
        low, high = spread["median"] - spread["min"], spread["max"] - spread["median"]
        ours = any(word in name for word in ("actor pool", "learner"))
        axes.barh(place, spread["median"], xerr=[[low], [high]], color="C0" if ours else "0.7")
    axes.set_yticks(range(len(bars)), [name for name, _ in bars])
    axes.invert_yaxis()
    axes.set(xlabel=f"{unit}: median, with min and max of the rounds")
    figure.savefig(out, dpi=120, metadata={"Software": None})
    plt.close(figure)


def _growth(rows: Sequence[Row], out: Path) -> None:
    """A panel for each thing that grows; both axes logarithmic, so that linear is a slope of one."""
    panels: dict[str, list[str]] = {}
    found = curves(rows)
    for name, points in found.items():
        panels.setdefault(points[0]["x_unit"], []).append(name)
    figure, all_axes = plt.subplots(1, len(panels), figsize=(3.6 * len(panels), 3.2), layout="constrained")
    for axes, (x_unit, names) in zip([all_axes] if len(panels) == 1 else all_axes, panels.items(), strict=True):
        for name in names:
            points = found[name]
            medians = [point["median"] for point in points]
            errors = [
                [point["median"] - point["min"] for point in points],
                [point["max"] - point["median"] for point in points],
            ]
            axes.errorbar([point["x"] for point in points], medians, yerr=errors, marker="o", capsize=3, label=name)
        axes.set(xscale="log", yscale="log", xlabel=x_unit, ylabel=found[names[0]][0]["unit"])
        axes.grid(visible=True, which="both", alpha=0.3)
        axes.legend(fontsize=7)
    figure.savefig(out, dpi=120, metadata={"Software": None})
    plt.close(figure)
