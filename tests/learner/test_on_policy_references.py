"""Updates of PPO and PQN against numbers that published implementations gave: CleanRL's PPO and purejaxql's PQN.

on_policy_references.json has the inputs, the settings by their names, what their functions returned, and which file
of which commit was run. None of their code is here.

The problem: two games of 9 records with 4 pixels each; the second game terminates at its record 4. The network is
out . tanh(hidden . (pixels / 255, 1)). A record's reward is of the step that led to it. "acted" is what acting notes,
by other parameters ("acting_params") than those that learn: values (of PQN the largest outputs) and log-probabilities.
All inputs were drawn once from numpy's default_rng(11), actions uniformly, and rounded. Targets of the step that nobody
took are written as 0.

How their numbers were made: their functions (PPO: get_action_and_value2, compute_gae, ppo_loss, update_ppo; PQN:
_compute_targets, _loss_fn, _learn_phase), with the optimizer that they make, ran in float64 on this network, with
jax 0.10.2 and optax 0.2.8. Every update learns from the whole rollout as one minibatch.

What differs by convention:

* Theirs learns from the step between an episode's final observation and the next one's first (EnvPool resets there),
  which nobody took. Ours weighs it 0. It was left out of their minibatch.
* The value loss of this file of CleanRL is never clipped, whatever its option says: `value_clip` is None. Its learning
  rate falls once a rollout, ours with every update: here it stays. purejaxql's falls with every update, as ours, but
  to 1e-20 instead of 0.
* purejaxql leaves RAdam's epsilon at optax's 1e-8. CleanRL's Adam has 1e-5, which is our default for both.
* purejaxql's pqn_gymnax.py has other targets than its pqn_atari.py, which is meant here: at the last step but one it
  bootstraps from the observation after the rollout, a step too late.

The same in theirs and ours without an option: half the squared error of values, advantages divided by their deviation
in the minibatch (ddof 0) plus 1e-8, means over the minibatch, a target of a terminal step that is its reward alone.
"""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from learner import rollout_step, rollouts, store
from learner.agents.base import AgentSpec, Params
from learner.agents.configs.ppo import PPOConfig
from learner.agents.configs.pqn import PQNConfig
from learner.agents.ppo import PPO
from learner.agents.pqn import PQN
from learner.config import OnPolicyConfig
from learner.observation import Observation
from learner.rollouts import RolloutSpec
from learner.store import Store
from learner.train_step import read_metrics

pytestmark = pytest.mark.isa

THEIRS = json.loads(Path(__file__).with_name("on_policy_references.json").read_text())
B, W, A, UPDATES = 2, 9, 3, 8
SPEC = AgentSpec(obs_shape=(1, 4, 1), num_actions=A, num_tasks=1, v_min=-1.0, v_max=1.0)
LEARNER = OnPolicyConfig(total_updates=UPDATES, rollout_steps=W - 1, num_epochs=UPDATES, num_minibatches=1)


def arrays(numbers: Any) -> dict[str, jax.Array]:
    return {name: jnp.asarray(rows, jnp.float32) for name, rows in numbers.items()}


def outputs(params: Params, obs: Observation) -> jax.Array:
    pixels = obs.frames.reshape(-1, 4).astype(jnp.float32) / 255
    features = jnp.concatenate([pixels, jnp.ones((len(pixels), 1))], axis=1)
    return jnp.tanh(features @ params["hidden"]) @ params["out"]


class SmallPPO(PPO):
    """The value is the last output."""

    def init(self, key: jax.Array) -> Params:
        return arrays(THEIRS["ppo"]["params"])

    def policy(self, params: Params, obs: Observation) -> tuple[jax.Array, jax.Array]:
        found = outputs(params, obs)
        return found[:, :A], found[:, A]


class SmallPQN(PQN):
    def init(self, key: jax.Array) -> Params:
        return arrays(THEIRS["pqn"]["params"])

    def q_values(self, params: Params, obs: Observation) -> jax.Array:
        return outputs(params, obs)


def ppo() -> tuple[PPO, OnPolicyConfig]:
    theirs = THEIRS["ppo"]["settings"]
    config = PPOConfig(
        discount=theirs["gamma"],
        td_lambda=theirs["gae_lambda"],
        clip=theirs["clip_coef"],
        value_clip=None,
        value_weight=theirs["vf_coef"],
        entropy_weight=theirs["ent_coef"],
        normalize_advantages=theirs["norm_adv"],
    )
    learner = replace(
        LEARNER,
        learning_rate=theirs["learning_rate"],
        learning_rate_decay=theirs["anneal_lr"],
        optimizer="adam",
        adam_eps=1e-5,
        max_grad_norm=theirs["max_grad_norm"],
    )
    return SmallPPO(config, SPEC), learner


def pqn() -> tuple[PQN, OnPolicyConfig]:
    theirs = THEIRS["pqn"]["settings"]
    learner = replace(
        LEARNER,
        learning_rate=theirs["LR"],
        learning_rate_decay=theirs["LR_LINEAR_DECAY"],
        optimizer="radam",
        adam_eps=1e-8,
        max_grad_norm=theirs["MAX_GRAD_NORM"],
    )
    return SmallPQN(PQNConfig(discount=theirs["GAMMA"], td_lambda=theirs["LAMBDA"]), SPEC), learner


