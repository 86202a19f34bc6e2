"""Each condition under which a run may be wasted is said, and nothing else."""

import dataclasses
import time
from types import SimpleNamespace
from typing import Any

import pytest

from actors.config import ActorsConfig
from actors.pool import PoolStatistics
from gvz.run.alarms import Expected, alarms
from gvz.run.config import RunConfig
from gvz.run.monitor import Counts, Monitor
from gvz.run.progress import TaskStatus
from learner.ingest import Staleness

EXPECTED = Expected(
    games={"a": 2, "b": 1, "c": 1},
    timeout_steps=275,
    num_slots=1000,
    v_min=-2.0,
    v_max=8.0,
    distributional=True,
    staleness_versions=17.0,
)
ROW = {
    "replay/fill_share": 1.0,
    "replay/share/a": 0.5,
    "replay/share/b": 0.25,
    "replay/share/c": 0.25,
    "learner/sample_share/a": 0.4,
    "learner/sample_share/b": 0.4,
    "learner/sample_share/c": 0.2,
    "learner/q_mean": 1.0,
    "learner/q_max": 7.0,
    "actors/staleness_p95_versions": 170,
}
TASKS = tuple(TaskStatus(task=task, episodes=40, score=3.0, upper_bound=20.0) for task in "abc")


def replaced(index: int, **changes: float) -> tuple[TaskStatus, ...]:
    changed = dataclasses.replace(TASKS[index], **changes)
    return (*TASKS[:index], changed, *TASKS[index + 1 :])


def test_of_a_run_that_is_well_nothing_is_said():
    assert alarms(ROW, TASKS, EXPECTED) == {}


@pytest.mark.parametrize(
    ("changes", "condition", "text"),
    [
        ({"replay/share/b": 0.63}, "replay/share/b", "b makes 63% of the records in the replay; by its games 25%"),
        ({"replay/share/a": 0.76}, "replay/share/a", "a makes 76% of the records in the replay; by its games 50%"),
        ({"learner/sample_share/c": 0.9}, "learner/sample_share/c", "c makes 90% of the samples drawn; by its"),
        ({"learner/q_max": 7.9}, "values", "(largest), returns from -2 to 8; the end of the support cuts them off"),
        ({"learner/q_mean": -1.9}, "values", "values reach from -1.9 (mean)"),
        ({"actors/staleness_p95_versions": 171}, "stale", "parameters 171 or more publications old, where 17 can be"),
    ],
)
def test_a_row_that_is_out_of_bounds_is_named(changes: dict[str, float], condition: str, text: str):
    found = alarms({**ROW, **changes}, TASKS, EXPECTED)
    assert list(found) == [condition]
    assert text in found[condition]


def test_shares_are_weighed_when_the_replay_is_half_full_and_of_several_tasks_only():
    crowded = {**ROW, "replay/share/b": 0.9}
    assert alarms({**crowded, "replay/fill_share": 0.4}, TASKS, EXPECTED) == {}
    one = dataclasses.replace(EXPECTED, games={"b": 4})
    assert alarms({**crowded, "replay/share/b": 1.0, "learner/sample_share/b": 1.0}, TASKS[1:2], one) == {}


@pytest.mark.parametrize(("q_mean", "q_max", "said"), [(-12.1, 0.0, True), (0.0, 18.1, True), (-11.9, 17.9, False)])
def test_values_without_a_support_may_leave_the_range_of_returns_by_its_width(q_mean: float, q_max: float, said: bool):
    free = dataclasses.replace(EXPECTED, distributional=False)
    found = alarms({**ROW, "learner/q_mean": q_mean, "learner/q_max": q_max}, TASKS, free)
    assert list(found) == ["values"] * said
    assert all("values diverge: lower learner.learning_rate" in text for text in found.values())


def test_a_row_without_an_update_has_no_values():
    row = {name: value for name, value in ROW.items() if name != "learner/q_max"}
    assert alarms(row, TASKS, EXPECTED) == {}


