"""What a job does next, as the trainer and the evaluation command take it."""

import dataclasses
import json
import re
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import pytest

from gvz.experiments import inventory as progress
from gvz.experiments.base import TrainingRun, experiments
from gvz.experiments.jobs import PlayerJob, RunJob, training_flags
from gvz.experiments.plan import Evaluation
from gvz.experiments.scale import scaled
from gvz.launch import parse
from gvz.run.config import RunConfig
from gvz.run.config_files import config_to_dict, load_config, with_settings

ROOT = Path(__file__).parents[2]
EVALUATION = Evaluation(tasks=("defend_the_center/default",), episodes=2)


@cache
def last_run(name: str, scale: float) -> tuple[TrainingRun, RunConfig]:
    """An experiment's last run, and its flags as the trainer reads them."""
    run = scaled(experiments()[name], scale).runs()[-1]
    return run, parse(training_flags(run, scale)).run


@pytest.mark.parametrize("scale", [1, 0.1, 0.001])
@pytest.mark.parametrize("name", sorted(experiments()))
def test_the_trainer_understands_every_experiment_at_every_scale(name, scale):
    run, config = last_run(name, scale)
    assert tuple(task.id for task in config.table.tasks) == run.tasks
    assert (config.seed, config.learner.total_updates) == (run.seed, run.total_updates)
    assert config.max_processor_s == run.max_processor_s
    if run.max_processor_s is None:
        assert config.checkpoint.period_updates == run.checkpoint_period_updates
    assert config.name == run.agent
    assert config.env.grayscale == run.run_config.env.grayscale
    assert config_to_dict(config)["resolved"]["tasks"] == list(run.tasks)


@pytest.mark.parametrize("scale", [1, 0.001])
@pytest.mark.parametrize("name", sorted(experiments()))
def test_a_trained_run_with_other_settings_is_known(name, scale, tmp_path, monkeypatch):
    monkeypatch.setattr(progress, "run_progress", lambda *_: SimpleNamespace(trained=True))
    run, config = last_run(name, scale)
    job = RunJob(results=tmp_path, run=run, evaluation=EVALUATION, scale=scale)
    assert job.other_settings() == [], "there is no run"
    file = progress.run_directory(tmp_path, run) / "config.json"
    (file.parent / "segmenters").mkdir(parents=True)  # as a run on segmented frames has it
    file.write_text(json.dumps(config_to_dict(config)))
    assert job.other_settings() == []
    saved = json.loads(file.read_text())
    saved["config"]["learner"]["learning_rate"] = 0.123
    file.write_text(json.dumps(saved))
    (changed,) = job.other_settings()
    assert changed.startswith("learner.learning_rate: 0.123 -> ")
    file.write_text("{")
    assert "config.json cannot be read: " in job.other_settings()[0]


@pytest.mark.parametrize(
    ("saved", "used", "changed"),
    [
        (2_700.0, 2_701.0, ["max_processor_s: 2700.0 -> 900.0"]),
        (None, 2_701.0, ["max_processor_s: None -> 900.0"]),
        (900.0, 904.0, []),
        (2_700.0, 500.0, []),  # it had all its gradient steps before
        (400.0, 401.0, []),
    ],
)
def test_a_trained_run_with_more_processor_time_is_known(saved, used, changed, tmp_path, monkeypatch):
    monkeypatch.setattr(progress, "run_progress", lambda *_: SimpleNamespace(trained=True))
    run = experiments()["general_short"].runs()[0]
    job = RunJob(results=tmp_path, run=run, evaluation=EVALUATION, scale=1)
    directory = progress.run_directory(tmp_path, run)
    directory.mkdir(parents=True)
    config = parse(training_flags(run, 1)).run
    actors = dataclasses.replace(config.actors, num_actors=3, games_per_actor=5)  # of another machine
    config = dataclasses.replace(config, max_processor_s=saved, actors=actors)
    (directory / "config.json").write_text(json.dumps(config_to_dict(config)))
    (directory / "metrics.jsonl").write_text(json.dumps({"num_updates": 9, progress.PROCESSOR_S: used}) + "\n")
    assert job.other_settings() == changed


def test_an_agent_and_an_encoder_in_files_are_given_to_the_evaluation(tmp_path):
    agent = tmp_path / "mine.py"
    (text,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "AGENTS.md").read_text(), flags=re.DOTALL)
    agent.write_text(text)
    encoder = tmp_path / "encoder.py"
    quick = dataclasses.replace(
        experiments()["quick_comparison"],
        configs=("dqn_quick",),
        variants={"mine": {"agent.name": str(agent), "agent.encoder": str(encoder)}},
    )
    run = quick.runs()[0]
    directory = progress.run_directory(tmp_path, run)
    for step in run.checkpoints:
        (directory / "policies" / str(step)).mkdir(parents=True)
    (directory / "metrics.jsonl").write_text(json.dumps({"num_updates": run.total_updates}) + "\n")
    following = RunJob(results=tmp_path, run=run, evaluation=EVALUATION, scale=1).outlook().next
    assert following is not None
    assert f" --agent {agent} --encoder {encoder} --tasks " in " ".join(following.arguments)


