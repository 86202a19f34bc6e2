"""The policies of a training run as players, read from its run directory.

Nothing that a run directory holds or names is executed or unpickled. Who wants to play an agent that is in a file of
its own names that file.
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

from actors.preprocess import ObservationBatch
from gvz.core.durable import saved_steps
from gvz.core.env_config import Profile
from gvz.core.errors import CheckpointError, ConfigError
from gvz.core.libraries import require_learner
from gvz.core.registry import NO_OWN_FILES, OwnFiles
from gvz.evaluation.episode_log import row_identity
from gvz.evaluation.play import PlayerSpec
from gvz.evaluation.zoo import run_directory
from gvz.run.config import RunConfig
from gvz.run.config_files import config_from_dict
from gvz.run.rundir import no_run
from gvz.segmentation import KEPT_SEGMENTERS, segmenter_file, with_kept_segmenters
from gvz.tasks import Task

if TYPE_CHECKING:
    from gvz.env import DoomEnv
    from gvz.observation import Observation
    from learner.agents.base import Agent, Evaluation


@dataclass(frozen=True, kw_only=True, slots=True)
class Values:
    """An agent's estimates: action values, which are discounted reward to come, or a policy and a value.

    With `agent.scale_rewards` the reward is scaled, by a factor of the task's own.
    """

    q_values: np.ndarray | None
    """f32[A], if the agent has them"""
    probabilities: np.ndarray | None
    """f32[A, N], the distribution of each action's return, if the agent has one"""
    atoms: np.ndarray | None
    """f32[N], the returns that `probabilities` are of"""
    policy: np.ndarray | None
    """f32[A], the probability of each action, if the agent learns a policy"""
    value: float | None
    """of what it sees, if the agent has one; with action values, that of the action it chooses"""


def read_run_config(run_dir: Path, own_files: OwnFiles = NO_OWN_FILES) -> RunConfig:
    """The configuration a run was trained with, and the segmentation networks that the run has kept.

    `own_files` are the Python files of its agent and encoder, if those are none of this package; playing executes them.

    Raises:
        ConfigError: not a run directory, its config.json is damaged, or a file of its own is not given.
    """
    file = run_dir / "config.json"
    try:
        config = config_from_dict(json.loads(file.read_text()), own_files)
    except OSError as error:
        raise no_run(run_dir, error) from error
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{file} cannot be read: {error}") from error
    return dataclasses.replace(config, env=with_kept_segmenters(config.env, run_dir / KEPT_SEGMENTERS))


def check_tasks(config: RunConfig, tasks: Sequence[Task]) -> None:
    """Raises ConfigError for tasks that the run's policy cannot play."""
    trained, scenarios = config.table.ids, config.table.scenarios
    for task in tasks:
        if task.scenario not in scenarios and config.env.action_set != "unified_v1":
            raise ConfigError(
                f"{task.id}: the run was trained on {', '.join(s.id for s in scenarios)}, which has other buttons; "
                "only a run with env.action_set=unified_v1 can play another scenario"
            )
        if config.agent.task_conditioned and task.id not in trained:
            raise ConfigError(
                f"{task.id}: the policy takes the index of one of its {len(trained)} training tasks as input, and this "
                f"is none of them; want some of {', '.join(trained)}"
            )


def check_profile(config: RunConfig, profile: Profile | None) -> None:
    """Raises ConfigError for other rules than those that the run was trained by; None passes."""
    if profile not in (None, config.env.profile):
        raise ConfigError(
            f"--profile: got {profile}, but {config.name} keeps the rules that it was trained by, {config.env.profile}"
        )


def _check_game(config: RunConfig, env: "DoomEnv") -> None:
    """Raises ConfigError for a game that the run's policy cannot play: of such a task, or with other actions or frames
    than those it has learned with.
    """
    check_tasks(config, [env.task])
    for name in ("action_set", "frames", "frame_shape", "buffers"):
        got, want = getattr(env.config, name), getattr(config.env, name)
        if got != want:
            raise ConfigError(
                f"{env.task.id}: the game has {name} {got!r}, but the policy of {config.name} learned with {want!r}; "
                "make it by make_env of what load_player returns, or give evaluate_player env=policy.env"
            )


def find_checkpoints(run_dir: Path, wanted: Sequence[str]) -> list[int]:
    """The chosen policies of a run, as gradient steps, oldest first.

    `wanted` has any of "newest", "all", "last5" (or another number), and numbers of gradient steps.

    Raises:
        ConfigError: none of those, or there is no such policy; lists those there are.
    """
    directory = run_dir / "policies"
    known = saved_steps(directory)
    if not known:
        raise ConfigError(
            f"{directory} holds no policy: a run's first one comes with its first checkpoint, and published results "
            "have records alone (`gvz zoo` lists policies to play)"
        )
    chosen: set[int] = set()
    for text in wanted:
        if last := re.fullmatch(r"last(\d{1,9})", text):
            count = int(last[1])
            if not 1 <= count <= len(known):
                raise ConfigError(
                    f"--checkpoints: got {text}, want last1 to last{len(known)}: {directory} holds {len(known)}"
                )
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


