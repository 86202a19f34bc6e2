"""It learns where the answer is known: small pixel games with known optima, and a probe for each part of Rainbow.

Games are written in JAX (games.py), so that playing, storing and learning run as one compiled loop around the real
replay, train step and agents. Claims are tested with one seed in `make test` and with three in the slow lane.

Every claim was measured with ten seeds under each of three instruction sets, AVX512, AVX2 and SSE4_2, once more without
XLA's optimization, and held in all 60 runs; each test has the worst value of them (`make learning-seeds`; 2026-11-22,
AMD EPYC of model 17, jax 0.10.2).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

from learner import replay, train_step
from learner.agents.base import Agent, AgentSpec, make_agent
from learner.agents.configs.rainbow import RainbowConfig
from learner.config import LearnerConfig, ReplayConfig, ValueConfig, change_agent
from learner.replay import ReplaySpec
from tests import compiling
from tests.learner.games import (
    Game,
    catch,
    deep_sea,
    first_records,
    greedy_returns,
    lottery,
    noisy_rewards,
    observation,
    observe,
    play,
    rare_door,
    records,
    umbrella,
)

pytestmark = pytest.mark.isa


@pytest.fixture
def record_property(record_property: Callable[[str, object], None]) -> Callable[[str, float], None]:
    """As pytest's, for numbers of numpy, too: pytest-xdist sends no others than Python's between its processes."""
    return lambda name, value: record_property(name, float(value))


LANES = 4
OFF = RainbowConfig(
    double=False,
    dueling=False,
    noisy="off",
    distributional=False,
    n_steps=1,
    conv_channels=(8,),
    conv_kernels=(3,),
    conv_strides=(1,),
    conv_form="direct",
    hidden_units=32,
    stack_size=1,
    num_atoms=21,
    epsilon_end=0.05,
)
DQN = change_agent(OFF, "dqn")
RAINBOW = replace(OFF, double=True, dueling=True, noisy="factorized", distributional=True, n_steps=3)
LEARNER = LearnerConfig(learning_rate=2e-3, adam_eps=1e-5, target_period_updates=50)
UNIFORM = ReplayConfig(prioritized=False)
PRIORITIZED = ReplayConfig()


# --- playing and learning -----------------------------------------------------------------------------------------


class Trained(NamedTuple):
    agent: Agent
    params: Any
    returns: np.ndarray
    """undiscounted, of greedy episodes"""


@dataclass(frozen=True)
class Training:
    """One compiled training loop; call it with a seed."""

    game: Game
    config: ValueConfig
    num_updates: int
    learner: LearnerConfig = LEARNER
    replay: ReplayConfig = UNIFORM
    warmup: int = 100
    """rounds in which every lane plays one step before the first update; then there is one update a round"""
    random_warmup: bool = True
    """uniformly random actions in these rounds, as in the trainer; off acts by the agent from the start"""
    capacity: int = 4000
    v_range: tuple[float, float] = (-1.5, 1.5)

    @property
    def agent(self) -> Agent:
        shape, (v_min, v_max) = (*self.game.frame_shape, 1), self.v_range
        spec = AgentSpec(obs_shape=shape, num_actions=self.game.num_actions, num_tasks=1, v_min=v_min, v_max=v_max)
        return make_agent(self.config, spec)

    @property
    def replay_spec(self) -> ReplaySpec:
        return ReplaySpec(
            num_lanes=LANES,
            capacity=self.capacity,
            frame_shape=(*self.game.frame_shape, 1),
            num_tasks=1,
            stack_size=1,
            n_steps=self.config.n_steps,
            discount=self.config.discount,
            priority_exponent=self.replay.priority_exponent,
            min_priority=self.replay.min_priority,
            prioritized=self.replay.prioritized,
            num_newest=0,
        )

    def epsilon(self, round_: Array) -> Array:
        """Linear from start to end over the first half of the updates; 0 with noise."""
        if self.config.epsilon(0) == 0.0:
            return jnp.zeros(())
        progress = jnp.clip((round_ - self.warmup) / (0.5 * self.num_updates), 0.0, 1.0)
        return self.config.epsilon_start + progress * (self.config.epsilon_end - self.config.epsilon_start)

    def __call__(self, seed: int) -> Trained:
        params, returns = compiling.training_loop(train, self)(jax.random.key(seed))
        return Trained(self.agent, params, np.asarray(returns))


def train(training: Training, key: Array) -> tuple[Any, Array]:
    """Plays one step in every lane and makes one update, again and again.

    Returns:
        The parameters and the returns of greedy episodes.
    """
    game, agent, spec = training.game, training.agent, training.replay_spec
    learner_config = replace(training.learner, total_updates=training.num_updates)
    update = train_step.make_train_step(agent, spec, learner_config, training.replay, 1)
    key_learner, key_play, key_reset, key_test = jax.random.split(key, 4)

    def round_(carry, i):
        learner, stored, lanes = carry
        key_act, key_lanes = jax.random.split(jax.random.fold_in(key_play, i))
        action, _ = agent.act(learner.params, key_act, observation(agent, lanes["frame"]), training.epsilon(i))
        if training.random_warmup:
            chance = jax.random.randint(jax.random.fold_in(key_act, 1), (LANES,), 0, game.num_actions)
            action = jnp.where(i < training.warmup, chance, action)
        stored = replay.add(spec, stored, records(lanes, action))
        lanes = play(game, lanes, action, key_lanes)
        learner, stored = jax.lax.cond(
            i >= training.warmup, lambda: update(learner, stored, jnp.ones(1)), lambda: (learner, stored)
        )
        return (learner, stored, lanes), None

    start = (
        train_step.init(agent, spec, learner_config, key_learner),
        replay.init(spec),
        first_records(game, jax.random.split(key_reset, LANES)),
    )
    (learner, _, _), _ = jax.lax.scan(round_, start, jnp.arange(training.warmup + training.num_updates))
    return learner.params, greedy_returns(game, agent, learner.params, key_test)


def q_values(result: Trained, game: Game, **state: int) -> np.ndarray:
    """Q of every action in the given state of a game."""
    frames = observe(game, {name: jnp.asarray(value)[None] for name, value in state.items()})
    return np.asarray(result.agent.evaluate(result.params, observation(result.agent, frames)).q_values[0])


# --- the optimum is reached ---------------------------------------------------------------------------------------

CATCH, CREDIT = catch(), umbrella()


def assert_optimal(training: Training, seed: int, note: Callable[[str, float], None]) -> None:
    returns = training(seed).returns
    note("mean return", returns.mean())
    assert (returns == training.game.optimum).all(), f"mean return {returns.mean()}"


def test_dqn_reaches_the_optimum_of_a_credit_task(learning_seed, record_property):
    """10 of 10 seeds each; 10 of 10 with 667 updates, too."""
    assert_optimal(Training(CREDIT, DQN, 1000), learning_seed, record_property)


def test_rainbow_reaches_the_optimum_of_catch(learning_seed, record_property):
    """10 of 10 seeds each; 10 of 10 with 1000 updates, too."""
    assert_optimal(Training(CATCH, RAINBOW, 1500, replay=PRIORITIZED), learning_seed, record_property)


@pytest.mark.slow
def test_dqn_reaches_the_optimum_of_catch(learning_seed, record_property):
    """10 of 10 seeds each; 10 of 10 with 1000 updates, too."""
    assert_optimal(Training(CATCH, DQN, 1500), learning_seed, record_property)


@pytest.mark.slow
def test_rainbow_reaches_the_optimum_of_a_credit_task(learning_seed, record_property):
    """10 of 10 seeds each; 10 of 10 with 667 updates, too."""
    assert_optimal(Training(CREDIT, RAINBOW, 1000, replay=PRIORITIZED), learning_seed, record_property)


# --- what each part is for ----------------------------------------------------------------------------------------


NOISY_REWARDS = noisy_rewards()


def believed_value(seed: int, *, double: bool) -> float:
    """Mean Q at the first step of a game whose values are all 0.

    A small replay turns over between two copies of the target network, so that what chance made look good to one
    network did not do so to the other: the case that double Q-learning is for. (On one and the same data, online and
    target network err alike, and it makes no difference: measured, at 20,000 records.)
    """
    config = replace(OFF, double=double, epsilon_end=1.0)
    learner = replace(LEARNER, learning_rate=5e-3, target_period_updates=200)
    result = Training(NOISY_REWARDS, config, 2000, learner=learner, capacity=256)(seed)
    return float(q_values(result, NOISY_REWARDS, t=0).mean())


def test_double_q_learning_overestimates_less(learning_seed, record_property):
    """10 of 10 seeds each: plain at least 1.05, and at least 0.37 more than double."""
    plain, double = (believed_value(learning_seed, double=double) for double in (False, True))
    record_property("plain", plain)
    record_property("double", double)
    record_property("plain - double", plain - double)
    assert plain > 0.5
    assert plain > double


DELAYED = umbrella(10, num_actions=16)


def value_error(seed: int, config: ValueConfig) -> float:
    """Mean distance of Q from the known value, over all states after the first step and all actions."""
    result = Training(DELAYED, config, 1200)(seed)
    errors = [
        np.abs(q_values(result, DELAYED, t=t, cue=0, right=right) - (2 * right - 1) * 0.99 ** (9 - t)).mean()
        for t in range(1, 10)
        for right in (0, 1)
    ]
    return float(np.mean(errors))


@pytest.mark.parametrize("part", [{"n_steps": 5}, {"dueling": True}], ids=["n-step returns", "dueling streams"])
def test_values_of_a_delayed_reward_are_learnt_sooner_with(part: dict[str, Any], learning_seed, record_property):
    """n steps carry a reward n states back at once; where 16 actions do the same, a common value learns from all.

    10 of 10 seeds each: the ratio of errors is at most 0.12 with n steps and 0.15 with dueling streams.
    """
    plain, with_part = value_error(learning_seed, OFF), value_error(learning_seed, replace(OFF, **part))
    record_property("without", plain)
    record_property("with", with_part)
    record_property("ratio of errors", with_part / plain)
    assert with_part < 0.5 * plain


LOTTERY = lottery()


def lottery_training(*, distributional: bool) -> Training:
    """Long, slow and with a large replay: what chance paid out lately must not weigh much."""
    config = replace(OFF, distributional=distributional, epsilon_end=0.5)
    learner = replace(LEARNER, learning_rate=5e-4)
    return Training(LOTTERY, config, 3000, learner=learner, v_range=(-1.0, 9.0), capacity=16_000)


def test_the_distributional_loss_learns_what_a_stochastic_reward_is_worth(learning_seed, record_property):
    """10 of 10 seeds each: ticket 1.44 to 1.73, safe 0.50, won 0.179 to 0.216, lost 0.784 to 0.820."""
    result = lottery_training(distributional=True)(learning_seed)
    ticket, safe = q_values(result, LOTTERY, t=0)
    frames = observe(LOTTERY, {"t": jnp.zeros(1, int)})
    evaluation = result.agent.evaluate(result.params, observation(result.agent, frames))
    masses = np.asarray(evaluation.probabilities)[0, 0]
    won, lost = (masses[np.isclose(evaluation.atoms, value, atol=1e-6)].item() for value in (8.0, 0.0))
    for name, value in {"ticket": ticket, "safe": safe, "won": won, "lost": lost}.items():
        record_property(name, value)
    assert ticket == pytest.approx(1.6, abs=0.4)
    assert safe == pytest.approx(0.5, abs=0.1)
    assert won == pytest.approx(0.2, abs=0.06)
    assert lost == pytest.approx(0.8, abs=0.06)


@pytest.mark.slow
def test_the_huber_loss_alone_takes_a_stochastic_reward_for_less(learning_seed, record_property):
    """Where 0.2 * 1 = 0.8 * q its slopes balance: q = 0.25, below the safe 0.5, though the mean is 1.6.

    10 of 10 seeds each: ticket 0.196 to 0.304, safe 0.497 to 0.505.
    """
    result = lottery_training(distributional=False)(learning_seed)
    ticket, safe = q_values(result, LOTTERY, t=0)
    record_property("ticket", ticket)
    record_property("safe", safe)
    assert ticket == pytest.approx(0.25, abs=0.15)
    assert safe == pytest.approx(0.5, abs=0.1)
    assert result.returns.max() == 0.5


SEA = deep_sea()


def test_noise_alone_explores_a_deep_sea(learning_seed, record_property):
    """10 of 10 seeds each; 10 of 10 with 1333 updates, too."""
    config = replace(OFF, noisy="factorized", noisy_sigma=0.1)
    mean = Training(SEA, config, 2000, random_warmup=False)(learning_seed).returns.mean()
    record_property("mean return", mean)
    assert mean == 1.0


@pytest.mark.slow
def test_without_noise_and_epsilon_no_run_crosses_it(learning_seed, record_property):
    """All values start alike, so the first action is the greedy one for ever. 10 of 10 seeds each: mean return 0."""
    config = replace(OFF, epsilon_start=0.0, epsilon_end=0.0)
    mean = Training(SEA, config, 2000, random_warmup=False)(learning_seed).returns.mean()
    record_property("mean return", mean)
    assert mean == 0.0


DOOR = rare_door()


def door_error(seed: int, replay_config: ReplayConfig) -> float:
    """Distance from 1 of the value of a reward that one in 500 episodes offers.

    Priorities decide what is replayed, so the rest is kept out of the way: importance weights, which undo them, and
    Adam's division, which makes one rare gradient as large as many (adam_eps 1 leaves momentum and a plain step).
    """
    learner = replace(LEARNER, learning_rate=0.3, adam_eps=1.0)
    training = Training(DOOR, OFF, 600, learner=learner, replay=replay_config, warmup=2000, capacity=20_000)
    return abs(1.0 - float(q_values(training(seed), DOOR, door=1)[1]))


def test_prioritization_learns_a_rare_reward_sooner(learning_seed, record_property):
    """10 of 10 seeds each: the ratio of errors is at most 0.21."""
    uncorrected = ReplayConfig(importance_sampling_exponent=0.0, importance_sampling_exponent_end=0.0)
    uniform, prioritized = (door_error(learning_seed, config) for config in (UNIFORM, uncorrected))
    record_property("uniform", uniform)
    record_property("prioritized", prioritized)
    record_property("ratio of errors", prioritized / uniform)
    assert prioritized < 0.5 * uniform
