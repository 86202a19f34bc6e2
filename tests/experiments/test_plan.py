"""The grid that was asked for, its shards, and plan.json."""

import dataclasses
import json
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gvz.core.errors import ConfigError
from gvz.experiments.base import experiments
from gvz.experiments.plan import Evaluation, Plan, parse_shard, read_plan, shard, write_plan
from gvz.tasks import scenarios

THESIS = ("training_difficulty", "training_set_size", "algorithm_comparison", "rainbow_evaluation")


def test_a_run_that_experiments_share_is_there_once_and_evaluated_for_all():
    plan = Plan.of(*THESIS)
    ids = [run.id for run in plan.runs()]
    assert len(ids) == len(set(ids)) == 228 + 36 + 12  # the comparison adds DQN alone, the evaluation nothing
    evaluations = plan.evaluations()
    assert evaluations.keys() == set(ids)
    shared = evaluations["rainbow_4task/defend_the_center/train4/seed_1111"]
    assert (len(shared.tasks), shared.episodes) == (18, 100)
    alone = evaluations["rainbow_4task/defend_the_center/train8/seed_1111"]
    assert len(alone.tasks) == 7


def test_players_meet_every_task_that_any_run_is_evaluated_on():
    assert len(Plan.of(*THESIS).players()["random"].tasks) == 76
    assert set(Plan.of("quick_comparison").players()) == {"random", "idle", "scripted"}


def test_scenarios_narrow_every_experiment_and_bring_back_those_a_small_scale_leaves_out():
    plan = Plan.of("training_set_size", scale=0.001, scenarios=("seek_and_kill",))
    assert {run.scenario for run in plan.runs()} == {"seek_and_kill"}


@given(count=st.integers(1, 7), num_items=st.integers(0, 40))
def test_shards_are_disjoint_alike_and_together_everything(count, num_items):
    items = list(range(num_items))
    parts = [shard(items, index, count) for index in range(1, count + 1)]
    assert sorted(item for part in parts for item in part) == items
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


def test_an_evaluation_joined_with_another_has_the_tasks_of_both_and_the_more_episodes():
    both = Evaluation(tasks=("a", "b"), episodes=2).joined(("b", "c"), 5)
    assert both == Evaluation(tasks=("a", "b", "c"), episodes=5)
    assert both.joined(("c",), 1) == both


def test_plan_json_gathers_what_was_asked_for(tmp_path):
    assert read_plan(tmp_path) is None
    write_plan(tmp_path, Plan.of("training_set_size", scale=0.5, scenarios=("seek_and_kill",)))
    both = write_plan(tmp_path, Plan.of("rainbow_evaluation", scale=0.5, scenarios=("health_gathering",)))
    assert {(e.name, e.scenarios) for e in both.experiments()} == {
        ("training_set_size", ("seek_and_kill",)),
        ("rainbow_evaluation", ("health_gathering",)),
    }
    assert read_plan(tmp_path) == both
    more = write_plan(tmp_path, Plan.of("training_set_size", scale=0.5, scenarios=("dodge_projectiles",)))
    assert more.asked["training_set_size"] == ("seek_and_kill", "dodge_projectiles")
    assert write_plan(tmp_path, Plan.of("training_set_size", scale=0.5)).asked["training_set_size"] is None
    assert write_plan(tmp_path, Plan.of("training_set_size", scale=0.5, scenarios=("seek_and_kill",))).asked == {
        "training_set_size": None,
        "rainbow_evaluation": ("health_gathering",),
    }
    assert {p.name for p in tmp_path.iterdir()} == {"plan.json", ".plan.lock"}


@pytest.mark.parametrize("first", [None, ("seek_and_kill",)])
def test_at_a_scale_that_takes_one_scenario_a_further_one_can_be_asked_for(tmp_path, first):
    later = ("seek_and_kill",) if first is None else None
    for chosen in (first, later, later, first):
        write_plan(tmp_path, Plan.of("rainbow_evaluation", scale=0.001, scenarios=chosen))
    plan = read_plan(tmp_path)
    assert {run.scenario for run in plan.runs()} == {"defend_the_center", "seek_and_kill"}


