"""The section over all scenarios: how agents that were evaluated in several of them do in the mean."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import polars as pl

from gvz.evaluation.statistics import mean_over_scenarios
from gvz.reports.document import Block, Cell, Figure, Section, Table, words
from gvz.reports.draw import draw_levels
from gvz.reports.results import Results
from gvz.reports.scenario_section import agents_of
from gvz.reports.scores import Scores, agent_scores, estimate, estimate_groups
from gvz.tasks import LEVELS, named_tasks, scenario_named, scenarios

_INTERVALS = (
    "Mean [95% bootstrap interval]: in each scenario, training seeds resampled if an agent has several of them, else "
    "evaluation episodes."
)


def joint_sections(results: Results, out: Path) -> list[Section]:
    """The section, if an agent has the test tasks of two scenarios or more."""
    episodes = results.episodes.drop_nulls("level")
    test = {name: [task.id for task in named_tasks(name, split="test")] for name in scenarios()}
    scores = {agent: _scores(episodes, agent, test) for agent in agents_of(episodes)}
    played = {
        agent: [name for name, tasks in test.items() if by_scenario[name].complete_seeds(tasks)]
        for agent, by_scenario in scores.items()
    }
    shown = [name for name in test if any(name in names for names in played.values())]
    agents = [agent for agent, names in played.items() if len(names) > 1]
    if not agents:
        return []
    rows = []
    for agent in agents:
        groups = [(scores[agent][name], test[name]) for name in shown]
        rows.append(
            (words(agent), *(estimate(*group) for group in groups), estimate_groups(groups, mean_over_scenarios))
        )
    all_shown = len(shown) == len(test)
    table = Table(
        id="joint",
        caption="Test tasks of each scenario, percent of the upper bound, and the mean over scenarios"
        + (" (P_norm)." if all_shown else "."),
        columns=("agent", *(scenario_named(name).title for name in shown), "P_norm" if all_shown else "mean"),
        rows=tuple(rows),
        notes=(_INTERVALS, "- : not evaluated on all test tasks of all these scenarios."),
    )
    by_level = {agent: _by_level(scores[agent], shown) for agent in agents}
    whole = {agent: cells for agent, cells in by_level.items() if all(cell.estimate for cell in cells)}
    tables = (table, _level_table(by_level)) if whole else (table,)
    figures = (_level_figure(whole, out),) if whole else ()
    return [Section(id="joint", title="All scenarios", blocks=(Block(tables=tables, figures=figures),))]


def _scores(episodes: pl.DataFrame, agent: str, names: Iterable[str]) -> dict[str, Scores]:
    """An agent's scores by scenario. A seed that it has in one of them is missing where it has not played."""
    found = {name: agent_scores(episodes.filter(scenario=name), agent) for name in names}
    seeds = tuple(dict.fromkeys(seed for one in found.values() for seed in one.wanted_seeds))
    return {name: replace(one, wanted_seeds=seeds) if one.runs else one for name, one in found.items()}


def _by_level(scores: Mapping[str, Scores], shown: Sequence[str]) -> list[Cell]:
    """For each level, the mean over the scenarios of all its named tasks."""

    def groups(level: int) -> list[tuple[Scores, list[str]]]:
        return [(scores[name], [task.id for task in named_tasks(name, level=level)]) for name in shown]

    return [estimate_groups(groups(level), mean_over_scenarios) for level in LEVELS]


def _level_table(by_level: Mapping[str, Sequence[Cell]]) -> Table:
    return Table(
        id="joint_levels",
        caption="All named tasks by level, percent of the upper bound: mean over the scenarios.",
        columns=("agent", *(f"level {level}" for level in LEVELS)),
        rows=tuple((words(agent), *cells) for agent, cells in by_level.items()),
        notes=(
            "Most tasks of level 0 and 1 are training tasks, half of those of level 2 are gate tasks. Levels 3 and 4 "
            "are test tasks.",
            _INTERVALS,
            "- : not evaluated on all named tasks of this level.",
        ),
    )


def _level_figure(by_level: Mapping[str, Sequence[Cell]], out: Path) -> Figure:
    values = {agent: [cell.estimate for cell in cells if cell.estimate] for agent, cells in by_level.items()}
    caption = "All scenarios: all named tasks by level, mean over the scenarios with 95% interval."
    return draw_levels(out, "joint_levels", "all scenarios", LEVELS, values, caption)
