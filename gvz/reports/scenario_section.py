"""The section of a scenario: every agent and player on every task, by level and by attribute."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import polars as pl

from gvz.evaluation.dataset import REWARD_PREFIX
from gvz.evaluation.statistics import Statistic, generalization_gap, interquartile_mean, mean, median, solved
from gvz.reports.agents import ONE_RUN
from gvz.reports.attribute_tables import attribute_figure, attribute_tables
from gvz.reports.curves import checkpoints_of_runs, learning_curve, level_curves, usual_tasks
from gvz.reports.document import Block, Cell, Figure, Section, Table, count, missing, words
from gvz.reports.draw import draw_curves, draw_heat_map, draw_histogram, draw_rewards
from gvz.reports.experiment_section import what_id
from gvz.reports.results import Results
from gvz.reports.runs import Run
from gvz.reports.scores import Scores, agent_scores, estimate, pick
from gvz.scenarios.base import Scenario, Task
from gvz.tasks import LEVELS, all_scenarios, named_tasks, parse_task, scenario_named


def scenario_sections(results: Results, out: Path) -> list[Section]:
    """A section for each scenario that has evaluated episodes or runs."""
    played = set(results.episodes.drop_nulls("level")["scenario"])
    played.update(*(run.scenarios for run in results.runs))
    return [_section(results, scenario_named(name), out) for name in all_scenarios() if name in played]


def agents_of(episodes: pl.DataFrame) -> list[str]:
    """Trained agents by name, then the players that do not learn."""
    pairs = episodes.select("agent", learns=pl.col("run").is_not_null()).unique().rows()
    return [agent for agent, _ in sorted(pairs, key=lambda pair: (not pair[1], pair[0]))]


def played_tasks(episodes: pl.DataFrame) -> list[Task]:
    """The known tasks among the rows, named ones first in the thesis's order."""
    ids = set(episodes.drop_nulls("level")["task"])
    order = [task.id for name in all_scenarios() for task in named_tasks(name)]
    return [parse_task(id) for id in sorted(ids, key=lambda id: (order.index(id) if id in order else len(order), id))]


def _section(results: Results, scenario: Scenario, out: Path) -> Section:
    episodes = results.episodes.filter(scenario=scenario.id).drop_nulls("level")
    agents, tasks = agents_of(episodes), played_tasks(episodes)
    blocks = []
    if agents:
        scores = {agent: agent_scores(episodes, agent) for agent in agents}
        tables = [task_table(scenario, scores, tasks, episodes)]
        if _named(scenario, tasks):
            tables.insert(0, level_table(scenario, scores, tasks))
        if scenario.metric == "kills":
            own = {agent: agent_scores(episodes, agent, column="player_kills") for agent in agents}
            tables.append(own_kills_table(scenario, own, tasks))
        if gaps := gap_table(results, scenario, scores, tasks):
            tables.append(gaps)
        tables += attribute_tables(scenario, scores, tasks)
        final = episodes.filter("final")
        pictures = [_heat_map(scenario, scores, tasks, out)]
        for agent, one in scores.items():
            id = f"attributes_{scenario.id}_{what_id(agent, agents)}"
            if figure := attribute_figure(scenario, agent, one, tasks, out, id):
                pictures.append(figure)
        pictures += _histograms(scenario, final, agents, out)
        pictures += _rewards(scenario, final, agents, out)
        text = (
            f"Score: {scenario.metric.replace('_', ' ')}; percent of the upper bound "
            f"({scenario.upper_bound():g} in profile thesis). A trained agent's numbers are of the last quarter of its "
            "evaluated checkpoints.",
        )
        blocks = [
            Block(text=text, tables=tuple(tables)),
            Block(heading="Tasks, scores, rewards", figures=tuple(pictures)),
        ]
    curves = [*_learning(results, scenario, out), *_evaluation(results, scenario, episodes, agents, out)]
    if curves:
        blocks.append(Block(heading="Curves", figures=tuple(curves)))
    return Section(id=scenario.id.replace("_", "-"), title=scenario.title, blocks=tuple(blocks))


def _interval_note(scores: Mapping[str, Scores]) -> str:
    several = [agent for agent, one in scores.items() if len(one.runs) > 1]
    if not several:
        return "Mean [95% bootstrap interval over evaluation episodes]. It says nothing about other training seeds."
    return (
        f"Mean [95% bootstrap interval]: training seeds resampled for {', '.join(several)}; evaluation "
        "episodes for the others."
    )


def _cell(scores: Scores, tasks: Sequence[str], statistic: Statistic = mean, note: str = "") -> Cell:
    """An estimate with its notes; missing if none of the tasks was played."""
    cell = estimate(scores, tasks, statistic) if scores.played(tasks) else missing()
    return replace(cell, note="; ".join(filter(None, (cell.note, note))))


def _named(scenario: Scenario, tasks: Sequence[Task]) -> list[Task]:
    """The named ones of these tasks: drawn and graded tasks have a level, too, but would change its mean."""
    return [task for task in tasks if task in named_tasks(scenario.id)]