def test_a_run_is_trained_then_evaluated_where_episodes_are_missing_then_done(tmp_path):
    run = scaled(experiments()["rainbow_evaluation"], 0.0001).runs()[0]
    job = RunJob(results=tmp_path, run=run, evaluation=EVALUATION, scale=0.0001)
    directory = progress.run_directory(tmp_path, run)
    first = job.outlook()
    assert first.next is not None
    assert first.next.step == "train"
    assert first.next.arguments[-2:] == ("--run-dir", str(directory))
    assert (first.begun, first.text) == (False, "0/20 updates, 0/4 episodes")
    for step in run.checkpoints:
        (directory / "policies" / str(step)).mkdir(parents=True)
    row = '{"schema": 1, "num_updates": %d, "task": "defend_the_center/default", "episode": %d}\n'
    (directory / "evaluation.jsonl").write_text(row % (10, 0) + row % (10, 1) + row % (20, 1) + row % (20, 7))
    second = job.outlook()
    assert second.next is not None
    assert second.next.step == "evaluate"
    assert " ".join(second.next.arguments) == (
        f"-m gvz.cli evaluate {directory} --checkpoints 20 --tasks defend_the_center/default --episodes 2"
    )
    assert (second.text, job.done_count("evaluate"), second.next.total) == ("0/20 updates, 3/4 episodes", 4, 5)
    with (directory / "evaluation.jsonl").open("a") as stream:
        stream.write(row % (20, 0))
    assert job.outlook().next is None
    (directory / "policies" / "10").rmdir()  # a checkpoint that could not be saved, and was never evaluated
    (directory / "evaluation.jsonl").write_text(row % (20, 0) + row % (20, 1))
    assert (job.outlook().next, job.outlook().text) == (None, "0/20 updates, 2/4 episodes")


def test_a_variant_s_settings_reach_the_trainer():
    settings = {
        "learner.env_steps_per_update": 16.0,
        "agent.conv_channels": (8, 8),
        "replay.prioritized": False,
        "learner.max_grad_norm": None,
        "learner.target_period_updates": 4_000,
        "env.reward_weights": (("kill", 2.0), ("death", 0.0)),
    }
    quick = dataclasses.replace(experiments()["quick_comparison"], variants={"odd": settings}, max_processor_s=None)
    run = quick.runs()[-1]
    config = parse(training_flags(run, 1)).run
    assert config.name == "rainbow_quick+odd"
    changed = with_settings(load_config("rainbow_quick"), settings)
    assert (config.agent, config.replay, config.env) == (changed.agent, changed.replay, changed.env)
    assert dataclasses.replace(config.learner, total_updates=changed.learner.total_updates) == changed.learner
    assert parse(training_flags(run, 0.5)).run.learner.target_period_updates == 2_000, "a scale shrinks the variant"


def test_a_run_with_a_limit_of_processor_time_counts_seconds_and_keeps_its_config_s_checkpoints(tmp_path):
    run = experiments()["gate_reuse"].runs()[0]
    job = RunJob(results=tmp_path, run=run, evaluation=EVALUATION, scale=1)
    directory = progress.run_directory(tmp_path, run)
    directory.mkdir(parents=True)
    (directory / "metrics.jsonl").write_text('{"num_updates": 900, "run/processor_s": 61.5}\n')
    outlook = job.outlook()
    assert outlook.text == "900 updates in 62/1,200 processor seconds, 0/2 episodes"
    assert outlook.next is not None
    assert (outlook.next.total, outlook.next.unit, job.done_count("train")) == (1_200, "processor seconds", 61)
    assert parse(training_flags(run, 1)).run.checkpoint == load_config("rainbow_4task").checkpoint


def test_a_player_plays_into_its_own_file(tmp_path):
    job = PlayerJob(results=tmp_path, player="idle", evaluation=EVALUATION)
    following = job.outlook().next
    assert following is not None
    assert " ".join(following.arguments) == (
        f"-m gvz.cli evaluate --player idle --out {tmp_path}/players/idle.jsonl "
        "--tasks defend_the_center/default --episodes 2"
    )
    assert not job.outlook().begun


def test_progress_counts_episodes_that_the_plan_does_not_ask_for_on_both_sides(tmp_path):
    """As those of another scenario, played before."""
    file = progress.player_file(tmp_path, "idle")
    file.parent.mkdir()
    row = '{"schema": 1, "task": "%s/default", "episode": %d}\n'
    file.write_text("".join(row % ("seek_and_kill", n) for n in range(5)) + row % ("defend_the_center", 0))
    job = PlayerJob(results=tmp_path, player="idle", evaluation=EVALUATION)
    outlook = job.outlook()
    assert outlook.next is not None
    assert (outlook.text, job.done_count("evaluate"), outlook.next.total) == ("1/2 episodes", 6, 7)
