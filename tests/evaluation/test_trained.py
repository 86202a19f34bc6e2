"""The policy of a run, read from its directory."""

import dataclasses

import jax
import numpy as np
import pytest

from gvz.assemble import run_agent
from gvz.config import RunConfig
from gvz.errors import CheckpointError, ConfigError
from gvz.evaluation.players import make_player
from gvz.evaluation.trained import check_tasks, read_run_config, read_trained_player
from gvz.rundir import RunDir
from gvz.specs import EnvConfig
from gvz.tasks import named_tasks, parse_task
from learner import checkpoint
from learner.config import AgentConfig
from learner.policy import flatten_params

CONFIG = RunConfig(
    name="small",
    seed=7,
    env=EnvConfig(frame_height=24, frame_width=32, grayscale=True),
    agent=AgentConfig(conv_channels=(4,), conv_kernels=(8,), conv_strides=(4,), hidden_units=8),
)


@pytest.fixture
def run(tmp_path):
    """A run directory with the policies of updates 10 and 20."""
    with RunDir(tmp_path / "run") as directory:
        directory.write_config(CONFIG)
    for step in (10, 20):
        params = run_agent(CONFIG).init(jax.random.key(step))
        checkpoint.write(tmp_path / "run" / "policies" / str(step), checkpoint.snapshot(params), {"num_updates": step})
    return tmp_path / "run"


def test_the_newest_policy_is_read_with_its_name(run):
    trained = read_trained_player(run, read_run_config(run), "newest")
    wanted = flatten_params(run_agent(CONFIG).init(jax.random.key(20)))
    np.testing.assert_array_equal(trained.spec.params, wanted)
    assert trained.identity["player"] == "small/seed_7@20"
    assert (trained.identity["run"], trained.identity["run_seed"], trained.identity["num_updates"]) == ("small", 7, 20)
    assert trained.spec.obs_shape == (24, 32, 4)
    make_player(trained.spec)  # compiles, and fits


def test_other_parameters_are_another_player(run):
    config = read_run_config(run)
    old, new = (read_trained_player(run, config, step).identity for step in (10, 20))
    assert old["params"] != new["params"]
    assert old["player"] == "small/seed_7@10"


def test_a_conditioned_policy_is_told_its_task(run):
    config = dataclasses.replace(CONFIG, agent=dataclasses.replace(CONFIG.agent, task_conditioned=True))
    params = run_agent(config).init(jax.random.key(1))
    checkpoint.write(run / "policies" / "30", checkpoint.snapshot(params), {"num_updates": 30})
    trained = read_trained_player(run, config, "newest")
    assert trained.spec.conditioned_on == tuple(task.id for task in config.resolved_tasks())
    check_tasks(config, config.resolved_tasks())
    with pytest.raises(ConfigError, match="defend_the_center/complete: the policy is told which of its 4"):
        check_tasks(config, [parse_task("defend_the_center/complete")])


def test_a_run_cannot_play_another_scenario_unless_its_buttons_are_unified():
    tasks = named_tasks("seek_and_kill", level=0)
    with pytest.raises(ConfigError, match="seek_and_kill/default: the run was trained on defend_the_center"):
        check_tasks(CONFIG, tasks)
    check_tasks(dataclasses.replace(CONFIG, env=EnvConfig(action_set="unified")), tasks)


def test_what_is_no_run_is_an_error(tmp_path, run):
    with pytest.raises(ConfigError, match="is not a run directory"):
        read_run_config(tmp_path)
    (run / "config.json").write_text("{}")
    with pytest.raises(ConfigError, match=r"config\.json cannot be read"):
        read_run_config(run)


def test_a_policy_that_is_not_there_is_an_error(tmp_path, run):
    with pytest.raises(ConfigError, match="--checkpoint: got 15, want newest or one of 10, 20"):
        read_trained_player(run, CONFIG, 15)
    with pytest.raises(ConfigError, match="holds no policy yet"):
        read_trained_player(tmp_path, CONFIG, "newest")


def test_a_policy_of_another_configuration_is_an_error(run):
    wider = dataclasses.replace(CONFIG, agent=dataclasses.replace(CONFIG.agent, hidden_units=9))
    with pytest.raises(CheckpointError, match="it belongs to another configuration"):
        read_trained_player(run, wider, "newest")
