"""Results directories without training: real configurations and plans, and scores that a test chooses."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from gvz.experiments.base import TrainingRun
from gvz.experiments.inventory import PROCESSOR_S, run_directory
from gvz.experiments.plan import Plan, write_plan
from gvz.run.config_files import config_to_dict
from gvz.tasks import parse_task

MISSING = "rainbow_4task/defend_the_center/train8/seed_1111"
"""the run that is not there in `report_of_all`"""


class Played(NamedTuple):
    """An evaluation episode."""

    run: TrainingRun
    task: str
    updates: int
    episode: int


Score = Callable[[Played], float]
"""percent of the upper bound"""


def write_rows(file: Path, rows: list[dict[str, Any]]) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("".join(json.dumps({"schema": 1, **row}) + "\n" for row in rows))


def evaluation_row(player: str, task: str, episode: int, percent: float, **more: Any) -> dict[str, Any]:
    bound = parse_task(task).scenario.upper_bound()
    return {
        "player": player,
        "profile": "thesis",
        "action_set": "buttons",
        "frame_skip": 4,
        "task": task,
        "episode": episode,
        "seed": episode,
        "score": percent * bound / 100,
        "normalized_score": percent,
        "reward_components": {"kill": percent / 10, "death": -1.0},
        "terminated": percent < 100,
        "truncated": percent >= 100,
        **more,
    }


def write_training(results: Path, run: TrainingRun, *, until: int | None = None) -> Path:
    """Config and records of training, up to a gradient step."""
    directory = run_directory(results, run)
    config = run.run_config
    learner = dataclasses.replace(config.learner, total_updates=run.total_updates)
    config = dataclasses.replace(config, learner=learner, seed=run.seed, tasks=run.tasks, name=run.agent)
    config = dataclasses.replace(config, max_processor_s=run.max_processor_s)
    end = run.total_updates if until is None else until
    steps = [end * n // 20 for n in range(1, 21)]
    rates = {"learner/updates_per_s": 50.0, "actors/decisions_per_s": 200.0, "actors/frames_per_s": 800.0}
    write_rows(
        directory / "metrics.jsonl",
        [{"num_updates": s, "time_s": s / 50, "actors/env_steps": 4 * s, PROCESSOR_S: s / 50, **rates} for s in steps],
    )
    write_rows(
        directory / "episodes.jsonl",
        [
            {"num_updates": s, "task": task, "score": 1.0, "normalized_score": 100.0 * s / end, "cut": False}
            for s in steps
            for task in run.tasks
        ],
    )
    write_rows(
        directory / "starts.jsonl",
        [
            {
                "num_updates": 0,
                "cpu": "Some CPU",
                "system": "Linux x86_64",
                "cores": 2,
                "memory_bytes": 8 * 2**30,
                "devices": ["cpu: cpu"],
                "versions": {"python": "3.11.2", "jax": "0.7.0"},
                "commit": "0123456789ab" if run.seed == 1111 else None,
            }
        ],
    )
    (directory / "config.json").write_text(json.dumps(config_to_dict(config)))
    return directory


def write_evaluation(results: Path, run: TrainingRun, tasks: tuple[str, ...], episodes: int, score: Score) -> None:
    name = f"{run.agent}/seed_{run.seed}"
    rows = [
        evaluation_row(
            f"{name}@{updates}",
            task,
            n,
            score(Played(run, task, updates, n)),
            run=run.agent,
            run_seed=run.seed,
            num_updates=updates,
            params="0",
        )
        for updates in run.checkpoints
        for task in tasks
        for n in range(episodes)
    ]
    write_rows(run_directory(results, run) / "evaluation.jsonl", rows)


def write_experiments(results: Path, plan: Plan, score: Score, *, without: tuple[str, ...] = ()) -> None:
    """All runs of a plan, but those whose ids are in `without`, and its players."""
    write_plan(results, plan)
    evaluations = plan.evaluations()
    for run in plan.runs():
        if run.id not in without:
            write_training(results, run)
            write_evaluation(results, run, evaluations[run.id].tasks, evaluations[run.id].episodes, score)
    for player, evaluation in plan.players().items():
        rows = [
            evaluation_row(player, task, n, 20.0 + n) for task in evaluation.tasks for n in range(evaluation.episodes)
        ]
        write_rows(results / "players" / f"{player}.jsonl", rows)


@pytest.fixture(scope="session")
def experiments_writer() -> Callable[..., None]:
    return write_experiments


@pytest.fixture(scope="session")
def report_of_all(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of the thesis's four experiments at the smallest scale, one of their runs missing."""
    from gvz.reports.page import make_report

    results, out = tmp_path_factory.mktemp("all"), tmp_path_factory.mktemp("report")
    names = ("training_difficulty", "training_set_size", "algorithm_comparison", "rainbow_evaluation")
    plan = Plan.of(*names, scale=0.0001)
    write_experiments(results, plan, lambda played: 10.0 * played.episode + len(played.run.tasks), without=(MISSING,))
    videos = results / "runs" / "rainbow_4task" / "defend_the_center" / "train4" / "seed_1111" / "videos"
    videos.mkdir()
    (videos / "gore.mp4").touch()
    make_report([results], out)
    return out
