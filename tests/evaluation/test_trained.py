"""The policy of a run, read from its directory."""

import dataclasses
import hashlib
import json
import pickle
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from gvz.core.env_config import EnvConfig
from gvz.core.errors import CheckpointError, ConfigError
from gvz.core.registry import OwnFiles
from gvz.env import DoomEnv
from gvz.evaluation.choice import EpisodeChoice
from gvz.evaluation.episode_log import evaluate_player
from gvz.evaluation.selection import TaskSelection
from gvz.evaluation.trained import (
    TrainedPlayer,
    check_tasks,
    find_checkpoints,
    load_player,
    read_run_config,
    trained_player,
)
from gvz.run.assemble import run_agent
from gvz.run.config_files import config_to_dict
from gvz.tasks import named_tasks, parse_task
from learner.agents.configs.ppo import PPOConfig
from learner.config import OnPolicyConfig
from learner.export import flatten_params
from learner.observation import Observation
from tests.evaluation.policies import CONFIG, write_policy


@pytest.mark.parametrize(
    ("wanted", "found"),
    [
        (["newest"], [100]),
        (["all"], [10, 20, 100]),
        (["last2"], [20, 100]),
        (["20"], [20]),
        (["newest", "10", "100"], [10, 100]),
    ],
)
def test_checkpoints_are_found_by_name_oldest_first(run, wanted, found):
    assert find_checkpoints(run, wanted) == found


def test_a_checkpoint_that_is_not_there_is_an_error(tmp_path, run):
    with pytest.raises(ConfigError, match=r"--checkpoints: got '15', want newest, all, last5 .*: 10, 20, 100"):
        find_checkpoints(run, ["15"])
    with pytest.raises(ConfigError, match="--checkpoints: got 'latest', want newest"):
        find_checkpoints(run, ["latest"])
    with pytest.raises(ConfigError, match=r"--checkpoints: got last4, want last1 to last3: .*policies holds 3$"):
        find_checkpoints(run, ["last4"])
    with pytest.raises(ConfigError, match="holds no policy: "):
        find_checkpoints(tmp_path, ["newest"])


def test_rows_say_which_parameters_played(run):
    old, new = (trained_player(run, CONFIG, step).identity for step in (10, 20))
    assert (new["player"], new["run"], new["run_seed"], new["num_updates"]) == ("small/seed_7@20", "small", 7, 20)
    assert old["params"] != new["params"]
    flat = np.asarray(flatten_params(write_policy(run, CONFIG, 20)))
    assert new["params"] == hashlib.blake2b(flat.tobytes(), digest_size=8).hexdigest()


def test_rows_by_other_networks_of_segmented_frames_are_another_players(run, tmp_path):
    env = dataclasses.replace(CONFIG.env, grayscale=False, frames="segmented", segmenter=str(tmp_path))
    config = dataclasses.replace(CONFIG, env=env)
    write_policy(run, config, 20)
    network, params = tmp_path / "defend_the_center.onnx", []
    for contents in (b"one", b"another", b"one"):
        network.write_bytes(contents)
        params.append(trained_player(run, config, 20).identity["params"])
    assert params[0] == params[2] != params[1]


@pytest.mark.engine
@pytest.mark.parametrize("conditioned", [False, True])
def test_a_policy_acts_greedily_on_what_it_was_trained_on(run, conditioned):
    """Frames, game variables and past actions, and the task if it is told."""
    agent_config = dataclasses.replace(CONFIG.agent, task_conditioned=conditioned, past_actions=2, game_variables=True)
    config = dataclasses.replace(CONFIG, agent=agent_config)
    params, agent = write_policy(run, config, 30), run_agent(config)
    player = pickle.loads(pickle.dumps(trained_player(run, config, 30))).make_player()
    task = config.table.tasks[1]
    env = DoomEnv(task, config.env)
    frame, info = env.reset(seed=1)
    player.begin(env, frame, info, 1)
    assert player.values is None
    stack, past = [frame] * 4, [-1, -1]
    for _ in range(12):
        observed = Observation(
            frames=jnp.asarray(np.concatenate(stack, axis=-1)[None]),
            vector=jnp.array([[info["variables"][name] for name in config.table.variables]]),
            actions=jnp.array([past]),
            task=jnp.array([int(conditioned)]),
        )
        wanted = agent.evaluate(params, observed)
        action = player.act()
        assert action == int(wanted.action[0]) == int(player.values.q_values.argmax())
        np.testing.assert_allclose(player.values.q_values, wanted.q_values[0], atol=1e-5)
        np.testing.assert_allclose(player.values.probabilities, wanted.probabilities[0], atol=1e-5)
        means = player.values.probabilities @ player.values.atoms
        np.testing.assert_allclose(means, player.values.q_values, atol=1e-4)
        frame, _, _, _, info = env.step(action)
        player.observe(frame, info)
        stack, past = [*stack[1:], frame], [past[1], action]
    assert observed.vector.any()
    env.close()


