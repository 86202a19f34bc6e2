"""The learning curve of a run: `python -m gvz.reports.curve RUN_DIR --out curve.png`. Imports matplotlib, numpy.

Every finished training episode is a point; the line is their running mean, a colour a task.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from gvz.errors import GvzError
from gvz.rundir import read_records

WINDOW = 30
"""episodes in the running mean"""


def running_mean(values: np.ndarray, window: int) -> np.ndarray:
    """Mean of each value and up to `window - 1` before it, float64[N]."""
    sums = np.cumsum(np.concatenate([[0.0], values]))
    ends = np.arange(1, len(values) + 1)
    starts = np.maximum(0, ends - window)
    return (sums[ends] - sums[starts]) / (ends - starts)


def draw(rows: list[dict[str, Any]], out: Path, *, title: str, baseline: tuple[str, float] | None = None) -> None:
    """Draws scores over gradient steps.

    Args:
        rows: of episodes.jsonl; cut episodes are left out.
        out: picture, of the kind its suffix says.
        title: above the picture.
        baseline: name and score of another player, drawn as a level line.
    """
    figure, axes = plt.subplots(figsize=(7.0, 4.0), layout="constrained")
    for colour, task in enumerate(sorted({row["task"] for row in rows})):
        played = [row for row in rows if row["task"] == task and not row["cut"]]
        updates = np.array([row["num_updates"] for row in played])
        scores = np.array([row["score"] for row in played])
        axes.plot(updates, scores, ".", markersize=2, alpha=0.25, color=f"C{colour}")
        axes.plot(updates, running_mean(scores, WINDOW), color=f"C{colour}", label=f"{task}, mean of {WINDOW}")
    if baseline is not None:
        axes.axhline(baseline[1], color="grey", linestyle="--", label=baseline[0])
    axes.set(xlabel="gradient steps", ylabel="score of a training episode", title=title, ylim=(0, None))
    axes.legend(loc="best", fontsize=8)
    figure.savefig(out, dpi=150)
    plt.close(figure)


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m gvz.reports.curve", description="Draw a run's learning curve.")
    parser.add_argument("run_dir", type=Path, help="run directory with episodes.jsonl")
    parser.add_argument("--out", type=Path, required=True, help="picture to write (.png, .pdf, .svg)")
    parser.add_argument("--title", default="", help="default: the run directory's name")
    parser.add_argument("--random", type=float, help="mean score of a random player, drawn as a level line")
    arguments = parser.parse_args()
    try:
        rows, problems = read_records(arguments.run_dir / "episodes.jsonl")
    except GvzError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    for problem in problems:
        print(f"passed over: {problem}", file=sys.stderr)
    baseline = None if arguments.random is None else ("random player", arguments.random)
    draw(rows, arguments.out, title=arguments.title or arguments.run_dir.name, baseline=baseline)
    return 0


if __name__ == "__main__":
    sys.exit(main())