MAKE = {"ppo": ppo, "pqn": pqn}


@cache
def rollout(name: str) -> tuple[RolloutSpec, Store]:
    """The records, with the values and log-probabilities that were noted when acting."""
    inputs, acted = THEIRS["inputs"], THEIRS[name]["acted"]
    noted = [np.ravel(acted["values"])]
    if name == "ppo":
        noted.append(np.pad(acted["log_probs"], ((0, 0), (0, 1))).ravel())  # the last record's action is not learnt
    spec = RolloutSpec(
        num_lanes=B, capacity=B * W, frame_shape=(1, 4, 1), num_tasks=1, stack_size=1, num_extras=len(noted)
    )
    terminated = np.arange(B * W) == W + 4
    windows: dict[str, Any] = {
        "frames": np.reshape(inputs["pixels"], (B * W, 4)).astype(np.uint8),
        "action": np.ravel(inputs["actions"]).astype(np.int32),
        "reward": np.ravel(inputs["rewards"]).astype(np.float32),
        "task": np.zeros(B * W, np.int32),
        "first": np.roll(terminated, 1),
        "last": terminated,
        "terminated": terminated,
        "vector": np.zeros((B * W, 0), np.float32),
        "extras": np.stack(noted, axis=1).astype(np.float32),
        "heads": np.zeros(B, np.int32),
    }
    return spec, Store(**windows)


def assert_close(ours: Any, theirs: Any, what: str, atol: float = 1e-6) -> None:
    np.testing.assert_allclose(ours, np.asarray(theirs), rtol=1e-5, atol=atol, err_msg=what)


@pytest.mark.parametrize("name", ["ppo", "pqn"])
def test_acting_notes_what_the_published_code_does(name: str):
    """Actions are drawn by another generator than theirs: log-probabilities are compared where both agree."""
    agent, _ = MAKE[name]()
    spec, windows = rollout(name)
    obs = store.observations(spec, jax.tree.map(jnp.asarray, windows), jnp.arange(B * W))
    params = arrays(THEIRS[name]["acting_params"])
    action, extras = agent.act(params, jax.random.key(0), obs, jnp.float32(0.0))
    assert_close(extras[:, 0], windows.extras[:, 0], "values")
    if name == "ppo":
        same = (np.asarray(action) == windows.action) & (windows.extras[:, 1] != 0.0)
        assert same.sum() >= 4
        assert_close(extras[same, 1], windows.extras[same, 1], "log-probabilities")


@pytest.mark.parametrize("name", ["ppo", "pqn"])
def test_targets_are_those_of_the_published_code(name: str):
    agent, _ = MAKE[name]()
    spec, windows = rollout(name)
    steps, _ = rollouts.steps_of(spec, windows)
    targets = agent.targets(steps)
    taken = ~windows.last.reshape(B, W)[:, :-1]
    for what, numbers in THEIRS[name]["targets"].items():
        assert_close(getattr(targets, what).T[taken], np.asarray(numbers)[taken], what)


@pytest.mark.parametrize("name", ["ppo", "pqn"])
def test_updates_are_those_of_the_published_code(name: str, tmp_path: Path):
    """Loss and its parts, gradient, and parameters after 1, 5 and 8 updates.

    The gradient is read from the first moment of (R)Adam, which after one update is a tenth of the clipped gradient.

    Tolerances after 8 updates: PPO's parameters move by 0.1 in the last three of them, PQN's by 0.002. RAdam's
    rectification begins at its sixth update. Its factor is made of a difference of nearly equal numbers, of which
    float32 leaves two digits, in theirs as in ours: run in float32, theirs is 2e-5 away from its own float64.
    """
    agent, config = MAKE[name]()
    spec, windows = rollout(name)
    theirs = THEIRS[name]
    state = jax.jit(lambda key: rollout_step.init(agent, spec, config, key))(jax.random.key(0))
    update = rollout_step.make_update(agent, spec, config)

    state = update(state, windows, jnp.int32(1))
    first = theirs["first_update"]
    metrics, state = read_metrics(state, ["task"], tmp_path)
    for what in first.keys() - {"gradient", "params"}:
        assert_close(metrics[what], first[what], what)
    gradient = {leaf: np.asarray(rows) for leaf, rows in first["gradient"].items()}
    norm = float(np.sqrt(sum(np.sum(rows**2) for rows in gradient.values())))
    most = config.max_grad_norm
    assert most is not None
    assert norm > most, "the gradient is clipped"
    assert_close(metrics["grad_norm"], norm, "grad_norm")
    moment = optax.tree_utils.tree_get(state.opt_state, "mu")
    for leaf, rows in gradient.items():
        assert_close(10.0 * moment[leaf] * (norm / most), rows, f"gradient of {leaf}")
        assert_close(state.params[leaf], first["params"][leaf], f"{leaf} after 1 update")

    for total, more, atol in ((5, 4, 2e-6), (8, 3, {"ppo": 1e-5, "pqn": 1e-4}[name])):
        state = update(state, windows, jnp.int32(more))
        for leaf, rows in theirs[f"params_after_{total}"].items():
            assert_close(state.params[leaf], rows, f"{leaf} after {total} updates", atol)
