"""Builds the parts of a run from its configuration: sizes, agent, learner, pool. No loop, no lifetime."""

import dataclasses
import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from actors.inline import InlinePool
from actors.placement import actor_cores, in_words
from actors.pool import Pool, PoolConfig
from actors.process_pool import ProcessPool
from gvz.cluster.config import ClusterConfig
from gvz.core.env_config import SIGHT_CLASSES, SIGHT_COLUMNS
from gvz.run.config import RunConfig, off_policy
from gvz.run.curriculum_config import first_tasks
from gvz.run.footprint import Footprint
from gvz.scenarios.compiler import compile_task
from gvz.segmentation import segmenter_of
from gvz.task_table import TaskTable
from learner.acting import DevicePolicy
from learner.agents.base import Agent, AgentSpec, OffPolicyAgent, OnPolicyAgent, folding, make_agent
from learner.config import OnPolicyConfig, ValueConfig
from learner.contract import check_agent
from learner.export import export_fold, export_policy, layout_hash
from learner.learner import LearnerParts
from learner.off_policy import OffPolicyParts
from learner.on_policy import OnPolicyParts
from learner.replay import ReplaySpec
from learner.rollouts import RolloutSpec
from learner.sharding import devices
from learner.store import StoreSpec
from learner.train_step import default_num_updates

ENV_ENTRY_POINT = "gvz.env:make_env"


@dataclass(frozen=True, kw_only=True, slots=True)
class RunParts:
    """What a run is made of, before anything is started."""

    table: TaskTable
    learner: LearnerParts
    pool_config: PoolConfig
    footprint: Footprint

    def array_shapes(self) -> dict[str, Any]:
        """Shapes and dtypes of the arrays of a whole checkpoint."""
        acting = jax.ShapeDtypeStruct((self.pool_config.num_params,), jnp.float32)
        return {**self.learner.array_shapes(), "acting": acting}

    def make_pool(self, config: RunConfig, state: dict[str, Any] | None) -> Pool:
        """Starts the games: new ones, or from what `Pool.state()` gave."""
        if config.mode == "sync":
            return InlinePool(self.pool_config, state)
        if config.cluster.hosts:
            from gvz.cluster.pool import cluster_pool  # needs the extra `cluster`

            return cluster_pool(self.pool_config, hosts_config(config), state)
        on_device = config.actors.inference == "device"
        return ProcessPool(self.pool_config, state, partial(DevicePolicy, self.learner.agent) if on_device else None)


def run_agent(config: RunConfig) -> Agent:
    """The agent of a run, to train it or to read its parameters.

    Raises:
        ConfigError: values that do not fit together.
    """
    table, observed = config.table, config.agent
    height, width, channels = config.env.frame_shape
    v_min, v_max = table.return_range
    return make_agent(
        config.agent,
        AgentSpec(
            obs_shape=(height, width, channels * observed.stack_size),
            num_actions=table.num_actions,
            num_tasks=len(table),
            v_min=v_min,
            v_max=v_max,
            num_variables=len(table.variables) if observed.game_variables else 0,
            num_past_actions=observed.past_actions,
            num_sights=len(SIGHT_CLASSES) * SIGHT_COLUMNS if observed.learns_sight else 0,
            masked=table.action_masks is not None,
        ),
    )


def assemble(config: RunConfig, work_dir: Path) -> RunParts:
    """Compiles the maps and works out every size; the actors' logs are to go to `work_dir`, a private directory.

    Raises:
        ConfigError: values that do not fit together.
    """
    devices(config.learner.devices)
    table = config.table
    for task in table.tasks:
        compile_task(task, config.env.profile)  # once, here: the actors find it in the cache
    if config.env.frames == "segmented":
        for scenario in table.scenarios:
            segmenter_of(scenario.id, config.env)  # its errors are the run's, not an actor's
    agent = run_agent(config)
    params, num_extras = check_agent(agent, on_policy=config.agent.on_policy)
    spec = agent.spec
    num_params = sum(leaf.size for leaf in jax.tree.leaves(params))
    plays_here = config.mode == "async" and not config.cluster.hosts
    cores = tuple(actor_cores(config.actors.placement, config.num_actors)) if plays_here else ()
    pool_config = PoolConfig(
        tasks=table.ids,
        first_tasks=first_tasks(config.curriculum, table),
        num_actors=config.num_actors,
        games_per_actor=config.games_per_actor,
        seed=config.games_seed,
        env_entry_point=ENV_ENTRY_POINT,
        env_config=dataclasses.asdict(
            dataclasses.replace(config.env, sight=config.env.sight or config.agent.learns_sight)
        ),
        frame_shape=config.env.frame_shape,
        stack_size=config.agent.stack_size,
        past_actions=spec.num_past_actions,
        variables=table.variables if config.agent.game_variables else (),
        num_extras=num_extras,
        num_sights=spec.num_sights,
        action_masks=table.action_masks,
        num_actions=spec.num_actions,
        **_acting(config, agent),
        num_params=num_params,
        layout_hash=layout_hash(params),
        actors=config.actors,
        cores=cores,
        work_dir=work_dir,
    )
    learner = (_on_policy if config.agent.on_policy else _off_policy)(config, agent, pool_config)
    return RunParts(
        table=table,
        learner=learner,
        pool_config=pool_config,
        footprint=Footprint(
            replay_bytes=learner.device_bytes(),
            rollouts_bytes=learner.host_bytes(),
            replay_on_host=jax.default_backend() == "cpu",
            num_devices=config.learner.devices,
            params_bytes=4 * num_params,
            num_actors=config.num_actors if plays_here else 0,
            actors_ask=config.actors.inference == "device",
            num_games=0 if config.cluster.hosts else config.num_lanes,
            transport_bytes=_transport_bytes(config, pool_config),
            placement=in_words(cores) if not config.cluster.hosts else _on_hosts(config),
        ),
    )


