"""A learner over several devices: what is refused. The rest is in sharded.py, for a processor that counts as four."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gvz.core.errors import ConfigError
from gvz.run.config_files import load_config
from learner import sharding, sum_tree
from learner.config import OnPolicyConfig

ROOT = Path(__file__).parents[2]
FAST = "shards_hold or plain_lists or gradient_is or keys_of_their_own or without_a_transition or any_number_of_devices"


@pytest.mark.parametrize(
    "some",
    [
        pytest.param(["-k", f"({FAST}) and not 4"], id="some", marks=pytest.mark.timeout(600)),
        pytest.param([], id="all", marks=[pytest.mark.slow, pytest.mark.timeout(1200)]),
    ],
)
def test_it_holds_on_four_devices(some):
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=4"
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "tests/learner/sharded.py", *some]
    done = subprocess.run(
        command,
        cwd=ROOT,
        env={**os.environ, "XLA_FLAGS": flags},
        capture_output=True,
        text=True,
        timeout=580 if some else 1100,
    )
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("num_groups", [1, 3])
def test_a_tree_of_leaves_is_the_one_that_setting_them_makes(num_groups):
    leaves = np.random.default_rng(0).exponential(size=3 * 301).astype(np.float32)
    wanted = sum_tree.set(sum_tree.init(len(leaves), num_groups), jnp.arange(len(leaves)), jnp.asarray(leaves))
    found = sum_tree.of_leaves(leaves, num_groups)
    np.testing.assert_array_equal(found.nodes, wanted.nodes)
    assert (found.num_leaves, found.num_groups) == (wanted.num_leaves, wanted.num_groups)


def test_more_devices_than_there_are_are_refused_with_advice():
    have = len(jax.local_devices())
    with pytest.raises(ConfigError, match=rf"learner\.devices: got {have + 1}, but JAX sees {have} \(cpu\); lower it"):
        sharding.devices(have + 1)


@pytest.mark.parametrize(
    ("error", "why"),
    [
        (RuntimeError("Unable to initialize backend 'cuda'\n..."), "Unable to initialize"),
        (AssertionError(), "its package"),
    ],
)
def test_devices_that_jax_does_not_find_are_an_error(monkeypatch, error, why):
    def fail() -> None:
        raise error

    monkeypatch.setattr(jax, "local_devices", fail)
    with pytest.raises(ConfigError, match=rf"^JAX_PLATFORMS=.*: JAX finds no such devices \({why}"):
        sharding.devices(1)


@pytest.mark.parametrize(
    ("devices", "changes", "message"),
    [
        (3, {}, r"want a divisor of actors\.num_actors times games_per_actor, which is 4: every device has an equal"),
        (
            4,
            {"learner": {"batch_size": 30}},
            r"learner\.devices: got 4, want a divisor of learner\.batch_size, which is 30",
        ),
        (2, {"replay": {"num_newest": 1}}, r"want a divisor of replay\.num_newest, which is 1"),
    ],
)
def test_what_does_not_divide_is_refused(devices, changes, message):
    config = load_config("rainbow_4task")
    config = replace(config, actors=replace(config.actors, num_actors=1, games_per_actor=4))
    config = replace(config, **{part: replace(getattr(config, part), **values) for part, values in changes.items()})
    with pytest.raises(ConfigError, match=message):
        replace(config, learner=replace(config.learner, devices=devices))


def test_an_agent_that_learns_on_policy_has_one_device():
    with pytest.raises(ConfigError, match=r"learner\.devices: got 2 for an agent that learns on-policy, want 1"):
        OnPolicyConfig(devices=2)
