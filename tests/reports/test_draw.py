"""Figures tell all their agents apart, also where there are more agents than colours."""

import re

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes

from gvz.evaluation.statistics import Estimate
from gvz.reports.document import Figure
from gvz.reports.draw import COLOURS, draw_heat_map, draw_histogram, draw_levels, draw_matrix, draw_rewards
from gvz.reports.experiment_section import what_id
from gvz.tasks import named_tasks

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


def test_a_histogram_shows_shares_of_an_agents_episodes(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(Axes, "stairs", lambda *values, **_: drawn.append(values[1]))
    draw_histogram(tmp_path, "histogram", "scores", {"a": np.array([0.0, 50.0, 100.0, 100.0])}, "scores")
    assert (drawn[0][0], drawn[0][-1], drawn[0].sum()) == (25.0, 50.0, 100.0)


def test_a_very_long_name_is_wrapped_and_its_file_can_be_written(tmp_path, recwarn):
    """As that of an agent that differs from another in many settings."""
    names = [f"rainbow_quick ({', '.join(f'learner.setting_{n} {n}' for n in range(20))}, seed {s})" for s in (1, 2)]
    assert len({what_id(name) for name in names}) == 2
    estimate = Estimate(value=50.0, low=40.0, high=60.0)
    for name in names:
        draw_levels(tmp_path, what_id(name), name, (0, 1), dict.fromkeys(names, (estimate, estimate)), name)
    tasks = named_tasks("defend_the_center")
    draw_heat_map(tmp_path, "tasks", "tasks", tasks, {name: [50.0] * len(tasks) for name in names}, "by task")
    draw_matrix(tmp_path, "pairs", names[0], ["a", "b"], np.eye(2), "pairs")
    assert len(list(tmp_path.rglob("*.svg"))) == 4
    assert not recwarn.list
    assert what_id("a (b 0.5)") == "a__b_0_5_"


def test_numbers_in_a_heat_map_or_matrix_can_be_read_on_their_colours(tmp_path, monkeypatch):
    """A small loss is 0, not -0. The contrast of WCAG 2 is 4.5 on the heat map, 4 on the matrix's reds and blues."""
    drawn: list[tuple[str, str]] = []
    monkeypatch.setattr(Axes, "text", lambda _, _x, _y, text, color, **__: drawn.append((text, color)))
    tasks = named_tasks("defend_the_center")
    scores = {str(first): [100 * (first + n / len(tasks)) / 8 for n in range(len(tasks))] for first in range(8)}
    draw_heat_map(tmp_path, "tasks", "tasks", tasks, scores, "by task")
    heat, losses = drawn.copy(), np.linspace(-100.0, 100.0, 400).reshape(20, 20)
    drawn.clear()
    losses[0, 0] = -0.3
    draw_matrix(tmp_path, "pairs", "pairs", [str(n) for n in range(20)], losses, "pairs")
    assert drawn[0][0] == "0"
    values = np.array(list(scores.values())).T
    for numbers, shown, colours, wanted in (
        (values / 100, heat, "viridis", 4.4),
        (0.5 + losses / 200, drawn, "RdBu_r", 4.0),
    ):
        for number, (text, ink) in zip(numbers.flat, shown, strict=True):
            rgb = np.array(colormaps[colours](number)[:3])
            light = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4) @ (0.2126, 0.7152, 0.0722)
            contrast = 1.05 / (light + 0.05) if ink == "white" else (light + 0.05) / 0.05
            assert contrast > wanted, (colours, text)