def test_a_run_cannot_play_another_scenario_unless_its_actions_are_unified():
    tasks = named_tasks("seek_and_kill", level=0)
    with pytest.raises(ConfigError, match="seek_and_kill/default: the run was trained on defend_the_center"):
        check_tasks(CONFIG, tasks)
    check_tasks(dataclasses.replace(CONFIG, env=EnvConfig(action_set="unified_v1")), tasks)


def test_a_run_of_several_scenarios_is_evaluated_on_the_test_tasks_of_each():
    two = ["dodge_projectiles", "seek_and_kill"]
    test = [task for name in two for task in named_tasks(name, split="test")]
    assert list(TaskSelection().of_run(two)) == test
    assert list(TaskSelection(level=0).of_run(two)) == [named_tasks(name, level=0)[0] for name in two]


def test_the_support_of_a_run_follows_from_how_its_games_are_played():
    (scenario,) = CONFIG.table.scenarios
    for changes in ({}, {"frame_skip": 8}, {"profile": "levdoom"}, {"reward_weights": (("kill", 3.0),)}):
        env = dataclasses.replace(CONFIG.env, **changes)
        spec = run_agent(dataclasses.replace(CONFIG, env=env)).spec
        assert (spec.v_min, spec.v_max) == scenario.return_range(env, CONFIG.agent.discount)


def test_the_reward_weights_of_a_run_are_shown_in_its_own_scenario_alone(run):
    env = EnvConfig(action_set="unified_v1", reward_weights=(("kill", 2.0),))
    config = dataclasses.replace(CONFIG, env=env)
    write_policy(run, config, 5)
    its_own, _ = EpisodeChoice(run_dir=run, checkpoint="5").resolve()
    other, _ = EpisodeChoice(run_dir=run, checkpoint="5", task="health_gathering/default").resolve()
    assert (its_own.env, other.env) == (env, dataclasses.replace(env, reward_weights=()))


def test_what_is_no_run_is_an_error(tmp_path, run):
    with pytest.raises(ConfigError, match="is not a run directory"):
        read_run_config(tmp_path)
    (run / "config.json").write_text("{}")
    with pytest.raises(ConfigError, match=r"config\.json cannot be read"):
        read_run_config(run)


def test_a_loaded_player_is_of_one_policy(run):
    wanted = trained_player(run, read_run_config(run), 20)
    for checkpoint in ("20", 20):
        assert load_player(run, checkpoint).identity == wanted.identity
    assert load_player(str(run)).identity["num_updates"] == 100
    with pytest.raises(ConfigError, match=r"--checkpoint: got 'all', want newest, or one of .*20, 100"):
        load_player(run, "all")


@pytest.mark.parametrize(
    ("task", "changes", "message"),
    [
        ("dodge_projectiles/flames", {}, "dodge_projectiles/flames: the run was trained on defend_the_center, which"),
        ("defend_the_center/gore", {"action_set": "combinations"}, "has action_set 'combinations', .* with 'buttons'"),
        ("defend_the_center/gore", {"frame_height": 48}, r"has frame_shape \(48, 32, 1\), .* with \(24, 32, 1\)"),
        ("defend_the_center/gore", {"grayscale": False}, r"has frame_shape \(24, 32, 3\), .* with \(24, 32, 1\)"),
        ("defend_the_center/gore", {"frames": "classes"}, "has frames 'classes', .* learned with 'screen'; make it by"),
        ("defend_the_center/gore", {"buffers": ("depth",)}, r"has buffers \('depth',\), .* learned with \(\)"),
    ],
)
def test_a_policy_refuses_a_game_that_it_cannot_play(run, task, changes, message):
    env = SimpleNamespace(task=parse_task(task), config=dataclasses.replace(CONFIG.env, **changes))
    frame = np.zeros(env.config.frame_shape, np.uint8)
    with pytest.raises(ConfigError, match=message):
        TrainedPlayer(run, 20).begin(env, frame, {"variables": {}}, 1)


def test_a_conditioned_policy_refuses_a_task_that_has_no_index(run):
    config = dataclasses.replace(CONFIG, agent=dataclasses.replace(CONFIG.agent, task_conditioned=True))
    write_policy(run, config, 20)
    player, frame = TrainedPlayer(run, 20), np.zeros(config.env.frame_shape, np.uint8)
    player.begin(SimpleNamespace(task=config.table.tasks[3], config=config.env), frame, {"variables": {}}, 1)
    other = SimpleNamespace(task=parse_task("defend_the_center/complete"), config=config.env)
    with pytest.raises(ConfigError, match="the policy takes the index of one of its 4 training tasks as input"):
        player.begin(other, frame, {"variables": {}}, 1)


