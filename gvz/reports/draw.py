"""Figures of a report.

A figure is one panel about as wide as a telephone, so that a page can show several in a row.
Each is written as SVG, PDF and PNG; the page holds the SVG.
"""

import io
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Picture
from matplotlib.rcsetup import cycler
from matplotlib.ticker import FuncFormatter
from PIL import Image

from gvz.core.files import written_whole
from gvz.evaluation.statistics import Estimate
from gvz.reports.curves import Curve
from gvz.reports.document import Figure
from gvz.scenarios.base import Task

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#8C6D31")
"""Okabe and Ito's, for readers with any colour vision; brown in place of yellow"""
GREY = "#777777"
LINE_LENGTH = 60
"""characters of a line of a title or a legend; an agent's name may be longer"""
DASHES = ("-", "--", ":", "-.")
"""lines after the eighth have the same colours again, dashed"""
HATCHES = ("", "///", "...", "xxx")
"""the same of bars"""
PANEL_INCHES = (4.2, 3.0)
STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.prop_cycle": cycler(color=COLOURS),
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 10,
    "axes.grid": True,
    "grid.color": "#e4e4e4",
    "axes.axisbelow": True,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "svg.hashsalt": "gvz",  # the same numbers give the same bytes
    "figure.constrained_layout.use": True,
}


def draw_curves(
    out: Path,
    id: str,
    title: str,
    curves: Sequence[Curve | None],
    caption: str,
    levels: Mapping[str, float] | None = None,
    what: str = "score, % of the bound",
) -> Figure:
    """Lines over gradient steps with their bands; dots where a line is of one run.

    Args:
        out: directory of the report.
        id: of the figure.
        title: above the panel.
        curves: in the order of their colours; None keeps a colour free, so that panels side by side agree.
        caption: below it.
        levels: name and score of players that do not learn, drawn as level lines.
        what: what the values are.
    """
    with mpl.rc_context(STYLE):
        picture, axes = _panel(title, "gradient steps", what)
        for number, curve in enumerate(curves):
            if curve is None:
                continue
            colour = f"C{number}"
            if curve.points is not None:
                axes.plot(*curve.points, ".", markersize=1.5, alpha=0.2, color=colour, rasterized=True)
            mark = "o" if len(curve.updates) <= 20 else ""
            axes.plot(curve.updates, curve.values, marker=mark, markersize=3, label=curve.label, **_line(number))
            axes.fill_between(curve.updates, curve.low, curve.high, color=colour, alpha=0.15, linewidth=0)
        for number, (name, value) in enumerate((levels or {}).items()):
            axes.axhline(value, color=GREY, linestyle=("--", ":", "-.")[number % 3], linewidth=1, label=name)
        axes.set_ylim(0, None)
        axes.xaxis.set_major_formatter(FuncFormatter(_short_number))
        _legend(picture, axes)
        return _written(picture, out, id, caption)


def draw_levels(
    out: Path, id: str, title: str, levels: Sequence[int], values: Mapping[str, Sequence[Estimate]], caption: str
) -> Figure:
    """A line over the levels for each agent, with its intervals.

    Args:
        out, id, title, caption: as of `draw_curves`.
        levels: of tasks, rising.
        values: agent -> an estimate for each level, percent of the upper bound.
    """
    with mpl.rc_context(STYLE):
        picture, axes = _panel(title, "level", "score, % of the bound")
        for number, (agent, found) in enumerate(values.items()):
            low, high = ([getattr(estimate, end) for estimate in found] for end in ("low", "high"))
            means = [estimate.value for estimate in found]
            axes.plot(levels, means, marker="o", markersize=3, label=agent, **_line(number))
            axes.fill_between(levels, low, high, color=f"C{number}", alpha=0.15, linewidth=0)
        axes.set_xticks(levels)
        axes.set_ylim(0, None)
        _legend(picture, axes)
        return _written(picture, out, id, caption)


