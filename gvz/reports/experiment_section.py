"""The section of an experiment: its table as in the thesis, aggregates, comparisons, curves."""

import itertools
import zlib
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np
import polars as pl

from gvz.evaluation.statistics import (
    Statistic,
    difference,
    interquartile_mean,
    mean,
    mean_over_scenarios,
    median,
    probability_of_improvement,
)
from gvz.experiments.base import Experiment, TrainingRun
from gvz.experiments.inventory import run_directory, standing_checkpoints
from gvz.reports.curves import evaluation_curve, learning_curve, level_curves
from gvz.reports.document import Block, Cell, Figure, Section, Table, count, missing, theirs, words
from gvz.reports.draw import draw_curves
from gvz.reports.results import PlannedExperiment, Results
from gvz.reports.runs import TRAINING_SETS
from gvz.reports.scores import Scores, estimate, estimate_groups, pick
from gvz.tasks import LEVELS, parse_task, scenario_named, scenarios

MAX_ID_LENGTH = 100
"""characters of a name in a file's name, which has at most 255"""
_TABLE_OVER = {"gate": " on the gate tasks", "procedural": " on the maps of procedural-test"}
"""what the caption of a table without levels says, by `evaluate_on`: the others are over test tasks"""


def experiment_section(results: Results, asked: PlannedExperiment, out: Path) -> Section:
    """All that the report says about an experiment."""
    experiment = asked.experiment
    budget = (
        f"{count(len(experiment.seeds), 'training seed')}, {experiment.budget}, "
        f"{count(experiment.num_checkpoints, 'checkpoint')}, {count(experiment.episodes, 'evaluation episode')} a task "
        f"and checkpoint; tables are over the last {count(experiment.table_checkpoints, 'checkpoint')}."
    )
    tables = [result_table(results, asked), aggregate_table(results, asked)]
    if experiment.compares_training:
        tables.insert(1, result_table(results, asked, trained=True))
    if experiment.columns != "level" and len(experiment.column_names) > 1:
        tables.append(comparison_table(results, asked))
    text = (f"**{experiment.question}** Source: {experiment.source}.", budget, *experiment.notes)
    if experiment.max_processor_s is not None:
        curves = Block(
            text=("Such runs are evaluated once. Curves of their training are in the sections of the scenarios.",)
        )
    elif figures := _figures(results, asked, out):
        curves = Block(heading="Curves", figures=tuple(figures))
    else:
        curves = Block(text=("No run of this experiment has been evaluated yet: there are no curves.",))
    blocks = (Block(text=text, tables=tuple(tables)), curves)
    return Section(id=experiment.name.replace("_", "-"), title=experiment.title, blocks=blocks)


def column_title(experiment: Experiment, column: str) -> str:
    """What stands above a column of the experiment's table."""
    titles: dict[str, str] = {**TRAINING_SETS}
    return f"level {column}" if experiment.columns == "level" else titles.get(column, column)


def column_scores(
    results: Results, asked: PlannedExperiment, scenario: str, column: str, *, trained: bool = False
) -> tuple[Scores, tuple[str, ...]]:
    """Scores of the runs of one column in one scenario, and the ids of the tasks they are over: the table's, or those
    that each run was trained on.
    """
    experiment = asked.experiment
    runs: dict[int | None, dict[str, np.ndarray]] = {}
    tasks: dict[str, None] = {}
    for run in column_runs(experiment, scenario, column):
        wanted = run.tasks if trained else _column_tasks(experiment, run, column)
        tasks |= dict.fromkeys(wanted)
        rows = _episodes_of(results, asked, [run])
        checkpoints = standing_checkpoints(run, rows["num_updates"].drop_nulls().unique().sort().to_list())
        last = pl.col("num_updates").is_in(checkpoints[-experiment.table_checkpoints :])
        for by_task in pick(rows.filter(last, pl.col("task").is_in(wanted))).values():
            runs.setdefault(run.seed, {}).update(by_task)
    own = experiment.evaluate_on == "own"
    return Scores(runs=runs, wanted_seeds=experiment.seeds, agents_of_tasks=own), tuple(tasks)


def column_runs(experiment: Experiment, scenario: str, column: str) -> list[TrainingRun]:
    """The runs behind a column: all of the scenario's for a level, else those of the training or the config."""
    runs = [run for run in experiment.runs() if run.scenario == scenario]
    match experiment.columns:
        case "level":
            return runs
        case "training":
            return [run for run in runs if run.training == column]
        case "config":
            return [run for run in runs if run.agent == column]


def _column_tasks(experiment: Experiment, run: TrainingRun, column: str) -> tuple[str, ...]:
    tasks = experiment.table_tasks(run)
    return tuple(t for t in tasks if parse_task(t).level == int(column)) if experiment.columns == "level" else tasks


