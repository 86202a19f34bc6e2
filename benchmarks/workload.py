"""Workloads of several benchmarks: a drained pool, a full replay, and the number of operations of a network.

All sizes are those of `rainbow_4task`, on one task, so that peers with a single task are comparable.
"""

import contextlib
import dataclasses
import tempfile
import time
from collections.abc import Callable, Generator, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
import psutil

from benchmarks.rounds import Budget, Row, measured

if TYPE_CHECKING:
    from actors.pool import PoolConfig
    from actors.process_pool import ProcessPool
    from gvz.run.assemble import RunParts
    from gvz.run.config import RunConfig
    from gvz.run.config_files import Settings
    from learner.agents.base import Agent
    from learner.replay import ReplaySpec, ReplayState

TASK = "defend_the_center/default"
_START_TIMEOUT_S = 600.0
_DRAIN_RECORDS, _DRAIN_WAIT_S = 256, 0.02
"""as in gvz/run/train.py"""
_UPDATES_IN_FLIGHT = 16
"""calls dispatched to the device before the next wait, so that the clock includes their work"""
_SETTLE_S = 0.3
"""seconds played before the clock starts, so that records waiting in full rings are not counted"""


QUICK: "Settings" = {
    "agent.conv_channels": (4,),
    "agent.conv_kernels": (8,),
    "agent.conv_strides": (8,),
    "agent.hidden_units": 8,
    "agent.dueling": False,
    "agent.distributional": False,
    "agent.noisy": "off",
    "replay.capacity": 2_000,
    "learner.warmup_steps": 100,
    "learner.batch_size": 8,
    "learner.env_steps_per_update": 1.0,
    "actors.num_actors": 1,
    "actors.games_per_actor": 4,
}
"""changes of `rainbow_4task` in a quick run, mainly of parts that XLA compiles slowly"""


def four_task_config(budget: Budget) -> "RunConfig":
    """`rainbow_4task`; a quick run has the smallest network and replay."""
    from gvz.run.config_files import load_config, with_settings

    return with_settings(load_config("rainbow_4task"), QUICK if budget.quick else {})


def quick_flags(budget: Budget) -> tuple[str, ...]:
    """QUICK as words of the command line; none if the budget is full."""
    from gvz.run.config_files import settings_flags

    return settings_flags(QUICK) if budget.quick else ()


def run_config(budget: Budget) -> "RunConfig":
    """`four_task_config` with its default task alone."""
    return dataclasses.replace(four_task_config(budget), training_set=1)


def random_players(config: "PoolConfig") -> "PoolConfig":
    """The same pool without a network: uniformly random actions."""
    return msgspec.structs.replace(config, policy=b"", num_params=0, layout_hash=0)


@contextlib.contextmanager
def assembled(config: "RunConfig") -> "Generator[RunParts]":
    """The parts of a run. Its actors log to a directory that goes with the block."""
    from gvz.run.assemble import assemble

    with tempfile.TemporaryDirectory(prefix="gvz-benchmark-") as directory:
        yield assemble(config, Path(directory) / "work")


@contextlib.contextmanager
def playing(config: "PoolConfig", params: np.ndarray | None = None) -> "Generator[ProcessPool]":
    """A pool whose actors are all ready. It acts with `params` float32[P] if it has a policy."""
    from actors.process_pool import ProcessPool
    from gvz.transport.messages import ParamsHeader

    with ProcessPool(config) as pool:
        if params is not None:
            pool.publish(params, ParamsHeader(version=1, num_updates=0, layout_hash=config.layout_hash))
        deadline = time.monotonic() + _START_TIMEOUT_S
        while pool.statistics().actors_ready < config.num_actors:
            if time.monotonic() > deadline:
                raise TimeoutError(f"pool: {pool.statistics().actors_ready} of {config.num_actors} actors are ready")
            pool.poll()
            time.sleep(0.02)
        yield pool