def level_table(scenario: Scenario, scores: Mapping[str, Scores], tasks: Sequence[Task]) -> Table:
    """Agents as rows; levels as columns, then statistics of the test tasks. Of named tasks alone."""
    test = [task.id for task in named_tasks(scenario.id, split="test")]
    played = {task.id for task in tasks}
    levels = [(f"level {n}", [t.id for t in _named(scenario, tasks) if t.level == n]) for n in LEVELS]
    levels = [(title, ids) for title, ids in levels if ids]
    rows = []
    for agent, one in scores.items():
        cells = [_cell(one, ids) for _, ids in levels]
        if set(test) <= played:
            cells += [_cell(one, test, statistic) for statistic in (mean, interquartile_mean, median)]
        rows.append((words(agent), *cells))
    columns = ["agent", *(f"{title} ({count(len(ids), 'task')})" for title, ids in levels)]
    columns += [f"P: mean of the {len(test)} test tasks", "their IQM", "their median"] if set(test) <= played else []
    return Table(
        id=f"{scenario.id}_levels",
        caption=f"{scenario.title} by level, percent of the upper bound.",
        columns=tuple(columns),
        rows=tuple(rows),
        notes=(_interval_note(scores), "- : not evaluated on all of these tasks."),
    )


def task_table(
    scenario: Scenario, scores: Mapping[str, Scores], tasks: Sequence[Task], episodes: pl.DataFrame
) -> Table:
    """Tasks as rows, agents as columns; says who has solved a task."""
    who_solved = _solved(scenario, episodes.filter("final"))
    rows = []
    for task in tasks:
        solved_by = {agent for agent, solved_task in who_solved if solved_task == task.id}
        cells = [_cell(one, [task.id], note="solved" * (agent in solved_by)) for agent, one in scores.items()]
        rows.append((words(task.name), words(str(task.level)), *cells))
    notes = (_interval_note(scores),)
    if scenario.metric == "frames_alive":
        notes += ("solved: 10 consecutive evaluation episodes of every training seed reached the time-out.",)
    return Table(
        id=f"{scenario.id}_tasks",
        caption=f"{scenario.title} by task, percent of the upper bound.",
        columns=("task", "level", *scores),
        rows=tuple(rows),
        notes=notes,
    )


def own_kills_table(scenario: Scenario, own: Mapping[str, Scores], tasks: Sequence[Task]) -> Table:
    """Tasks and then levels, of named tasks alone, as rows, agents as columns: the enemies that the agent killed."""
    groups = [(task.name, task.level, [task.id]) for task in tasks]
    by_level = [(level, [task.id for task in _named(scenario, tasks) if task.level == level]) for level in LEVELS]
    groups += [(f"mean of {len(ids)} tasks", level, ids) for level, ids in by_level if len(ids) > 1]
    return Table(
        id=f"{scenario.id}_own_kills",
        caption=f"{scenario.title}, own kills: enemies killed by the agent itself, those beyond the upper bound, too. "
        "The score also counts enemies that other enemies killed, and is at most the upper bound.",
        columns=("task", "level", *own),
        rows=tuple(
            (words(name), words(str(level)), *(_cell(one, ids) for one in own.values())) for name, level, ids in groups
        ),
        notes=(_interval_note(own),),
    )


def _solved(scenario: Scenario, final: pl.DataFrame) -> set[tuple[str, str]]:
    """(agent, task) where each seed's newest checkpoint survived ten episodes in a row; only survival counts."""
    if scenario.metric != "frames_alive":
        return set()
    newest = final.filter((pl.col("num_updates").max().over(ONE_RUN) == pl.col("num_updates")).fill_null(value=True))
    by_run = newest.sort("episode").group_by("agent", "task", *ONE_RUN).agg(pl.col("truncated").fill_null(value=False))
    done = {}
    for agent, task, *_, timed_out in by_run.iter_rows():
        done[agent, task] = done.get((agent, task), True) and solved(np.array(timed_out))
    return {key for key, value in done.items() if value}


def gap_table(
    results: Results, scenario: Scenario, scores: Mapping[str, Scores], tasks: Sequence[Task]
) -> Table | None:
    """How much lower agents score on other tasks than on their training tasks, and on levels 2 to 4 than on 0 and 1."""
    tasks_of = {str(run.path): run.tasks for run in results.runs if scenario.id in run.scenarios}
    who_played = results.episodes.select("agent", "run_dir").unique(maintain_order=True)
    trained_on = {agent: tasks_of[directory] for agent, directory in who_played.iter_rows() if directory in tasks_of}
    test = [task.id for task in named_tasks(scenario.id, split="test")]
    named = _named(scenario, tasks)
    low, high = [t.id for t in named if t.level <= 1], [t.id for t in named if t.level >= 2]
    rows = []
    for agent, one in scores.items():
        if agent in trained_on and not one.agents_of_tasks:
            own = [id for id in trained_on[agent] if id.partition("/")[0] == scenario.id]
            of_tasks = _gap(one, own, [id for id in test if id not in own])
            rows.append((words(agent), of_tasks, _gap(one, low, high)))
    if not any(cell.estimate for row in rows for cell in row):
        return None
    return Table(
        id=f"{scenario.id}_gap",
        caption=f"{scenario.title}, generalization gap in points of the upper bound: what is lost on tasks "
        "that were not trained on. At equal scores a smaller gap is better.",
        columns=("agent", "training tasks less test tasks", "levels 0 and 1 less levels 2 to 4"),
        rows=tuple(rows),
    )