def draw_matrix(out: Path, id: str, title: str, names: Sequence[str], values: np.ndarray, caption: str) -> Figure:
    """A square matrix of numbers around 0.

    Args:
        out, id, title, caption: as of `draw_curves`.
        names: of rows and columns.
        values: float64[N, N]; red above 0, blue below, NaN where there is none.
    """
    with mpl.rc_context({**STYLE, "axes.grid": False}):
        inches = 1.6 + 0.36 * len(names)
        picture = Picture(figsize=(max(PANEL_INCHES[0], inches), inches))
        axes = picture.subplots()
        limit = max(1.0, float(np.nanmax(np.abs(values))))
        axes.imshow(values, cmap="RdBu_r", vmin=-limit, vmax=limit)
        for (row, column), value in np.ndenumerate(values):
            if not np.isnan(value):
                shade = "white" if abs(value) > 0.67 * limit else "black"
                axes.text(column, row, str(round(value)), ha="center", va="center", fontsize=8, color=shade)
        axes.set_xticks(range(len(names)), names, rotation=90)
        axes.set_yticks(range(len(names)), names)
        axes.xaxis.tick_top()
        axes.tick_params(length=0, labelsize=8)
        axes.spines[:].set_visible(False)
        axes.set_title(textwrap.fill(title, LINE_LENGTH), fontsize=10)
        return _written(picture, out, id, caption, wide=True)


def draw_histogram(out: Path, id: str, title: str, scores: Mapping[str, np.ndarray], caption: str) -> Figure:
    """How agents' episodes spread over the scores, an outline each.

    Args:
        out, id, title, caption: as of `draw_curves`.
        scores: agent -> percent of the upper bound of single episodes; an agent without any keeps its colour.
    """
    with mpl.rc_context(STYLE):
        picture, axes = _panel(title, "score, % of the bound", "share of episodes, %")
        edges = np.linspace(0, max(100.0, *(values.max() for values in scores.values() if len(values))), 26)
        for number, (agent, values) in enumerate(scores.items()):
            if len(values):
                share = 100 * np.histogram(values, edges)[0] / len(values)
                axes.stairs(share, edges, label=agent, linewidth=1.4, **_line(number))
        axes.set_ylim(0, None)
        _legend(picture, axes)
        return _written(picture, out, id, caption)


def draw_heat_map(
    out: Path,
    id: str,
    title: str,
    tasks: Sequence[Task],
    scores: Mapping[str, Sequence[float | None]],
    caption: str,
) -> Figure:
    """Tasks as rows: dots for the attributes each has, then its score with every agent.

    Args:
        out, id, title, caption: as of `draw_curves`.
        tasks: of one scenario, at least one.
        scores: agent -> mean score in percent of the bound by task, None where there is none.
    """
    names = [attribute.name for attribute in tasks[0].scenario.attributes]
    attributes = [name for name in names if any(name in task.attributes for task in tasks)]
    num_marks, num_agents = len(attributes), len(scores)
    agents = [textwrap.fill(agent, LINE_LENGTH) for agent in scores]
    longest = max(len(line) for agent in agents for line in agent.splitlines())
    mark_inches, agent_inches = 0.25, 0.55 + 0.15 * max(agent.count("\n") for agent in agents)
    width = 2.4 + mark_inches * num_marks + agent_inches * num_agents
    with mpl.rc_context({**STYLE, "axes.grid": False}):
        picture = Picture(figsize=(max(PANEL_INCHES[0], width), 1.7 + 0.24 * len(tasks) + 0.07 * max(0, longest - 24)))
        marks, heat = picture.subplots(1, 2, sharey=True, width_ratios=(0.22 * max(1, num_marks), 0.62 * num_agents))
        picture.suptitle(title, fontsize=10)
        table = np.array([[np.nan if v is None else v for v in values] for values in scores.values()]).T
        heat.imshow(table, aspect="auto", cmap="viridis", vmin=0, vmax=100)
        for (row, column), value in np.ndenumerate(table):
            text = "-" if np.isnan(value) else f"{value:.0f}"
            shade = "white" if value < 44 else "black"
            heat.text(column, row, text, ha="center", va="center", fontsize=8, color=GREY if np.isnan(value) else shade)
        heat.set_xticks(range(num_agents), agents, rotation=90)
        for row, task in enumerate(tasks):
            marks.plot(range(num_marks), [row] * num_marks, ".", color="#dddddd", markersize=5)
            columns = [attributes.index(name) for name in task.attributes]
            marks.plot(columns, [row] * len(columns), "-", color="black", linewidth=1)
            marks.plot(columns, [row] * len(columns), "o", color="black", markersize=4.5)
        marks.set_xticks(range(num_marks), attributes, rotation=90)
        marks.set_xlim(-0.7, num_marks - 0.3)
        marks.set_yticks(range(len(tasks)), [f"{task.level}  {task.name}" for task in tasks])
        for axes in (marks, heat):
            axes.xaxis.tick_top()
            axes.tick_params(length=0, labelsize=8)
            axes.spines[:].set_visible(False)
            for row in (n for n in range(1, len(tasks)) if tasks[n].level != tasks[n - 1].level):
                axes.axhline(row - 0.5, color="#999999", linewidth=0.8)
        return _written(picture, out, id, caption, wide=True)


