"""What a job does next, as the trainer and the evaluation command take it."""

import pytest

from gvz.experiments import inventory as progress
from gvz.experiments.base import experiments
from gvz.experiments.jobs import PlayerJob, RunJob, training_flags
from gvz.experiments.plan import Evaluation
from gvz.experiments.scale import scaled
from gvz.launch import parse
from gvz.run.config import config_to_dict

EVALUATION = Evaluation(tasks=("defend_the_center/default",), episodes=2)


@pytest.mark.parametrize("scale", [1, 0.1, 0.001])
@pytest.mark.parametrize("name", sorted(experiments()))
def test_the_trainer_understands_every_experiment_at_every_scale(name, scale):
    run = scaled(experiments()[name], scale).runs()[-1]
    config = parse(training_flags(run, scale)).run
    assert tuple(task.id for task in config.resolved_tasks()) == run.tasks
    assert (config.seed, config.learner.total_updates) == (run.seed, run.total_updates)
    assert config.checkpoint.period_updates == run.checkpoint_period_updates
    assert config.name == run.config
    assert config.env.grayscale == (scale < 0.01 or "quick" in run.config)
    assert config_to_dict(config)["resolved"]["tasks"] == list(run.tasks)


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
    (directory / "evaluation.jsonl").write_text(row % (10, 0) + row % (10, 1) + row % (20, 1))
    second = job.outlook()
    assert second.next is not None
    assert second.next.step == "evaluate"
    assert " ".join(second.next.arguments) == (
        f"-m gvz.cli evaluate {directory} --checkpoints 20 --tasks defend_the_center/default --episodes 2"
    )
    assert job.done_count("evaluate") == 3
    with (directory / "evaluation.jsonl").open("a") as stream:
        stream.write(row % (20, 0))
    assert job.outlook().next is None


def test_a_player_plays_into_its_own_file(tmp_path):
    job = PlayerJob(results=tmp_path, player="idle", evaluation=EVALUATION)
    following = job.outlook().next
    assert following is not None
    assert " ".join(following.arguments) == (
        f"-m gvz.cli evaluate --player idle --out {tmp_path}/players/idle.jsonl "
        "--tasks defend_the_center/default --episodes 2"
    )
    assert not job.outlook().begun