@pytest.mark.parametrize(
    ("experiments", "message"),
    [
        ({"gate_old": None, "gate_ammo": None}, "unknown experiment 'gate_old'"),
        ({"gate_ammo": ["seek_and_kil"]}, "unknown scenario 'seek_and_kil'"),
    ],
)
def test_a_plan_of_what_is_not_there_is_named_with_its_file(tmp_path, experiments, message):
    (tmp_path / "plan.json").write_text(json.dumps({"schema": 2, "scale": 1.0, "experiments": experiments}))
    with pytest.raises(ConfigError, match=rf"plan\.json: {message}.*; mend it there, or move"):
        read_plan(tmp_path)


def test_commands_that_start_at_once_all_get_into_the_plan(tmp_path, monkeypatch):
    def read_slowly(results):
        found = read_plan(results)
        time.sleep(0.05)  # long enough for all others to read the same plan
        return found

    monkeypatch.setattr("gvz.experiments.plan.read_plan", read_slowly)
    plans = [Plan.of("rainbow_evaluation", scenarios=(name,)) for name in scenarios()]
    with ThreadPoolExecutor(len(plans)) as pool:
        list(pool.map(write_plan, [tmp_path] * len(plans), plans))
    assert set(read_plan(tmp_path).asked["rainbow_evaluation"]) == set(scenarios())


def test_scales_are_not_mixed(tmp_path):
    write_plan(tmp_path, Plan.of("rainbow_evaluation"))
    with pytest.raises(
        ConfigError, match=r"--scale: got 0.5, but the results there have 1, and scales cannot be mixed"
    ):
        write_plan(tmp_path, Plan.of("rainbow_evaluation", scale=0.5))


@pytest.mark.parametrize("text", ["", "{}", '{"schema": 2}', "[]"])
def test_a_damaged_plan_is_named(tmp_path, text):
    (tmp_path / "plan.json").write_text(text)
    with pytest.raises(ConfigError, match=r"plan\.json cannot be read: .*; move it aside to make a new plan"):
        read_plan(tmp_path)


def test_a_plan_of_another_schema_is_refused(tmp_path):
    (tmp_path / "plan.json").write_text(json.dumps({"schema": 1, "experiments": ["general"], "scale": 1.0}))
    with pytest.raises(ConfigError, match=r"plan\.json: schema 1, want 2"):
        read_plan(tmp_path)


def test_a_results_directory_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=r"--results: .*file/results cannot be written: Not a directory"):
        write_plan(tmp_path / "file" / "results", Plan.of("rainbow_evaluation"))


@pytest.mark.parametrize("text", ["", "3", "0/2", "3/2", "1/0", "a/b", "-1/2"])
def test_a_bad_shard_is_refused(text):
    with pytest.raises(ConfigError, match=rf"--shard: got '{text}', want i/n with i from 1 to n"):
        parse_shard(text)


def test_a_shard_is_two_numbers():
    assert parse_shard("2/3") == (2, 3)


@pytest.mark.parametrize(
    ("names", "chosen", "message"),
    [
        ((), None, "experiments: got none, want at least one name"),
        (("nope",), None, "unknown experiment 'nope'"),
        (("quick_comparison",), ("nope",), "unknown scenario 'nope'"),
        (
            ("quick_comparison",),
            ("seek_and_kill",),
            "--scenario: got seek_and_kill, but quick_comparison has defend_the_center",
        ),
    ],
)
def test_a_plan_that_cannot_be_run_is_refused(names, chosen, message):
    with pytest.raises(ValueError, match=message):
        Plan.of(*names, scenarios=chosen)


def test_two_experiments_that_want_one_run_differently_are_refused():
    full = experiments()["rainbow_evaluation"]
    experiments()["rainbow_evaluation_twice"] = dataclasses.replace(full, total_updates=400_000)
    try:
        with pytest.raises(
            ConfigError, match=r"run rainbow_4task/.* is to have 400000 gradient steps .* gives it 200000"
        ):
            Plan.of("rainbow_evaluation", "rainbow_evaluation_twice")
    finally:
        del experiments()["rainbow_evaluation_twice"]