def _gap(scores: Scores, easier: Sequence[str], harder: Sequence[str]) -> Cell:
    if not (easier and harder):
        return missing()
    return estimate(scores, [*easier, *harder], partial(generalization_gap, num_train=len(easier)))


# ---------------------------------------------------------------------------------------------------- figures


def _heat_map(scenario: Scenario, scores: Mapping[str, Scores], tasks: Sequence[Task], out: Path) -> Figure:
    means = {agent: [estimate(one, [task.id]).estimate for task in tasks] for agent, one in scores.items()}
    values = {agent: [None if e is None else e.value for e in row] for agent, row in means.items()}
    caption = f"{scenario.title}: level, task, its attributes, and the mean score in percent of the upper bound."
    return draw_heat_map(out, f"{scenario.id}_heat_map", scenario.title, tasks, values, caption)


def _histograms(scenario: Scenario, final: pl.DataFrame, agents: Sequence[str], out: Path) -> list[Figure]:
    figures = []
    for level in LEVELS:
        rows = final.filter(level=level).drop_nulls("normalized_score")
        if rows.is_empty():
            continue
        scores = {agent: rows.filter(agent=agent)["normalized_score"].to_numpy() for agent in agents}
        caption = f"{scenario.title}, level {level}: evaluation episodes by score, all tasks of the level together."
        figures.append(draw_histogram(out, f"{scenario.id}_histogram_{level}", f"level {level}", scores, caption))
    return figures


def _rewards(scenario: Scenario, final: pl.DataFrame, agents: Sequence[str], out: Path) -> list[Figure]:
    means = final.group_by("agent").agg(pl.col(f"^{REWARD_PREFIX}.*$").mean())
    values: dict[str, dict[str, float]] = {agent: {} for agent in agents}
    for row in means.iter_rows(named=True):
        agent = row.pop("agent")
        values[agent] = {n.removeprefix(REWARD_PREFIX): v for n, v in row.items() if v is not None}
    if not any(values.values()):
        return []
    caption = f"{scenario.title}: mean sum of each reward component over an evaluation episode, all tasks together."
    return [draw_rewards(out, f"{scenario.id}_rewards", values, caption)]


def _learning(results: Results, scenario: Scenario, out: Path) -> list[Figure]:
    """Training scores of each agent, a line for each task trained on (by level if those are many)."""
    if any(asked.experiment.evaluate_on == "own" for asked in results.asked):
        return []  # drawn with the experiment
    figures = []
    agents: dict[str, list[Run]] = {}
    for run in results.runs:
        if scenario.id in run.scenarios:
            agents.setdefault(results.agents[str(run.path)], []).append(run)
    for agent, runs in agents.items():
        trained_on = dict.fromkeys(task for run in runs for task in run.tasks)
        tasks = [task for task in trained_on if task.partition("/")[0] == scenario.id]
        lines = [learning_curve(task.partition("/")[2], runs, [task]) for task in tasks]
        if any(lines):
            caption = f"{scenario.title}, {agent}: training scores, running mean of 30 episodes"
            caption += (
                "; dots: episodes." if len({run.seed for run in runs}) == 1 else "; band: training seeds redrawn."
            )
            id = f"learning_{scenario.id}_{what_id(agent, agents)}"
            figures.append(draw_curves(out, id, agent, lines, caption, _chance(results, tasks)))
    return figures


def _chance(results: Results, tasks: Sequence[str]) -> dict[str, float]:
    """Mean score of the random player on these tasks, by each of its rules with which it played them all."""
    rows = results.episodes.filter(pl.col("task").is_in(tasks), player="random")
    scores = {str(agent): pick(of_agent).get(None, {}) for (agent,), of_agent in sorted(rows.group_by("agent"))}
    return {
        agent: float(np.mean([np.mean(by_task[task]) for task in tasks]))
        for agent, by_task in scores.items()
        if by_task.keys() >= set(tasks)
    }


def _evaluation(
    results: Results, scenario: Scenario, episodes: pl.DataFrame, agents: Sequence[str], out: Path
) -> list[Figure]:
    """Evaluation of checkpoints by level, for agents with several of them; not what an experiment shows already."""
    if any(asked.experiment.columns == "level" for asked in results.asked):
        return []
    figures = []
    for agent in agents:
        rows = episodes.filter(agent=agent)
        if max(checkpoints_of_runs(rows)) < 2:
            continue
        caption = f"{scenario.title}, {agent}: evaluation of every checkpoint by level, with 95% interval."
        curves = level_curves(rows, usual_tasks(rows))
        id = f"evaluation_{scenario.id}_{what_id(agent, agents)}"
        figures.append(draw_curves(out, id, agent, curves, caption))
    return figures