def find_checkpoint(run_dir: Path, wanted: str) -> int:
    """One policy of a run, as gradient steps.

    Raises:
        ConfigError: there is no such policy, or `wanted` is neither "newest" nor one; lists those there are.
    """
    known = {str(steps): steps for steps in find_checkpoints(run_dir, ["all"])}
    if wanted not in ("newest", *known):
        raise ConfigError(
            f"--checkpoint: got {wanted!r}, want newest, or one of those in {run_dir / 'policies'}: {', '.join(known)}"
        )
    return known[wanted] if wanted in known else max(known.values())


def trained_player(run_dir: Path, config: RunConfig, num_updates: int) -> PlayerSpec:
    """The policy of a run after `num_updates` gradient steps. Its parameters are read here, so that damage is reported
    before anything is played.

    Raises:
        CheckpointError: it is damaged, or belongs to another configuration. ConfigError: JAX is not installed.
    """
    _, params = read_params(run_dir, config, num_updates)
    import jax  # not before: reading says on which platform

    digest = hashlib.blake2b(digest_size=8)
    for leaf in jax.tree.leaves(params):
        digest.update(np.asarray(leaf, np.float32).tobytes())
    if config.env.frames == "segmented":
        for scenario in config.table.scenarios:
            digest.update(segmenter_file(scenario.id, config.env).read_bytes())
    name = f"{config.name}/seed_{config.seed}"
    player = {
        "player": f"{name}@{num_updates}",
        "run": config.name,
        "run_seed": config.seed,
        "num_updates": num_updates,
        "params": digest.hexdigest(),
    }
    return PlayerSpec(
        make_player=partial(TrainedPlayer, run_dir, num_updates, config.own_files),
        env=dataclasses.replace(config.env, repeat_action_probability=0.0),  # of training alone
        identity=row_identity(player, config.env),
    )


def load_player(run: str | Path, checkpoint: str | int = "newest", own_files: OwnFiles = NO_OWN_FILES) -> PlayerSpec:
    """A policy to play with: its `make_player` gives the player, its `make_env` the game of a task.

    Args:
        run: a run directory, or "zoo:NAME".
        checkpoint: which of the run's policies: gradient steps, or "newest".
        own_files: as for `read_run_config`.

    Raises:
        ConfigError, CheckpointError: there is no such policy, it is damaged, or JAX is not installed.
    """
    run_dir = run_directory(Path(run))
    return trained_player(run_dir, read_run_config(run_dir, own_files), find_checkpoint(run_dir, str(checkpoint)))


class TrainedPlayer:
    """The policy of a run after `num_updates` gradient steps, greedy and with its noise off.

    Raises:
        ConfigError, CheckpointError: it cannot be read.
    """

    def __init__(self, run_dir: Path, num_updates: int, own_files: OwnFiles = NO_OWN_FILES):
        config = read_run_config(run_dir, own_files)
        agent, params = read_params(run_dir, config, num_updates)
        import jax

        self._params = jax.device_put(params)
        self._evaluate = _jitted(agent)
        self._evaluation: Evaluation | None = None
        self._config, self._table, spec = config, config.table, agent.spec
        self._obs = ObservationBatch(
            1,
            config.env.frame_shape,
            config.agent.stack_size,
            past_actions=spec.num_past_actions,
            variables=config.table.variables if config.agent.game_variables else (),
            action_masks=config.table.action_masks,
        )
        self._action = 0

    @property
    def values(self) -> Values | None:
        """Its estimates when it chose the last action."""
        if self._evaluation is None:
            return None
        action, q_values, probabilities, atoms, policy, value = self._evaluation
        if value is None and q_values is not None:  # the largest may be of an action that the task forbids
            value = np.asarray(q_values)[:, int(action[0])]
        return Values(
            q_values=None if q_values is None else np.asarray(q_values)[0],
            probabilities=None if probabilities is None else np.asarray(probabilities)[0],
            atoms=None if atoms is None else np.asarray(atoms),
            policy=None if policy is None else np.asarray(policy)[0],
            value=None if value is None else float(np.asarray(value)[0]),
        )

    def begin(self, env: "DoomEnv", observation: "Observation", info: dict[str, Any], seed: int) -> None:
        """As `Player.begin`.

        Raises:
            ConfigError: the policy cannot play this game.
        """
        _check_game(self._config, env)
        assert isinstance(observation, np.ndarray)
        self._obs.begin(0, self._task(env), observation, info["variables"])
        if "mask" in self._obs.arrays:
            self._obs.arrays["mask"][0] = env.action_masks()
        self._evaluation = None

    def act(self) -> int:
        evaluation: Evaluation = self._evaluate(self._params, self._obs.arrays)
        self._evaluation = evaluation
        self._action = int(evaluation.action[0])
        return self._action

    def observe(self, observation: "Observation", info: dict[str, Any]) -> None:
        assert isinstance(observation, np.ndarray)
        self._obs.push(0, self._action, observation, info["variables"])

    def _task(self, env: "DoomEnv") -> int:
        """Index of the task that is played; 0 for one that the policy was not trained on, and is not told."""
        return self._table.ids.index(env.task.id) if env.task.id in self._table.ids else 0


@cache
def _jitted(agent: "Agent") -> Any:
    """Compiled once for all checkpoints of a run."""
    import jax

    from learner.observation import Observation

    return jax.jit(lambda params, arrays: agent.evaluate(params, Observation(**arrays)))


def read_params(run_dir: Path, config: RunConfig, num_updates: int) -> "tuple[Agent, Any]":
    require_learner("playing by a trained policy")
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
