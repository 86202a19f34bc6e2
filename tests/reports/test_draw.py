"""Figures tell all their agents apart, also where there are more agents than colours."""

import re

import numpy as np
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
