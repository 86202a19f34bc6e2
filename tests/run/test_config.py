"""Configurations: found, overridden, saved and compared; everything wrong is said before any process starts."""

import dataclasses
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any, get_args

import pytest

from actors.config import ActorsConfig
from gvz.actions import UNIFIED_V1
from gvz.cluster.config import ClusterConfig
from gvz.core.env_config import EnvConfig
from gvz.core.errors import ConfigError, TaskError
from gvz.launch import main, parse, resumed_config
from gvz.run.config import RunConfig, with_agent, without_effect
from gvz.run.config_files import CONFIG_SCHEMA, config_from_dict, config_to_dict, configs_directory, load_config
from gvz.run.resume import differences
from gvz.run.rundir import RunDir
from gvz.tasks import all_scenarios, scenario_named
from learner.agents.configs.dqn import DQNConfig
from learner.agents.configs.ppo import PPOConfig
from learner.agents.configs.pqn import PQNConfig
from learner.augment import AUGMENTATIONS
from learner.config import Augmentation, LearnerConfig, OnPolicyConfig, ReplayConfig

RESULTS = Path(__file__).parents[2] / "results"
ALL_CONFIGS = sorted(p.stem for p in configs_directory().glob("*.py") if p.stem != "__init__")


@pytest.mark.parametrize("name", ALL_CONFIGS)
def test_every_config_loads_and_survives_json(name):
    config = load_config(name)
    assert config.name == name
    saved = json.loads(json.dumps(config_to_dict(config)))
    assert differences(config_from_dict(saved), config) == []


def test_every_config_loads_in_every_scenario_and_every_committed_run_can_still_be_read():
    for name in ALL_CONFIGS:
        for scenario in all_scenarios():
            assert load_config(name, scenario).name == name
    for file in RESULTS.rglob("config.json"):
        saved = json.loads(file.read_text())
        if saved["schema"] == CONFIG_SCHEMA:
            config_from_dict(saved)


@pytest.mark.parametrize("name", ALL_CONFIGS)
@pytest.mark.parametrize("cores", [1, 3, 96, 512])
def test_every_config_fits_any_number_of_cores(name, cores, monkeypatch):
    """By default there is an actor for each core, unless the replay or the warm-up has no room for their games."""
    monkeypatch.setattr("gvz.run.config.num_cores", lambda: cores)
    config = load_config(name)
    assert len(config.table) <= config.num_lanes
    if config.actors.num_actors is None and cores < 16:
        assert config.num_actors == cores


def test_a_saved_run_has_its_actors_and_games_on_any_machine(tmp_path, monkeypatch):
    """More tasks than one actor of its two has games for; and more games than its replay has room for on 96 cores."""
    for name, flags in (("rainbow_4task", ["--actors.games-per-actor", "2"]), ("rainbow_segmented", [])):
        monkeypatch.setattr("gvz.run.config.num_cores", lambda: 2)
        config = parse(["--config", name, *flags]).run
        saved, numbers = config_to_dict(config), (config.num_actors, config.games_per_actor)
        for cores in (1, 96):
            monkeypatch.setattr("gvz.run.config.num_cores", lambda cores=cores: cores)
            read = config_from_dict(saved)
            assert (read.num_actors, read.games_per_actor) == numbers
            again = parse(["--config", name, *flags]).run
            with RunDir(tmp_path / name) as run:
                run.write_config(read)
                resumed = resumed_config(run, again)
            assert (resumed.num_actors, resumed.games_per_actor) == numbers


def test_the_last_of_two_equal_flags_holds_also_for_what_it_decides():
    """`make train ARGS="--config ..."` gives two."""
    launch = parse(["--config", "rainbow_4task.py", "--config=rainbow_quick.py"])
    assert launch.run == load_config("rainbow_quick")
    launch = parse(["--agent.name", "dqn", "--agent.name", "rainbow"])
    assert launch.run == load_config("rainbow_4task")


def test_numbers_that_the_learner_cannot_count_to_are_refused_at_once():
    for make in (
        lambda: LearnerConfig(target_period_updates=2**31),
        lambda: LearnerConfig(total_updates=2**31),
        lambda: OnPolicyConfig(total_updates=2**31),
    ):
        with pytest.raises(ConfigError, match=r"learner\.\w+_updates: got 2147483648, want 1\.\."):
            make()


