"""The text of the findings, the records that it is of, and how it states scores, gains and numbers of steps."""

import gzip
import json
from collections.abc import Collection, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import polars

from gvz.evaluation.statistics import difference, mean_over_scenarios
from gvz.reports.results import Results, read_results
from gvz.reports.scores import Scores, agent_scores, estimate, estimate_groups
from gvz.tasks import TaskSet, named_tasks, scenario_named

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "docs" / "FINDINGS.md", *sorted((ROOT / "docs" / "findings").glob("*.md"))]
PAGE = "\n".join(page.read_text() for page in PAGES)
WORDS = " ".join(PAGE.split())
SUMMARY = PAGE.partition("## In short")[2].partition("\n## ")[0]


def words_of(page: str) -> str:
    """A page of the repository with one space between words."""
    return " ".join((ROOT / page).read_text().split())


@cache
def results_of(folder: str) -> Results:
    return read_results([ROOT / "results" / folder])


def rows_of(file: Path) -> list[dict[str, Any]]:
    """The rows of a compressed record file."""
    return [json.loads(line) for line in gzip.decompress(file.read_bytes()).splitlines()]


def scores_of(folder: str, agent: str, scenario: str) -> Scores:
    """What the records in a folder of results/ give an agent in a scenario."""
    return agent_scores(results_of(folder).episodes.filter(scenario=scenario), agent)


def task_mean(scores: Scores, task: str) -> float:
    """The mean over the runs of an agent."""
    return float(np.mean([by_task[task].mean() for by_task in scores.runs.values()]))


def mean_score(episodes: polars.DataFrame, **chosen: Any) -> str:
    """The mean percentage of these episodes, rounded."""
    return f"{episodes.filter(**chosen)['normalized_score'].mean():.0f}"


def gain(ours: Scores, theirs: Scores, tasks: Collection[str]) -> str:
    """The difference of the means on these tasks, with its interval."""
    return estimate_groups([(ours, tasks), (theirs, tasks)], difference).text


def last_updates(runs: str) -> list[int]:
    """Gradient steps of all runs whose directories under results/ fit the pattern, the fewest first."""
    files = (ROOT / "results").glob(f"{runs}/metrics.jsonl.gz")
    return sorted(rows_of(file)[-1]["num_updates"] for file in files)


def task_sets(scenario: str, training: TaskSet = "train8") -> list[list[str]]:
    """Ids of the training tasks, of the gate tasks, of the test tasks, and of level 4."""
    sets = (
        named_tasks(scenario, split=training),
        named_tasks(scenario, split="gate"),
        named_tasks(scenario, split="test"),
        named_tasks(scenario, level=4),
    )
    return [[task.id for task in tasks] for tasks in sets]


def score_cells(scores: Scores, scenario: str, training: TaskSet = "train8") -> str:
    """Mean score and interval on each of `task_sets`, as cells of a Markdown table."""
    return " | ".join(estimate(scores, tasks).text for tasks in task_sets(scenario, training))


def score_row(scenario: str, called: str, scores: Scores, training: TaskSet = "train8") -> str:
    """The row of a Markdown table that begins with the scenario's title and what the agent is called there."""
    return f"| {scenario_named(scenario).title} | {called} | {score_cells(scores, scenario, training)} |"


def means(of_agents: Mapping[str, Scores], training: TaskSet = "train8") -> list[str]:
    """Means over scenarios on each of `task_sets`."""
    groups = [[(of, task_sets(name, training)[column]) for name, of in of_agents.items()] for column in range(4)]
    return [estimate_groups(group, mean_over_scenarios).text for group in groups]


def in_words(numbers: list[str]) -> str:
    """Numbers, one for each scenario, as a sentence lists them."""
    return " and ".join([*filter(None, [", ".join(numbers[:-1])]), numbers[-1]])


def of_first_seed(episodes: polars.DataFrame) -> polars.DataFrame:
    """Those of the first training seed that each scenario has."""
    return episodes.filter(polars.col("run_seed") == polars.col("run_seed").min().over("scenario"))


def metrics_of(run: Path) -> list[dict[str, Any]]:
    """The rows of a run's metrics."""
    return rows_of(run / "metrics.jsonl.gz")


def segmenter(name: str) -> dict[str, Any]:
    """The record of a network in gvz/segmenters."""
    return json.loads((ROOT / "gvz" / "segmenters" / f"{name}.json").read_text())


def learned(rows: list[dict[str, Any]], first: int, end: int) -> float:
    """The mean score of the training episodes that ended at `first` gradient steps or later, and before `end`."""
    return float(np.mean([row["normalized_score"] for row in rows if first <= row["num_updates"] < end]))


def training_episodes(run: Path, low_s: float, high_s: float) -> list[dict[str, Any]]:
    """Rows of the training episodes that ended within these seconds of the run's processor time."""
    metrics, episodes = metrics_of(run), rows_of(run / "episodes.jsonl.gz")
    updates, spent_s = ([row[key] for row in metrics] for key in ("num_updates", "run/processor_s"))
    ended_s = np.interp([row["num_updates"] for row in episodes], updates, spent_s)
    return [row for row, second in zip(episodes, ended_s, strict=True) if low_s <= second < high_s]