def result_table(results: Results, asked: PlannedExperiment, *, trained: bool = False) -> Table:
    """For every scenario a row of ours, then rows of published numbers; at the end the means over scenarios.

    With `trained`, the table is over the tasks that each run was trained on, and has no published numbers.
    """
    experiment, columns = asked.experiment, asked.experiment.column_names
    published = {} if trained else experiment.published
    groups = {
        column: [column_scores(results, asked, scenario, column, trained=trained) for scenario in experiment.scenarios]
        for column in columns
    }
    rows = []
    for number, scenario in enumerate(experiment.scenarios):
        cells = [estimate(*groups[column][number]) for column in columns]
        numbers = {who: found[scenario] for who, found in published.items() if scenario in found}
        rows += _rows(scenario_named(scenario).title, cells, numbers)
    if len(experiment.scenarios) > 1:
        averages = [estimate_groups(group, mean_over_scenarios) for group in groups.values()]
        numbers = {
            who: np.mean([found[scenario] for scenario in experiment.scenarios], axis=0).tolist()
            for who, found in published.items()
            if found.keys() >= set(experiment.scenarios)
        }
        is_norm = {*experiment.scenarios} == scenarios().keys() and not experiment.compares_training
        rows += _rows("P_norm: " * is_norm + "mean over scenarios", averages, numbers)
    others = " Rows in italics are published numbers; no number of ours uses them." if published else ""
    over = " on the tasks of training" if trained else _over(experiment)
    return Table(
        id=f"{experiment.name}_training" if trained else experiment.name,
        caption=f"{experiment.title}: percent of the upper bound{over} ({experiment.source}).{others}",
        columns=("scenario", "numbers", *(column_title(experiment, column) for column in columns)),
        rows=tuple(rows),
        notes=(interval_note(experiment),),
    )


def _over(experiment: Experiment) -> str:
    """What the experiment's tables are over, where their columns do not say it."""
    if experiment.columns == "level":
        return ""
    return _TABLE_OVER.get(experiment.evaluate_on, " on the test tasks")


def _rows(title: str, ours: Sequence[Cell], published: Mapping[str, Sequence[float]]) -> list[tuple[Cell, ...]]:
    """A row of our cells, then one for each who published numbers."""
    others = [
        (words(title), Cell(kind="theirs", text=who), *(theirs(number, 2) for number in numbers))
        for who, numbers in published.items()
    ]
    return [(words(title), words("ours"), *ours), *others]


def interval_note(experiment: Experiment) -> str:
    """What the intervals of an experiment's tables are."""
    if len(experiment.seeds) < 2:
        return "Mean [95% bootstrap interval over evaluation episodes] of one training seed; others may differ."
    what = "runs resampled within each task" if experiment.evaluate_on == "own" else "whole training seeds resampled"
    return (
        f"Mean [95% bootstrap interval, {what}]. With {len(experiment.seeds)} seeds it is about the range of their "
        "means, and too short. A cell with missing seeds says so; with one seed, its interval is over episodes."
    )


def _joined(statistic: Statistic) -> Statistic:
    """A statistic of all scenarios' runs and tasks as one matrix."""
    return lambda *groups: statistic(np.concatenate(groups, axis=-1))


def aggregate_table(results: Results, asked: PlannedExperiment) -> Table:
    """Mean, interquartile mean and median over all scenarios' tasks."""
    experiment = asked.experiment
    rows = []
    for column in experiment.column_names:
        groups = [column_scores(results, asked, scenario, column) for scenario in experiment.scenarios]
        alike = len({len(scores.cells(tasks)) for scores, tasks in groups}) == 1
        cells = [
            estimate_groups(groups, _joined(statistic)) if alike else missing("scenarios differ in seeds")
            for statistic in (mean, interquartile_mean, median)
        ]
        rows.append((words(column_title(experiment, column)), *cells))
    return Table(
        id=f"{experiment.name}_aggregates",
        caption="The table's tasks of all scenarios together, percent of the upper bound: mean, interquartile mean and "
        "median of the scores by task and seed.",
        columns=(experiment.columns, "mean", "IQM", "median"),
        rows=tuple(rows),
    )


def comparison_table(results: Results, asked: PlannedExperiment) -> Table:
    """For each two columns the difference of the means, and the probability that the first is better."""
    experiment = asked.experiment
    rows = []
    for worse, better in itertools.combinations(experiment.column_names, 2):
        for scenario in experiment.scenarios:
            groups = [column_scores(results, asked, scenario, column) for column in (better, worse)]
            names = [column_title(experiment, column) for column in (better, worse)]
            rows.append(
                (
                    words(scenario_named(scenario).title),
                    words(f"{names[0]} against {names[1]}"),
                    estimate_groups(groups, difference),
                    estimate_groups(groups, probability_of_improvement, digits=2),
                )
            )
    return Table(
        id=f"{experiment.name}_comparisons",
        caption=f"Difference of the means{_over(experiment)} in points, and probability of improvement: that a run of "
        "the first beats one of the second on a task, mean over tasks.",
        columns=("scenario", "compared", "difference", "probability"),
        rows=tuple(rows),
    )