@pytest.mark.parametrize(
    ("flags", "setting", "other"),
    [
        ("--agent.epsilon-end 0.1", "agent.epsilon_end: got 0.1", "agent.noisy factorized"),
        ("--agent.noisy off --agent.epsilon-end 0.1", None, None),
        ("--agent.noisy off --agent.noisy-sigma 0.1", "agent.noisy_sigma: got 0.1", "agent.noisy off"),
        ("--agent.num-quantiles 5 --agent.num-atoms 9", "agent.num_atoms: got 9", "agent.num_quantiles 5"),
        ("--agent.no-distributional --agent.num-atoms 9", "agent.num_atoms: got 9", "agent.distributional False"),
        ("--agent.augmentation-strength 0.5", "agent.augmentation_strength: got 0.5", "agent.augmentations ()"),
        ("--agent.augmentation-strength 0.5 --agent.augmentations shift", None, None),
        ("--agent.augmentation-strength 0.5 --agent.sight-weight 1 --agent.sight-augmentations gamma", None, None),
        (
            "--learner.target-ema 0.99 --learner.target-period-updates 5",
            "learner.target_period_updates: got 5",
            "learner.target_ema 0.99",
        ),
        ("--learner.target-period-updates 5", None, None),
        ("--agent.name dqn --agent.epsilon-end 0.1", None, None),
    ],
)
def test_a_run_says_which_settings_have_no_effect(flags, setting, other, tmp_path, monkeypatch, capfd):
    monkeypatch.setattr("gvz.run.train.train", lambda *_: 0)
    assert main([*flags.split(), "--run-dir", str(tmp_path)]) == 0
    said = capfd.readouterr().err
    if setting is None:
        assert said == ""
    else:
        assert said.count("\n") == 1
        assert said.startswith(f"warning: {setting}, which has no effect with {other}; want ")


def test_every_setting_of_a_ready_config_has_an_effect():
    assert {name: found for name in ALL_CONFIGS if (found := without_effect(load_config(name)))} == {}


@pytest.mark.parametrize("field", ["augmentations", "sight_augmentations"])
def test_an_unknown_augmentation_is_refused_at_once(field, capfd):
    with pytest.raises(SystemExit, match="2"):
        main(["--config", "rainbow_quick", "--agent.sight-weight", "0.1", f"--agent.{field}", "shfit"])
    assert "invalid choice 'shfit'" in "".join(capfd.readouterr())


def test_the_names_of_augmentations_are_those_of_its_functions():
    assert get_args(Augmentation) == tuple(AUGMENTATIONS)


def test_the_main_config_plays_the_four_tasks():
    assert list(load_config("rainbow_4task.py").table.ids) == [
        "defend_the_center/default",
        "defend_the_center/gore",
        "defend_the_center/stone_wall",
        "defend_the_center/fast_enemies",
    ]


def test_one_agent_for_all_scenarios_sees_returns_of_one_size_and_each_tasks_actions():
    config = load_config("rainbow_all")
    table = config.table
    assert len(table) == 16
    assert [scenario.id for scenario in table.scenarios] == [
        *("defend_the_center", "dodge_projectiles", "health_gathering", "seek_and_kill")
    ]
    raw = dataclasses.replace(config, agent=dataclasses.replace(config.agent, scale_rewards=False)).table
    assert raw.reward_scales is None
    for row, unscaled in zip(table.rows, raw.rows, strict=True):
        assert max(map(abs, row.return_range)) == pytest.approx(1)
        assert row.return_range == pytest.approx([row.reward_scale * end for end in unscaled.return_range])
        assert [UNIFIED_V1[a] for a in range(21) if row.action_mask[a]] == [
            held for held in UNIFIED_V1 if set(held) <= set(row.task.scenario.buttons)
        ]
    assert table.reward_scales == tuple(row.reward_scale for row in table.rows)
    assert config.support[0] >= -1
    assert config.support[1] <= 1


def test_flags_override_every_field():
    launch = parse(
        "--config rainbow_4task.py --run-dir out --seed 2222 --learner.total-updates 7 --learner.warmup-steps 64 "
        "--learner.batch-size 16 --replay.capacity 1000 --actors.num-actors 2 --actors.games-per-actor 2 --mode sync "
        "--checkpoint.period-updates 5 --scenario seek_and_kill --agent.noisy off --learner.max-grad-norm 10".split()
    )
    run = launch.run
    assert (str(run.run_dir), run.seed, run.mode, run.scenario) == ("out", 2222, "sync", "seek_and_kill")
    assert (run.learner.total_updates, run.learner.batch_size, run.replay.capacity) == (7, 16, 1000)
    assert (run.agent.noisy, run.learner.max_grad_norm, run.checkpoint.period_updates) == ("off", 10.0, 5)
    assert list(run.table.ids) == [f"seek_and_kill/{a}" for a in ("default", "red", "obstacles", "mixed_enemies")]