def draw_rewards(out: Path, id: str, values: Mapping[str, Mapping[str, float]], caption: str) -> Figure:
    """Horizontal bars, grouped by reward component.

    Args:
        out, id, caption: as of `draw_curves`.
        values: agent -> component -> reward per episode; an agent without any keeps its colour.
    """
    bars = list(dict.fromkeys(bar for lengths in values.values() for bar in lengths))
    with mpl.rc_context(STYLE):
        inches = (PANEL_INCHES[0], 0.9 + 0.16 * len(bars) * (len(values) + 1))
        picture, axes = _panel("reward components", "reward per episode", "", inches)
        thick = 0.84 / len(values)
        for number, (agent, lengths) in enumerate(values.items()):
            if not lengths:
                continue
            at = np.array([bars.index(bar) for bar in lengths]) + (number - (len(values) - 1) / 2) * thick
            hatch = HATCHES[number // len(COLOURS) % len(HATCHES)]
            axes.barh(
                at,
                list(lengths.values()),
                height=thick,
                facecolor=f"C{number}",
                hatch=hatch,
                edgecolor="white",
                linewidth=0,
                label=agent,
            )
        axes.set_yticks(range(len(bars)), bars)
        axes.invert_yaxis()
        axes.axvline(0, color="black", linewidth=0.8)
        axes.grid(visible=False, axis="y")
        _legend(picture, axes)
        return _written(picture, out, id, caption)


def _panel(title: str, xlabel: str, ylabel: str, inches: tuple[float, float] = PANEL_INCHES) -> tuple[Picture, Axes]:
    picture = Picture(figsize=inches)
    axes = picture.subplots()
    axes.set(title=textwrap.fill(title, LINE_LENGTH), xlabel=xlabel, ylabel=ylabel)
    return picture, axes


def _line(number: int) -> dict[str, Any]:
    """How the line of this number looks."""
    return {"color": f"C{number}", "linestyle": DASHES[number // len(COLOURS) % len(DASHES)]}


def _legend(picture: Picture, axes: Axes) -> None:
    """Below the panel, where it hides nothing."""
    handles, _ = axes.get_legend_handles_labels()
    if handles:
        labels = [textwrap.fill(str(h.get_label()), LINE_LENGTH) for h in handles]
        for handle, label in zip(handles, labels, strict=True):
            handle.set_label(label)
        columns = 1 if max(map(len, labels)) > 26 else 2
        lines = len(labels) + sum(label.count("\n") for label in labels)
        picture.set_figheight(picture.get_figheight() + 0.17 * -(-lines // columns))
        picture.legend(loc="outside lower center", ncols=columns)


def _short_number(value: float, _: int) -> str:
    """20000 -> 20K."""
    for size, letter in ((1e6, "M"), (1e3, "K")):
        if abs(value) >= size:
            return f"{value / size:g}{letter}"
    return f"{value:g}"


def _written(picture: Picture, out: Path, id: str, caption: str, *, wide: bool = False) -> Figure:
    layout = picture.get_layout_engine()
    assert layout is not None
    layout.execute(picture)
    picture.set_layout_engine("none")  # once for all three files: it takes longer than drawing
    svg, pdf, png, small_png = (io.BytesIO() for _ in range(4))
    picture.savefig(svg, format="svg", metadata={"Date": None})
    picture.savefig(pdf, format="pdf", metadata={"CreationDate": None})
    picture.savefig(png, dpi=150)
    # 256 colours show the same figure in a third of the bytes.
    Image.open(png).convert("RGB").quantize(dither=Image.Dither.NONE).save(small_png, format="png", optimize=True)
    for suffix, data in (("svg", svg), ("pdf", pdf), ("png", small_png)):
        with written_whole(out / "figures" / f"{id}.{suffix}") as writing:
            writing.write_bytes(data.getvalue())
    return Figure(id=id, caption=caption, svg=svg.getvalue(), wide=wide)
