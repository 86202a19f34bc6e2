"""The policies of a training run as players, read from its run directory.

Nothing that a run directory holds or names is executed or unpickled; an agent in a file of its own is asked for by
name.
"""

import dataclasses
import hashlib
import json
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from actors.preprocess import push_frame, start_stack
from gvz.core.errors import CheckpointError, ConfigError
from gvz.evaluation.episode_log import row_identity
from gvz.evaluation.play import PlayerSpec
from gvz.run.config import RunConfig, config_from_dict
from gvz.tasks import Task

if TYPE_CHECKING:
    from gvz.env import DoomEnv
    from gvz.observation import Observation
    from learner.agents.base import Agent, Evaluation


@dataclass(frozen=True, kw_only=True, slots=True)
class Values:
    """What a policy thinks its actions are worth: discounted reward to come."""

    q_values: np.ndarray
    """f32[A]"""
    probabilities: np.ndarray | None
    """f32[A, N], the distribution of each action's return, if the agent has one"""
    atoms: np.ndarray | None
    """f32[N], the returns that `probabilities` are of"""


def read_run_config(run_dir: Path, agent_file: Path | None = None) -> RunConfig:
    """The configuration a run was trained with.

    Args:
        run_dir: of the run.
        agent_file: the Python file of its agent, if that is none of learner/agents; playing executes it.

    Raises:
        ConfigError: not a run directory, its config.json is damaged, or its agent is in a file that is not given.
    """
    file = run_dir / "config.json"
    try:
        config = config_from_dict(json.loads(file.read_text()))
    except OSError as error:
        raise ConfigError(f"{run_dir} is not a run directory ({file.name}: {error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{file} cannot be read: {error}") from error
    if not config.agent.name.endswith(".py"):
        return config
    if agent_file is None:
        raise ConfigError(
            f"{run_dir}: its agent is a Python file ({config.agent.name}), which a run directory alone never gets "
            f"executed; if you trust that file, name it: --agent {config.agent.name}"
        )
    return dataclasses.replace(config, agent=dataclasses.replace(config.agent, name=str(agent_file)))


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


def find_checkpoints(run_dir: Path, wanted: Sequence[str]) -> list[int]:
    """The policies of a run that are asked for, as gradient steps, oldest first.

    Args:
        run_dir: of the run.
        wanted: any of "newest", "all", "last5" (or another number), and numbers of gradient steps.

    Raises:
        ConfigError: none of those, or there is no such policy; lists those there are.
    """
    directory = run_dir / "policies"
    known = sorted(int(p.name) for p in directory.glob("*") if p.is_dir() and p.name.isdecimal())
    if not known:
        raise ConfigError(f"{directory} holds no policy yet; the first comes with the first checkpoint")
    chosen: set[int] = set()
    for text in wanted:
        if last := re.fullmatch(r"last(\d{1,9})", text):
            count = int(last[1])
            if not 1 <= count <= len(known):
                raise ConfigError(f"--checkpoints: got {text}, but {directory} holds {len(known)} policies")
            chosen.update(known[-count:])
        elif text in ("newest", "all"):
            chosen.update(known if text == "all" else known[-1:])
        elif re.fullmatch(r"\d{1,18}", text) and int(text) in known:
            chosen.add(int(text))
        else:
            raise ConfigError(
                f"--checkpoints: got {text!r}, want newest, all, last5 (or another number), or some of those in "
                f"{directory}: {', '.join(map(str, known))}"
            )
    return sorted(chosen)


def trained_player(run_dir: Path, config: RunConfig, num_updates: int) -> PlayerSpec:
    """A policy of a run; its parameters are read, so that damage shows now.

    Args:
        run_dir: of the run.
        config: as `read_run_config` gives it.
        num_updates: gradient steps of one in `policies/`.

    Raises:
        CheckpointError: it is damaged, or belongs to another configuration.
    """
    _, params = _read_params(run_dir, config, num_updates)
    import jax  # not before: reading says on which platform

    digest = hashlib.blake2b(digest_size=8)
    for leaf in jax.tree.leaves(params):
        digest.update(np.asarray(leaf, np.float32).tobytes())
    agent_file = Path(config.agent.name) if config.agent.name.endswith(".py") else None
    name = f"{config.name}/seed_{config.seed}"
    player = {
        "player": f"{name}@{num_updates}",
        "run": config.name,
        "run_seed": config.seed,
        "num_updates": num_updates,
        "params": digest.hexdigest(),
    }
    return PlayerSpec(
        make_player=partial(TrainedPlayer, run_dir, num_updates, agent_file),
        env=config.env,
        identity=row_identity(player, config.env),
    )


class TrainedPlayer:
    """A policy of a run, greedy and with its noise off.

    Args:
        run_dir: of the run.
        num_updates: gradient steps of one in `policies/`.
        agent_file: as of `read_run_config`.

    Raises:
        ConfigError, CheckpointError: it cannot be read.
    """

    def __init__(self, run_dir: Path, num_updates: int, agent_file: Path | None = None):
        config = read_run_config(run_dir, agent_file)
        agent, params = _read_params(run_dir, config, num_updates)
        import jax

        self._params = jax.device_put(params)
        self._evaluate = _jitted(agent)
        self._evaluation: Evaluation | None = None
        self._obs = np.zeros((1, *agent.spec.obs_shape), np.uint8)
        self._task = np.zeros(1, np.int32)
        conditioned = config.agent.task_conditioned
        self._task_ids = [task.id for task in config.resolved_tasks()] if conditioned else None

    @property
    def values(self) -> Values | None:
        """What it thought when it chose the last action."""
        if self._evaluation is None:
            return None
        _, q_values, probabilities, atoms = self._evaluation
        return Values(
            q_values=np.asarray(q_values)[0],
            probabilities=None if probabilities is None else np.asarray(probabilities)[0],
            atoms=None if atoms is None else np.asarray(atoms),
        )

    def begin(self, env: "DoomEnv", observation: "Observation", info: dict[str, Any], seed: int) -> None:
        if self._task_ids is not None:
            self._task[0] = self._task_ids.index(env.task.id)
        assert isinstance(observation, np.ndarray)
        start_stack(self._obs[0], observation)
        self._evaluation = None

    def act(self) -> int:
        evaluation: Evaluation = self._evaluate(self._params, self._obs, self._task)
        self._evaluation = evaluation
        return int(evaluation.action[0])

    def observe(self, observation: "Observation", info: dict[str, Any]) -> None:
        assert isinstance(observation, np.ndarray)
        push_frame(self._obs[0], observation)


@cache
def _jitted(agent: "Agent") -> Any:
    """Compiled once for all checkpoints of a run."""
    import jax

    return jax.jit(agent.evaluate)


def _read_params(run_dir: Path, config: RunConfig, num_updates: int) -> "tuple[Agent, Any]":
    # acting is done on the CPU, by the form of the convolutions that is quick there
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    import jax

    from gvz.run.assemble import run_agent
    from learner import checkpoint

    agent = run_agent(config)
    directory = run_dir / "policies" / str(num_updates)
    try:
        params, _ = checkpoint.read(directory, jax.eval_shape(agent.init, jax.random.key(0)))
    except CheckpointError as error:
        raise CheckpointError(f"{error}; evaluate another with --checkpoints") from error
    return agent, params
