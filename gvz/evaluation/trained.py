"""The policy of a training run as a player: its configuration and parameters, read from its run directory.

Imports jax, gvz.assemble, gvz.config, learner; nothing in a run directory is executed or unpickled.
"""

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from gvz.config import RunConfig, config_from_dict
from gvz.errors import ConfigError
from gvz.evaluation.players import PlayerSpec
from gvz.tasks import Task


@dataclass(frozen=True, kw_only=True, slots=True)
class TrainedPlayer:
    """A player and what it says of itself in every row it plays."""

    spec: PlayerSpec
    identity: dict[str, Any]
    """player (name, seed and checkpoint), run, run_seed, num_updates, params (a hash of the parameters)"""


def read_run_config(run_dir: Path) -> RunConfig:
    """The configuration a run was trained with.

    Raises:
        ConfigError: not a run directory, or its config.json is damaged.
    """
    file = run_dir / "config.json"
    try:
        return config_from_dict(json.loads(file.read_text()))
    except OSError as error:
        raise ConfigError(f"{run_dir} is not a run directory ({file.name}: {error.strerror})") from error
    except ValueError as error:
        raise ConfigError(f"{file} cannot be read: {error}") from error


def check_tasks(config: RunConfig, tasks: Sequence[Task]) -> None:
    """Raises ConfigError for tasks that the run's policy cannot play."""
    trained = [task.id for task in config.resolved_tasks()]
    for task in tasks:
        if task.scenario != config.resolved_scenario() and config.env.action_set != "unified":
            raise ConfigError(
                f"{task.id}: the run was trained on {config.resolved_scenario().id}, whose buttons are others; "
                "only a run with env.action_set=unified can play another scenario"
            )
        if config.agent.task_conditioned and task.id not in trained:
            raise ConfigError(
                f"{task.id}: the policy is told which of its {len(trained)} training tasks it plays, and this is "
                f"none of them; want some of {', '.join(trained)}"
            )


def read_trained_player(run_dir: Path, config: RunConfig, checkpoint: int | Literal["newest"]) -> TrainedPlayer:
    """The policy of a run at a checkpoint, greedy and with its noise off.

    Args:
        run_dir: of the run.
        config: as `read_run_config` gives it.
        checkpoint: gradient steps of one in `policies/`, or the newest there.

    Raises:
        ConfigError: there is no such policy; lists those there are.
        CheckpointError: it is damaged, or belongs to another configuration.
    """
    # acting is done on the CPU, by the form of the convolutions that is quick there
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    import jax

    from gvz.assemble import run_agent
    from learner import checkpoint as checkpoints
    from learner.policy import export_policy, flatten_params

    policies = run_dir / "policies"
    known = checkpoints.checkpoint_steps(policies)
    if not known:
        raise ConfigError(f"{policies} holds no policy yet; the first comes with the first checkpoint")
    num_updates = known[-1] if checkpoint == "newest" else checkpoint
    if num_updates not in known:
        raise ConfigError(f"--checkpoint: got {num_updates}, want newest or one of {', '.join(map(str, known))}")
    agent = run_agent(config)
    template = jax.eval_shape(agent.init, jax.random.key(0))
    params, _ = checkpoints.read(policies / str(num_updates), template)
    flat = np.asarray(flatten_params(params))
    name = f"{config.name}/seed_{config.seed}"
    return TrainedPlayer(
        spec=PlayerSpec(
            kind="policy",
            policy=export_policy(agent, template, 1, explore=False),
            params=flat,
            obs_shape=agent.spec.obs_shape,
            conditioned_on=tuple(t.id for t in config.resolved_tasks()) if config.agent.task_conditioned else (),
        ),
        identity={
            "player": f"{name}@{num_updates}",
            "run": config.name,
            "run_seed": config.seed,
            "num_updates": num_updates,
            "params": hashlib.blake2b(flat.tobytes(), digest_size=8).hexdigest(),
        },
    )