def decisions_per_s(pool: "ProcessPool", seconds: float) -> float:
    """Plays for `seconds`, including the learner's side of the work: drain and supervision."""

    def play(seconds: float) -> float:
        start, before = time.perf_counter(), pool.statistics().env_steps
        while time.perf_counter() - start < seconds:
            pool.drain(_DRAIN_RECORDS, wait_s=_DRAIN_WAIT_S)
            pool.poll()
        return (pool.statistics().env_steps - before) / (time.perf_counter() - start)

    play(_SETTLE_S)
    return play(seconds)


def processor_times(rounds: int, plays: Mapping[str, Callable[[], float]]) -> list[Row]:
    """Processor time of a decision, by kind of process: a profile without a profiler.

    Args:
        rounds: the candidates alternate in each round.
        plays: each plays for a while in child processes and returns its decisions per second.
    """
    found: dict[str, list[float]] = {}
    for _ in range(rounds):
        for name, play in plays.items():
            for where, seconds in processor_costs(play)[1].items():
                found.setdefault(f"{name}: {where}", []).append(seconds * 1e6)
    return [measured(f"processor time a decision, {name}", "us", values) for name, values in found.items()]


def processor_costs(work: Callable[[], float]) -> tuple[float, dict[str, float]]:
    """(units of work per second, which `work` measures and returns; processor seconds per unit by kind of process)."""
    before, start = processor_s(), time.perf_counter()
    units_per_s = work()
    units = units_per_s * (time.perf_counter() - start)
    return units_per_s, {where: (seconds - before[where]) / units for where, seconds in processor_s().items()}


def processor_s(pid: int | None = None) -> dict[str, float]:
    """Seconds of processor time so far: of the engines, of the actors, and of the process that drains them.

    `pid` is the process that is the parent of all others; default: this one.
    """
    seconds = {"engines": 0.0, "Python": 0.0, "learner's side": 0.0}
    root = psutil.Process(pid)
    for process in (root, *root.children(recursive=True)):
        with contextlib.suppress(psutil.NoSuchProcess):
            times = process.cpu_times()
            where = "learner's side" if process is root else "engines" if process.name() == "vizdoom" else "Python"
            seconds[where] += times.user + times.system
            if process is not root:  # an actor, which may have ended engines and started others
                seconds["engines"] += times.children_user + times.children_system
    return seconds


def filled_replay(spec: "ReplaySpec") -> "ReplayState":
    """A replay full of noise, in episodes of about a hundred records, with a random priority for every leaf."""
    import jax
    import jax.numpy as jnp

    from learner import replay, sum_tree

    @jax.jit
    def fill(key: jax.Array) -> "ReplayState":
        empty, K = replay.init(spec), spec.num_slots
        keys = jax.random.split(key, 4)
        last = jax.random.uniform(keys[0], (K,)) < 0.01
        drawable = ~last & (jnp.arange(K) % spec.lane_capacity < spec.lane_capacity - spec.n_steps)
        priorities = jnp.where(drawable, jax.random.uniform(keys[1], (K,)) + 0.01, 0.0)
        records = dataclasses.replace(
            empty.store,
            frames=jnp.arange(K).astype(jnp.uint8)[:, None] * jnp.uint8(177)
            + jnp.arange(empty.store.frames.shape[1]).astype(jnp.uint8)[None],
            reward=jax.random.uniform(keys[2], (K,)),
            action=jax.random.randint(keys[3], (K,), 0, 3),
            task=jnp.zeros(K, jnp.int32),
            first=jnp.roll(last, 1),
            last=last,
            terminated=last,
        )
        tree = sum_tree.set(empty.tree, jnp.arange(K), priorities)
        return dataclasses.replace(empty, store=records, tree=tree)

    return jax.block_until_ready(fill(jax.random.key(0)))