def test_reward_weights_are_one_field_in_every_form():
    run = parse("--env.reward-weights kill 2 death -1.5".split()).run
    weights = (("death", -1.5), ("kill", 2.0))
    assert run.env.reward_weights == weights
    assert run.env == EnvConfig(reward_weights={"kill": 2, "death": -1.5})  # pyright: ignore[reportArgumentType]
    assert hash(run.env) == hash(EnvConfig(reward_weights=weights))
    saved = config_to_dict(run)
    assert saved["config"]["env"]["reward_weights"] == [["death", -1.5], ["kill", 2.0]]
    assert config_from_dict(json.loads(json.dumps(saved))).env == run.env


def test_a_weight_may_be_of_one_scenario():
    weights = (("kill", 2.0), ("seek_and_kill.moved", 0.0), ("health_gathering.living", 3.0))
    by_scenario = [
        scenario.reward_weights(dict(weights))
        for scenario in map(scenario_named, ("seek_and_kill", "defend_the_center"))
    ]
    assert [(found["kill"], found.get("moved")) for found in by_scenario] == [(2.0, 0.0), (2.0, None)]
    for name in ("defend_the_center", "seek_and_kill"):  # it goes before that of all, in whatever order
        assert scenario_named(name).reward_weights({f"{name}.kill": 5.0, "kill": 1.0})["kill"] == 5.0
        assert scenario_named(name).reward_weights({"kill": 1.0, f"{name}.kill": 5.0})["kill"] == 5.0
    with pytest.raises(TaskError, match="unknown scenario 'seek_an_kill'"):
        scenario_named("defend_the_center").reward_weights({"seek_an_kill.moved": 0.0})
    with pytest.raises(ConfigError, match="unknown component 'move'"):
        scenario_named("defend_the_center").reward_weights({"seek_and_kill.move": 0.0})


def test_the_fewest_warmup_decisions_are_n_steps_a_game():
    flags = "--actors.num-actors 16 --actors.games-per-actor 4 --learner.warmup-steps"
    assert parse([*flags.split(), "192"]).run.num_lanes == 64
    assert parse([*flags.split(), "64", "--agent.n-steps", "1"]).run.num_lanes == 64


def test_tasks_may_be_named():
    run = parse(["--tasks", "defend_the_center/gore", "defend_the_center/gore+mossy_bricks"]).run
    assert list(run.table.ids) == ["defend_the_center/gore", "defend_the_center/gore+mossy_bricks"]
    listed: Any = list(run.tasks or ())
    assert RunConfig(name="listed", tasks=listed).table.ids == run.table.ids