# ----------------------------------------------------------------------------------------------------- curves


def _figures(results: Results, asked: PlannedExperiment, out: Path) -> list[Figure]:
    experiment = asked.experiment
    figures: list[Figure] = []
    for scenario in experiment.scenarios:
        if experiment.evaluate_on == "own":
            figures += _learning_curves(results, asked, scenario, out)
        elif experiment.columns == "level":
            figures += _curves_by_level(results, asked, scenario, out)
        else:
            figures += _curves_by_task(results, asked, scenario, out)
    return figures


def _learning_curves(results: Results, asked: PlannedExperiment, scenario: str, out: Path) -> list[Figure]:
    """Training scores by level, and those of each task of level 1 (thesis Figures 5.2 and 5.3)."""
    experiment, title = asked.experiment, scenario_named(scenario).title
    runs = column_runs(experiment, scenario, "0")
    paths = {str(run_directory(asked.results, run)) for run in runs}
    trained = [run for run in results.runs if str(run.path) in paths]
    tasks = list(dict.fromkeys(task for run in runs for task in run.tasks))
    by_level = {f"level {level}": [task for task in tasks if parse_task(task).level == level] for level in LEVELS}
    of_level_1 = {task.partition("/")[2]: [task] for task in by_level["level 1"]}
    figures = []
    for id, lines, what in (("levels", by_level, "by level"), ("level_1", of_level_1, "on each task of level 1")):
        curves = [learning_curve(label, trained, chosen) for label, chosen in lines.items() if chosen]
        if any(curves):
            caption = f"{title}: training scores {what}, running mean of 30 episodes; band: training seeds redrawn."
            figures.append(draw_curves(out, f"{experiment.name}_{scenario}_{id}", title, curves, caption))
    return figures


def what_id(text: str, beside: Collection[str] = ()) -> str:
    """A name as part of a file name. One that is too long is cut. Such a one, and one that would be as that of another
    name `beside` it, has a checksum at its end.
    """

    def plain(name: str) -> str:
        return "".join(c if c.isalnum() else "_" for c in name)

    id = plain(text)
    alone = all(plain(other) != id for other in beside if other != text)
    return id if alone and len(id) <= MAX_ID_LENGTH else f"{id[:MAX_ID_LENGTH]}_{zlib.crc32(text.encode()):08x}"


def _curves_by_level(results: Results, asked: PlannedExperiment, scenario: str, out: Path) -> list[Figure]:
    """Evaluation scores of checkpoints by level (thesis Figure 5.6)."""
    experiment, title = asked.experiment, scenario_named(scenario).title
    runs = column_runs(experiment, scenario, "0")
    curves = level_curves(_episodes_of(results, asked, runs), experiment.table_tasks(runs[0]))
    if not any(curves):
        return []
    caption = f"{title}: evaluation of every checkpoint by level, mean over tasks and seeds with 95% interval."
    return [draw_curves(out, f"{experiment.name}_{scenario}_levels", title, curves, caption)]


def _curves_by_task(results: Results, asked: PlannedExperiment, scenario: str, out: Path) -> list[Figure]:
    """Evaluation scores of checkpoints on each test task, a line for each column (thesis Figures 5.4 and 5.5)."""
    experiment, title = asked.experiment, scenario_named(scenario).title
    figures = []
    by_column = {c: column_runs(experiment, scenario, c) for c in experiment.column_names}
    rows = {c: _episodes_of(results, asked, runs) for c, runs in by_column.items()}
    for task in experiment.table_tasks(next(iter(by_column.values()))[0]):
        found = [evaluation_curve(column_title(experiment, c), rows[c], [task]) for c in experiment.column_names]
        curves = [curve for curve in found if curve is not None]
        if curves:
            name = task.partition("/")[2]
            caption = f"{title}, {name} (level {parse_task(task).level}): evaluation of every checkpoint."
            id = f"{experiment.name}_{scenario}_{what_id(name)}"
            figures.append(draw_curves(out, id, name, curves, caption, _players(results, task)))
    return figures


def _players(results: Results, task: str) -> dict[str, float]:
    """Mean scores of the players that do not learn."""
    rows = results.episodes.filter(pl.col("run_dir").is_null() & pl.col("run").is_null(), task=task)
    means = rows.group_by("agent", maintain_order=True).agg(pl.col("normalized_score").mean()).drop_nulls()
    return dict(means.iter_rows())


def _episodes_of(results: Results, asked: PlannedExperiment, runs: Sequence[TrainingRun]) -> pl.DataFrame:
    """The evaluation episodes of some runs of the experiment."""
    return results.episodes.filter(pl.col("run_dir").is_in([str(run_directory(asked.results, run)) for run in runs]))
