"""Builds the parts of a run from its configuration: sizes, agent, jitted functions, pool. No loop, no lifetime."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import jax

from actors.inline import InlinePool
from actors.pool import ActorPool, PoolConfig
from gvz.actions import num_actions
from gvz.run.config import RunConfig
from gvz.run.footprint import Footprint
from gvz.scenarios.compiler import compile_task
from learner import replay
from learner.agents.base import Agent, AgentSpec, make_agent
from learner.export import export_policy, layout_hash
from learner.off_policy import OffPolicyParts
from learner.replay import ReplaySpec
from learner.train_step import default_num_updates

Pool = ActorPool | InlinePool

ENV_ENTRY_POINT = "gvz.env:make_env"


@dataclass(frozen=True, kw_only=True, slots=True)
class RunParts:
    """What a run is made of, before anything is started."""

    learner: OffPolicyParts
    pool_config: PoolConfig
    footprint: Footprint


def run_agent(config: RunConfig) -> Agent:
    """The agent of a run, to train it or to read its parameters.

    Raises:
        ConfigError: values that do not fit together.
    """
    scenario = config.resolved_scenario()
    v_min, v_max = config.value_range()
    height, width, channels = config.env.frame_shape
    return make_agent(
        config.agent,
        AgentSpec(
            obs_shape=(height, width, channels * config.agent.stack_size),
            num_actions=num_actions(scenario, config.env.action_set),
            num_tasks=len(config.resolved_tasks()),
            v_min=v_min,
            v_max=v_max,
        ),
    )


def assemble(config: RunConfig, work_dir: Path) -> RunParts:
    """Compiles the maps and works out every size.

    Args:
        config: of the run.
        work_dir: private directory for the actors' logs.

    Raises:
        ConfigError: values that do not fit together.
    """
    tasks = config.resolved_tasks()
    for task in tasks:
        compile_task(task, config.env.profile)  # once, here: the actors find it in the cache
    agent = run_agent(config)
    replay_spec = ReplaySpec(
        num_lanes=config.num_lanes,
        capacity=config.replay.capacity,
        frame_shape=config.env.frame_shape,
        num_tasks=len(tasks),
        stack_size=config.agent.stack_size,
        n_steps=config.agent.n_steps,
        discount=config.agent.discount,
        priority_exponent=config.replay.priority_exponent,
        min_priority=config.replay.min_priority,
        prioritized=config.replay.prioritized,
        num_newest=config.replay.num_newest,
    )
    params = jax.eval_shape(agent.init, jax.random.key(0))
    num_params = sum(leaf.size for leaf in jax.tree.leaves(params))
    pool_config = PoolConfig(
        tasks=tuple(task.id for task in tasks),
        num_actors=config.num_actors,
        games_per_actor=config.games_per_actor,
        seed=config.seed,
        env_entry_point=ENV_ENTRY_POINT,
        env_config=dataclasses.asdict(config.env),
        frame_shape=config.env.frame_shape,
        stack_size=config.agent.stack_size,
        num_actions=agent.spec.num_actions,
        policy=export_policy(agent, params, config.games_per_actor),
        num_params=num_params,
        layout_hash=layout_hash(params),
        actors=config.actors,
        work_dir=work_dir,
    )
    return RunParts(
        learner=OffPolicyParts(
            agent=agent,
            agent_config=config.agent,
            config=config.learner,
            replay_config=config.replay,
            replay_spec=replay_spec,
            num_updates_per_call=default_num_updates(config.learner),
        ),
        pool_config=pool_config,
        footprint=Footprint(
            replay_bytes=replay.memory_bytes(replay_spec),
            replay_on_host=jax.default_backend() == "cpu",
            params_bytes=4 * num_params,
            num_actors=0 if config.mode == "sync" else config.num_actors,
            num_games=config.num_lanes,
            transport_bytes=0 if config.mode == "sync" else pool_config.shared_memory_bytes(),
        ),
    )
