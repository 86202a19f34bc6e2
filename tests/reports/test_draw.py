"""Figures tell all their agents apart, also where there are more agents than colours."""

import re

import numpy as np

from gvz.evaluation.statistics import Estimate
from gvz.reports.document import Figure
from gvz.reports.draw import COLOURS, draw_histogram, draw_levels, draw_rewards

AGENTS = [f"agent {number}" for number in range(2 * len(COLOURS) + 3)]


def _looks(figure: Figure) -> list[str]:
    """The style of each line or bar in the legend; SVG leaves that of a black bar out."""
    legend = figure.svg.decode().partition('<g id="legend_1">')[2]
    return re.findall(r'<g id="(?:line2d|patch)_\d+">\s*<path d="[^"]*"([^>]*)/>', legend)


def test_no_two_agents_look_alike(tmp_path):
    estimate = Estimate(value=50.0, low=40.0, high=60.0)
    scores = np.linspace(0.0, 100.0, 10)
    figures = [
        draw_levels(tmp_path, "levels", "levels", (0, 1), dict.fromkeys(AGENTS, (estimate, estimate)), "by level"),
        draw_histogram(tmp_path, "histogram", "scores", dict.fromkeys(AGENTS, scores), "scores"),
        draw_rewards(tmp_path, "rewards", {agent: {"moved": 1.0, "kill": 2.0} for agent in AGENTS}, "rewards"),
    ]
    for figure in figures:
        looks = _looks(figure)
        assert len(looks) == len(set(looks)) == len(AGENTS), figure.id