BAD = {
    "--mode sync --actors.inference device": 'actors.inference: got "device" with mode "sync"',
    "--seed -1": "seed: got -1",
    "--learner.batch-size 0": "learner.batch_size: got 0",
    "--learner.warmup-steps 200000": "learner.warmup_steps: got 200000, more than replay.capacity",
    "--learner.warmup-steps 31": "learner.batch_size: got 32, more than the 31 decisions",
    "--max-processor-s 0": "max_processor_s: got 0, want more than 0",
    "--replay.capacity 70 --learner.warmup-steps 64": "replay.capacity: got 70, want at least",
    "--actors.num-actors 2 --agent.past-actions 9 --replay.capacity 415 --learner.warmup-steps 64": (
        "replay.capacity: got 415, want at least 416 for 8 games"
    ),
    "--learner.learning-rate nan": "learner.learning_rate: got nan",
    "--replay.num-newest 32": "replay.num_newest: got 32, want less than learner.batch_size 32",
    "--actors.num-actors 16 --actors.games-per-actor 4 --learner.warmup-steps 191": (
        "learner.warmup_steps: got 191, want at least 192, which is agent.n_steps (3) for each of 64 games"
    ),
    "--tasks defend_the_center/gor": "gore",
    "--tasks defend_the_center/gore --scenario seek_and_kill": "--scenario: got seek_and_kill and also --tasks",
    "--tasks defend_the_center/gore --training-set=4": "--training-set: got 4 and also --tasks",
    "--tasks defend_the_center/gore --training_set 4": "--training-set: got 4 and also --tasks",
    "--config rainbow_all --training-set 8": "--training-set: got 8 and also the tasks of rainbow_all",
    "--config rainbow_all.py --scenario=seek_and_kill": "--scenario: got seek_and_kill and also the tasks of rainbow_a",
    "--tasks defend_the_center/gore health_gathering/lava": "want one scenario",
    "--tasks defend_the_center/gore defend_the_center/gore": "one task twice",
    "--scenario doom": "defend_the_center",
    "--agent.conv-channels 32 --agent.conv-kernels 8 4": "want one equal length",
    "--actors.num-actors 1 --actors.games-per-actor 2": "every task needs a game: want at least 4",
    "--checkpoint.keep 0": "checkpoint.keep: got 0",
    "--checkpoint.period-s nan": "checkpoint.period_s: got nan",
    "--log.period-updates 0": "log.period_updates: got 0",
    "--env.action-set unified_v2": "unified_v1",
    "--env.action-set multi_discrete_v1": "env.action_set: got multi_discrete_v1, want unified_v1",
    "--env.buffers depth": "env.buffers: got ('depth',), want none",
    "--env.frame-skip 99": "env.frame_skip: got 99",
    "--env.reward-weights kil 2": "env.reward_weights: unknown component 'kil' (did you mean 'kill'?)",
    "--env.reward-weights living 1": "env.reward_weights: unknown component 'living'; want some of kill, player_kill",
    "--env.reward-weights kill nan": "env.reward_weights, ('kill', nan): got nan, want a finite float",
    "--env.reward-weights kill 1 kill 2": "env.reward_weights: got kill kill, want each component once",
    "--env.reward-weights kill": "Error parsing --env.reward-weights",
    "--env.reward-weights kill 0 death 0 ammo_spent 0 health_lost 0": "env.reward_weights: got 0 for each of kill,",
    "rainbow_quick": "got 'rainbow_quick' without a flag; to choose a config, give --config rainbow_quick",
    "--name a/b": "name: got 'a/b'",
    "--learner.batch-sizes 3": "batch-size",
    "--learner.batch-size many": "batch-size",
    "--mode fast": "async",
    "--config nope": "there are",
}


@pytest.mark.parametrize("flags", BAD)
def test_a_bad_value_is_refused_by_name_with_exit_code_2(flags, capsys):
    try:
        code = main(flags.split())
    except SystemExit as end:  # tyro's own way out
        code = end.code
    assert code == 2
    assert BAD[flags] in " ".join(re.sub("[│╭╰─╮╯]", " ", capsys.readouterr().err).split())


def test_help_lists_flags_units_and_defaults():
    done = subprocess.run(
        [sys.executable, "-m", "gvz.launch", "--help"], capture_output=True, text=True, timeout=60, check=True
    )
    for part in ("--config", "--fresh", "--run-dir", "--learner.total-updates", "200000", "gradient steps", "--tasks"):
        assert part in done.stdout


@pytest.mark.parametrize(
    ("where", "value", "message"),
    [
        ("config.learner.batchsize", 3, "config.learner.batchsize: unknown key (did you mean 'batch_size'?)"),
        ("config.seed", "x", "config.seed: got 'x', want int"),
        ("config.seed", True, "config.seed: got True, want int"),
        ("config.mode", "x", "config.mode: got 'x', want one of"),
        ("config.agent", 3, "config.agent: got int, want a map"),
        ("config.tasks", 3, "config.tasks: got 3, want a list"),
        ("config.training_set", 4.0, "config.training_set: got 4.0, want one of 1, 4, 8"),
        ("config.training_set", True, "config.training_set: got True, want one of"),
        ("config.training_set", "pair", "config.training_set: got 'pair', want one of 1, 4, 8, pairs, compositions"),
        ("config.learner.learning_rate", 10**400, "config.learner.learning_rate: got 1000"),
        ("config.name", ..., "config.name: missing"),
        ("resolved.num_actors", ..., "resolved.num_actors: missing"),
        ("resolved.num_actors", "2", "resolved.num_actors: got '2', want int"),
        ("resolved.games_per_actor", 10**30, f"actors.games_per_actor: got {10**30}, want 1..65536"),
        ("resolved.tasks", ["seek_and_kill/red"], "resolved.tasks: got ['seek_and_kill/red'], but the configuration"),
    ],
)
def test_a_saved_configuration_that_is_damaged_is_refused(where, value, message):
    saved = part = config_to_dict(load_config("rainbow_4task"))
    *groups, field = where.split(".")
    for group in groups:
        part = part[group]
    if value is ...:
        del part[field]
    else:
        part[field] = value
    with pytest.raises(ConfigError, match=re.escape(message)):
        config_from_dict(saved)