@pytest.mark.engine
def test_an_evaluation_in_python_by_other_rules_than_the_policys_is_refused(run, tmp_path):
    policy, file = load_player(run), tmp_path / "mine.jsonl"
    with pytest.raises(ConfigError, match=r"defend_the_center/gore: .* give evaluate_player env=policy\.env"):
        evaluate_player(policy.make_player, ["defend_the_center/gore"], file, name="mine", episodes=1)
    assert file.read_text() == ""
    with (
        pytest.raises(ConfigError, match="seek_and_kill/blue: the run was trained on"),
        policy.make_env("seek_and_kill/blue") as env,
    ):
        policy.make_player().begin(env, *env.reset(seed=1), seed=1)


@pytest.mark.parametrize(
    ("what", "field", "constants"),
    [
        ("encoder", "encoder", {f"learner.encoders.{CONFIG.agent.encoder}": "ENCODER"}),
        ("agent", "name", {"learner.agents.configs.rainbow": "CONFIG", "learner.agents.rainbow": "AGENT"}),
    ],
)
def test_a_python_file_of_a_run_is_executed_only_if_it_is_named(what, field, constants, tmp_path, run):
    source, mark = tmp_path / "theirs.py", tmp_path / "executed"
    imports = [f"from {module} import {name} as {name}\n" for module, name in constants.items()]
    source.write_text("".join([f"open({str(mark)!r}, 'w').close()\n", *imports]))
    config = dataclasses.replace(CONFIG, agent=dataclasses.replace(CONFIG.agent, **{field: str(source)}))
    (run / "config.json").write_text(json.dumps(config_to_dict(config)))
    said = rf"its {what} is a Python file .* if you trust that file, name it: --{what} "
    for read in (lambda: read_run_config(run), lambda: TrainedPlayer(run, 20)):
        with pytest.raises(ConfigError, match=said):
            read()
    assert not mark.exists()
    player_spec = trained_player(run, read_run_config(run, OwnFiles(**{what: source})), 20)
    assert pickle.loads(pickle.dumps(player_spec)).make_player().values is None
    assert mark.exists()


def test_a_damaged_policy_is_an_error_that_names_the_file(run):
    file = next(f for f in (run / "policies" / "20" / "arrays").rglob("*") if f.is_file() and f.stat().st_size > 100)
    file.write_bytes(file.read_bytes()[:-9])
    with pytest.raises(CheckpointError, match=r"policies/20/.*: cut short; evaluate another with --checkpoints"):
        trained_player(run, CONFIG, 20)
    assert trained_player(run, CONFIG, 10).identity["num_updates"] == 10


def test_a_policy_of_another_configuration_is_an_error(run):
    wider = dataclasses.replace(CONFIG, agent=dataclasses.replace(CONFIG.agent, hidden_units=9))
    with pytest.raises(CheckpointError, match="it belongs to another configuration"):
        trained_player(run, wider, 20)


def test_an_agent_with_a_policy_has_probabilities_and_a_value_and_no_action_values(run):
    agent = PPOConfig(conv_channels=(4,), conv_kernels=(8,), conv_strides=(8,), hidden_units=8)
    config = dataclasses.replace(CONFIG, agent=agent, replay=None, learner=OnPolicyConfig())
    params, made = write_policy(run, config, 20), run_agent(config)
    player = TrainedPlayer(run, 20)
    action = player.act()
    wanted = made.evaluate(params, made.spec.zeros())
    assert player.values.q_values is None
    assert action == int(wanted.action[0]) == int(player.values.policy.argmax())
    np.testing.assert_allclose(player.values.policy, wanted.policy[0], atol=1e-5)
    assert player.values.value == pytest.approx(float(wanted.value[0]), abs=1e-5)


def test_an_agent_without_distributions_has_values_alone(run):
    plain = dataclasses.replace(CONFIG, agent=dataclasses.replace(CONFIG.agent, distributional=False))
    write_policy(run, plain, 20)
    player = TrainedPlayer(run, 20)
    action = player.act()
    assert player.values.q_values.shape == (3,)
    assert player.values.q_values.argmax() == action
    assert (player.values.probabilities, player.values.atoms) == (None, None)


def test_the_value_is_that_of_an_action_which_the_task_allows(run):
    """`unified_v1` has 21 actions, of which Defend the Center allows 6. The others were never learned."""
    config = dataclasses.replace(CONFIG, env=dataclasses.replace(CONFIG.env, action_set="unified_v1"))
    write_policy(run, config, 20)
    player, mask = TrainedPlayer(run, 20), np.array(config.table.action_masks[0])
    frame = np.random.default_rng(0).integers(0, 256, config.env.frame_shape, dtype=np.uint8)
    env = SimpleNamespace(task=config.table.tasks[0], config=config.env, action_masks=lambda: mask)
    player.begin(env, frame, {"variables": {}}, 1)
    action = player.act()
    q_values = player.values.q_values
    assert q_values.argmax() in np.flatnonzero(~mask), "the largest is of a forbidden action"
    assert player.values.value == q_values[action] == q_values[mask].max()
    env.action_masks = lambda: ~mask  # as in a scenario that it was not trained on
    player.begin(env, frame, {"variables": {}}, 1)
    assert player.act() == q_values.argmax()