class Learner:
    """The learner of a run without the run: its state, a full replay, and its jitted functions."""

    def __init__(self, config: "RunConfig", parts: "RunParts"):
        import jax

        from learner import replay
        from learner.export import flatten_params
        from learner.ingest import Ingest
        from learner.off_policy import OffPolicyParts

        assert isinstance(parts.learner, OffPolicyParts)
        self.config, self.parts, self.sizes = config, parts, parts.learner
        self.state = self.sizes.init(jax.random.key(0))
        self.replay = filled_replay(self.sizes.replay_spec)
        self._weights = jax.numpy.ones(self.sizes.replay_spec.num_tasks)
        self._train_steps: dict[int, Any] = {}
        self._add = jax.jit(partial(replay.add, self.sizes.replay_spec), donate_argnums=0)
        self._flatten = jax.jit(flatten_params)
        self._ingest = Ingest(self.sizes.replay_spec)
        self._version = 1

    def acting_params(self) -> np.ndarray:
        """The parameters as actors take them, float32[P]."""
        return np.asarray(self._flatten(self.state.params))

    def updates_per_s(self, per_call: int, seconds: float, pool: "ProcessPool | None" = None) -> float:
        """Gradient steps per second without compilation; with a pool, its records go into the replay meanwhile.

        Args:
            per_call: gradient steps in one jitted call.
            seconds: least length of the measurement; at least one call runs.
            pool: running actors, which are drained, supervised and get new parameters as in a run.
        """
        import jax

        self._update(per_call)
        jax.block_until_ready(self.state.params)
        start, num_updates, published = time.perf_counter(), 0, 0
        while num_updates == 0 or time.perf_counter() - start < seconds:
            if pool is not None:
                self._collect(pool)
            self._update(per_call)
            num_updates += per_call
            period = self.config.learner.publish_period_updates
            if pool is not None and num_updates // period > published // period:
                published = num_updates
                self._publish(pool)
            elif num_updates % (_UPDATES_IN_FLIGHT * per_call) == 0:
                jax.block_until_ready(self.state.num_updates)
        jax.block_until_ready(self.state.params)
        return num_updates / (time.perf_counter() - start)

    def _update(self, per_call: int) -> None:
        from learner import train_step

        if per_call not in self._train_steps:
            sizes = self.sizes
            self._train_steps[per_call] = train_step.make_train_step(
                sizes.agent, sizes.replay_spec, sizes.config, sizes.replay_config, per_call
            )
        self.state, self.replay = self._train_steps[per_call](self.state, self.replay, self._weights)

    def _collect(self, pool: "ProcessPool") -> None:
        for arrays in self._ingest.arrays(pool.drain(_DRAIN_RECORDS), self._version):
            self.replay = self._add(self.replay, arrays)
        pool.poll()

    def _publish(self, pool: "ProcessPool") -> None:
        from gvz.transport.messages import ParamsHeader

        self._version += 1
        header = ParamsHeader(version=self._version, num_updates=0, layout_hash=self.parts.pool_config.layout_hash)
        pool.publish(self.acting_params(), header)

    def flops_per_update(self) -> float:
        """Floating-point operations of loss and gradient of one batch, with plain convolutions."""
        import jax

        from learner import replay
        from learner.agents.base import OffPolicyAgent

        agent, spec, batch_size = direct(self.sizes.agent), self.sizes.replay_spec, self.sizes.batch_size
        batch, _ = jax.eval_shape(
            lambda s, key: replay.sample(spec, s, key, batch_size, 0.5), self.replay, jax.random.key(0)
        )

        assert isinstance(agent, OffPolicyAgent)

        def loss(params: Any, batch: replay.Transitions) -> jax.Array:
            return agent.loss(params, params, jax.random.key(0), batch).loss.mean()

        return flops(jax.grad(loss), self.state.params, batch)


def flops(function: Any, *arguments: Any) -> float:
    """Floating-point operations of one call, as XLA counts them before optimization; arguments may be shapes."""
    import jax

    analysis = jax.jit(function).lower(*arguments).cost_analysis()
    assert analysis is not None, "every backend of XLA counts operations"
    return float(analysis["flops"])


def direct(agent: "Agent") -> "Agent":
    """The same agent with plain convolutions, whose operations define the necessary work."""
    from learner.agents.base import make_agent

    config = agent.config  # pyright: ignore[reportAttributeAccessIssue]  # ours has one, the protocol does not
    return make_agent(dataclasses.replace(config, conv_form="direct"), agent.spec)