def _transport_bytes(config: RunConfig, pool: PoolConfig) -> int:
    """What lies between the games and the learner in this machine's memory."""
    if config.cluster.hosts:
        cluster = hosts_config(config)
        batch = cluster.batch_records * (pool.record_dtype.itemsize + math.prod(pool.frame_shape))
        return cluster.hosts * (cluster.credits + 1) * batch
    return 0 if config.mode == "sync" else pool.shared_memory_bytes()


def hosts_config(config: RunConfig) -> ClusterConfig:
    """The hosts' settings.

    A batch is sorted by game. With more than a rollout of its host's games in it, an on-policy learner would have
    rollouts of half of the games in turn.
    """
    cluster, learner = config.cluster, config.learner
    if not isinstance(learner, OnPolicyConfig):
        return cluster
    of_a_rollout = config.num_lanes // cluster.hosts * learner.rollout_steps
    return dataclasses.replace(cluster, batch_records=min(cluster.batch_records, of_a_rollout))


def _on_hosts(config: RunConfig) -> str:
    return f"on {config.cluster.hosts} hosts {config.num_actors} actors with {config.num_lanes} engines"


def _acting(config: RunConfig, agent: Agent) -> dict[str, Any]:
    """What an actor chooses its actions by, as fields of `Play`: nothing if it asks for them."""
    if config.actors.inference == "device":
        return {"policy": b""}
    acting = agent
    if config.agent.conv_form == "auto":
        acting = make_agent(dataclasses.replace(config.agent, conv_form="paired"), agent.spec)
    params, folder = jax.eval_shape(acting.init, jax.random.key(0)), folding(acting)
    return {
        "policy": export_policy(acting, params, config.games_per_actor),
        "fold": export_fold(acting, params),
        "fold_period_steps": 1 if folder is None else folder.fold_period_steps,
    }


def _off_policy(config: RunConfig, agent: Agent, pool: PoolConfig) -> OffPolicyParts:
    """A learner of n-step transitions from a replay."""
    assert isinstance(agent, OffPolicyAgent)
    learner, replay = off_policy(config)
    spec = ReplaySpec(
        **_store_sizes(config, pool),
        capacity=replay.capacity,
        n_steps=config.agent.n_steps if isinstance(config.agent, ValueConfig) else 1,
        discount=config.agent.discount,
        priority_exponent=replay.priority_exponent,
        min_priority=replay.min_priority,
        prioritized=replay.prioritized,
        equal_shares=replay.equal_shares,
        num_newest=replay.num_newest,
    )
    return OffPolicyParts(
        agent=agent,
        config=learner,
        replay_config=replay,
        replay_spec=spec,
        num_updates_per_call=default_num_updates(learner),
    )


def _on_policy(config: RunConfig, agent: Agent, pool: PoolConfig) -> OnPolicyParts:
    """A learner of rollouts."""
    assert isinstance(agent, OnPolicyAgent)
    assert isinstance(config.learner, OnPolicyConfig)
    sizes = _store_sizes(config, pool)
    window = StoreSpec(**sizes, capacity=0).history + config.learner.rollout_steps
    return OnPolicyParts(
        agent=agent, config=config.learner, spec=RolloutSpec(**sizes, capacity=config.num_lanes * window)
    )


def _store_sizes(config: RunConfig, pool: PoolConfig) -> dict[str, Any]:
    """Fields of `StoreSpec`, but for its capacity."""
    return {
        "num_lanes": config.num_lanes,
        "frame_shape": pool.frame_shape,
        "num_tasks": len(pool.tasks),
        "stack_size": pool.stack_size,
        "num_past_actions": pool.past_actions,
        "num_variables": len(pool.variables),
        "num_extras": pool.num_extras,
        "num_sights": pool.num_sights,
        "action_masks": pool.action_masks,
        "reward_scales": config.table.reward_scales,
    }