def test_more_games_than_a_record_can_number_are_refused():
    flags = "--actors.num-actors 300 --actors.games-per-actor 300 --replay.capacity 100000000"
    with pytest.raises(ConfigError, match="got 300 times 300 games, want at most 65536"):
        parse(flags.split())


@pytest.mark.parametrize(
    ("saved", "schema"), [({"schema": 1}, "1"), ({"schema": "x"}, "'x'"), ({}, "None"), ([], "None")]
)
def test_another_schema_is_refused(saved, schema):
    with pytest.raises(ConfigError, match=f"got schema {schema}, want a map with schema 2"):
        config_from_dict(saved)


def test_sync_mode_plays_the_same_games_in_one_place():
    flags = "--actors.num-actors 2 --actors.games-per-actor 3".split()
    both = [parse([*flags, "--mode", mode]).run for mode in ("async", "sync")]
    assert [(run.num_actors, run.games_per_actor, run.num_lanes) for run in both] == [(2, 3, 6), (1, 6, 6)]


@pytest.mark.parametrize(
    ("training_set", "actors", "games"),
    [(1, 2, 4), (4, 2, 4), (8, 3, 8), ("compositions", 2, 43), ("compositions", 16, 6), ("compositions", 40, 4)],
)
def test_every_actor_has_every_task_unless_there_are_many(training_set, actors, games):
    """Defend the Center has 86 compositions."""
    run = RunConfig(name="x", training_set=training_set, actors=ActorsConfig(num_actors=actors))
    assert run.games_per_actor == games


def test_games_whose_tasks_change_may_be_fewer_than_tasks(monkeypatch):
    monkeypatch.setattr("gvz.run.config.num_cores", lambda: 1)
    assert parse("--curriculum.kind uniform --actors.games-per-actor 1".split()).run.num_lanes == 1


def test_derived_numbers_are_saved_explicitly():
    on_hosts = RunConfig(name="x", cluster=ClusterConfig(address="10.0.0.1:6379", hosts=3))
    assert config_from_dict(config_to_dict(on_hosts)).num_actors == on_hosts.num_actors
    config = RunConfig(name="x")
    saved = config_from_dict(config_to_dict(config))
    assert saved.actors.num_actors == config.num_actors
    assert (saved.agent.v_min, saved.agent.v_max) == config.support
    assert dataclasses.replace(saved, actors=config.actors, agent=config.agent) == config


def test_an_agent_that_learns_on_policy_brings_its_kind_of_learner():
    run = parse("--agent.name ppo --learner.rollout-steps 64 --agent.clip 0.1 --learner.total-updates 7".split()).run
    assert (run.learner, run.replay) == (OnPolicyConfig(rollout_steps=64, total_updates=7), None)
    assert run.agent == PPOConfig(clip=0.1)
    back = parse("--config pqn_quick --agent.name dqn".split()).run
    assert (back.learner, back.replay) == (LearnerConfig(total_updates=5_000), ReplayConfig())


def test_another_agent_has_its_own_defaults_beside_what_the_config_file_sets():
    quick = load_config("pqn_quick").agent
    assert with_agent(load_config("rainbow_4task"), "pqn").agent == PQNConfig()
    assert with_agent(load_config("rainbow_4task"), "dqn").agent == DQNConfig()
    ppo = with_agent(load_config("pqn_quick"), "ppo").agent
    assert (ppo.encoder, ppo.td_lambda, ppo.conv_channels) == ("nature", PPOConfig().td_lambda, quick.conv_channels)


def test_help_shows_the_options_of_the_runs_learner_alone(capsys):
    for config, theirs, others in (
        ("ppo_quick", "--learner.rollout-steps", "--replay.capacity"),
        ("rainbow_quick", "--replay.capacity", "--learner.rollout-steps"),
    ):
        with pytest.raises(SystemExit):
            parse(["--config", config, "--help"])
        text = capsys.readouterr().out
        assert theirs in text
        assert others not in text