@pytest.mark.parametrize(("episodes", "score", "said"), [(30, 0.0, True), (29, 0.0, False), (30, 0.1, False)])
def test_a_task_that_scores_nothing_is_named_after_thirty_episodes(episodes: int, score: float, said: bool):
    found = alarms(ROW, replaced(1, episodes=episodes, score=score), EXPECTED)
    assert found == ({"zero/b": "b scored 0 in each of its last 30 episodes"} if said else {})


@pytest.mark.parametrize(("fill_share", "said"), [(0.54, False), (0.56, True)])
def test_a_game_that_ends_no_episode_is_named_after_two_time_outs(fill_share: float, said: bool):
    row = {**ROW, "replay/share/b": 0.5, "replay/fill_share": fill_share}
    larger = dataclasses.replace(EXPECTED, num_slots=2000)
    found = alarms(row, replaced(1, episodes=0, score=float("nan")), larger)
    text = "b has ended no episode in 560 decisions a game; its time-out is at 275"
    assert found == ({"endless/b": text} if said else {})


def test_a_row_has_the_rates_and_waits_since_the_last_one_and_a_condition_is_said_once(monkeypatch: pytest.MonkeyPatch):
    """Of three games, two play the first task."""
    config = RunConfig(
        name="x",
        tasks=("defend_the_center/default", "defend_the_center/gore"),
        actors=ActorsConfig(num_actors=3, games_per_actor=1),
    )
    learner = SimpleNamespace(num_slots=1000, batch_size=32, num_updates_per_call=1)
    parts: Any = SimpleNamespace(table=config.table, learner=learner, pool_config=SimpleNamespace(ring_capacity=64))
    rows, said, faults, now_s = list[dict[str, float]](), list[str](), list[str](), [100.0]
    telemetry: Any = SimpleNamespace(
        scalars=lambda _, row: rows.append(row),
        task_statuses=tuple,
        fault=lambda fault, **_: faults.append(fault.message),
    )
    progress: Any = SimpleNamespace(say=said.append, show=lambda _: None)
    monkeypatch.setattr(time, "monotonic", lambda: now_s[0])
    metrics = {"learner/loss": 1.0, "replay/fill_share": 0.5, "replay/share/defend_the_center/gore": 0.7}
    monitor = Monitor(config, parts, progress, telemetry, counts := Counts())
    for now_s[0], counts.updates, counts.env_steps, for_space_s, for_records_s in (
        (100.0, 50, 1000, 5.0, 7.0),
        (110.0, 70, 1400, 17.0, 9.5),
        (120.0, 70, 1400, 17.0, 9.5),
    ):
        statistics = PoolStatistics(
            env_steps=counts.env_steps,
            restarts=4,
            actors_ready=3,
            waited_for_space_s=for_space_s,
            waited_for_records_s=for_records_s,
            more={"host/lag_s": 0.5},
        )
        monitor.log(statistics, Staleness(mean=1.5, p95=2, max=3), metrics)
    rates = {
        "learner/updates_per_s": 2.0,
        "learner/samples_per_s": 64.0,
        "actors/decisions_per_s": 40.0,
        "actors/frames_per_s": 160.0,
        "learner/wait_share": 0.25,
        "actors/wait_share": 0.4,
    }
    sizes = {
        "actors/env_steps": 1400,
        "actors/restarts": 4,
        "actors/staleness_mean_versions": 1.5,
        "actors/staleness_p95_versions": 2,
        "actors/staleness_max_versions": 3,
        "run/processor_s": 0.0,
        "host/lag_s": 0.5,
    }
    assert rows[1] == pytest.approx({**rates, **sizes, **metrics})
    assert rows[2] == pytest.approx({**dict.fromkeys(rates, 0.0), **sizes, **metrics})
    text = "defend_the_center/gore makes 70% of the records in the replay; by its games 33% are due"
    assert (said, faults) == ([f"warning: {text}"], [text])
