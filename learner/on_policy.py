"""The learner of rollouts: records -> windows -> gradient steps, and the records are dropped. No replay, no warm-up.

An update learns from one rollout (`learner.rollouts`). While it runs on the device, actors go on playing by the
parameters before it, and the records wait in windows and rings; how old the actions of a rollout are is in the metrics.
In sync mode nothing is played meanwhile: all actions of a rollout are of the newest parameters, but for each window's
first one, which was chosen with the record that ended the window before.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gvz.transport.messages import StepBlock
from learner import rollout_step, rollouts
from learner.agents.base import OnPolicyAgent, Params
from learner.checkpoint import Restored
from learner.config import OnPolicyConfig
from learner.export import flatten_params
from learner.ingest import Ingest, Staleness
from learner.rollouts import Rollouts, RolloutSpec
from learner.train_step import LearnerState, check_finite, read_metrics


@dataclass(frozen=True, kw_only=True, slots=True)
class OnPolicyParts:
    """What an `OnPolicyLearner` is made of (`LearnerParts`)."""

    agent: OnPolicyAgent
    config: OnPolicyConfig
    spec: RolloutSpec

    def array_shapes(self) -> dict[str, Any]:
        return {
            "learner": jax.eval_shape(self.init, jax.random.key(0)),
            "rollouts": rollouts.array_shapes(self.spec),
        }

    @property
    def num_slots(self) -> int:
        return self.spec.num_windows * self.spec.lane_capacity

    @property
    def batch_size(self) -> int:
        return rollout_step.batch_size(self.spec, self.config)

    @property
    def num_updates_per_call(self) -> int:
        return self.config.updates_per_rollout

    def device_bytes(self) -> int:
        """Of the rollout that is learnt from: half of the windows."""
        return rollouts.memory_bytes(self.spec) // 2

    def host_bytes(self) -> int:
        """Of the windows."""
        return rollouts.memory_bytes(self.spec)

    def init(self, key: jax.Array) -> LearnerState:
        """The state before the first update."""
        return rollout_step.init(self.agent, self.spec, self.config, key)

    def make(
        self, key: jax.Array, tasks: Sequence[str], diagnostics_dir: Path, restored: Restored | None = None
    ) -> "OnPolicyLearner":
        return OnPolicyLearner(self, key, tasks, diagnostics_dir, restored)


class OnPolicyLearner:
    """PPO, PQN and whatever else learns from what it has just played."""

    def __init__(
        self,
        parts: OnPolicyParts,
        key: jax.Array,
        tasks: Sequence[str],
        diagnostics_dir: Path,
        restored: Restored | None = None,
    ):
        """As `LearnerParts.make`."""
        self._parts, self._tasks, self._diagnostics_dir = parts, tuple(tasks), diagnostics_dir
        self._update = rollout_step.make_update(parts.agent, parts.spec, parts.config)
        self._flatten = jax.jit(flatten_params)
        self._ingest, self._rollouts = Ingest(parts.spec), Rollouts(parts.spec)
        self._params_version, self._num_updates = 0, 0
        self._ages: list[np.ndarray] = []
        if restored is None:
            self._state = jax.jit(parts.init)(key)
        else:
            arrays, state = restored.arrays, restored.host
            # copies: a borrowed buffer cannot be donated
            self._state = jax.tree.map(jnp.array, arrays["learner"])
            self._ingest.restore(state["ingest"])
            self._rollouts.restore(arrays["rollouts"], state["rollouts"])
            self._params_version, self._num_updates = state["params_version"], state["num_updates"]

    @property
    def params(self) -> Params:
        average = self._state.average_params
        return self._state.params if average is None else average

    def num_steps_allowed(self) -> int:
        return self._rollouts.num_records_allowed()

    def add(self, blocks: Sequence[StepBlock], params_version: int) -> int:
        self._ingest.check(blocks, params_version)
        self._rollouts.add(blocks)
        self._params_version = params_version
        return self._ingest.take_env_steps()

    def add_episode(self, task: int, normalized_score: float) -> None:
        """Scores weigh nothing here."""

    def can_update(self) -> bool:
        return self._rollouts.num_missing == 0

    def update(self) -> int:
        """Learns from a rollout, if it is complete: all its gradient steps, or as many as the run still has."""
        config = self._parts.config
        count = min(config.updates_per_rollout, config.total_updates - self._num_updates)
        if not self.can_update() or count == 0:
            return 0
        windows, ages = self._rollouts.take(self._params_version)
        self._state = self._update(self._state, windows, jnp.int32(count))
        self._num_updates += count
        self._ages.append(ages)
        return count

    def epsilon(self, env_steps: int) -> float:
        """The agent's, from the first decision on."""
        return self._parts.agent.epsilon(env_steps)

    def acting_params(self) -> jax.Array:
        return self._flatten(self._state.params)

    def take_metrics(self) -> dict[str, float]:
        """Means of the updates as `learner/...`, ages of the actions learnt from as `rollout/...`, and the fill."""
        means, self._state = read_metrics(self._state, self._tasks, self._diagnostics_dir)
        ages = np.concatenate([np.zeros(0, np.int64), *self._ages])
        self._ages = []
        metrics = {f"learner/{name}": value for name, value in means.items()}
        metrics["replay/fill_share"] = self._rollouts.fill_share()
        if ages.size:
            metrics |= {"rollout/age_mean_versions": float(ages.mean()), "rollout/age_max_versions": float(ages.max())}
        return metrics

    def take_staleness(self) -> Staleness:
        return self._ingest.take_staleness()

    def check_finite(self) -> None:
        check_finite(self._state, self._diagnostics_dir)

    def arrays(self) -> dict[str, Any]:
        return {"learner": self._state, "rollouts": self._rollouts.arrays()}

    def state(self) -> dict[str, Any]:
        return {
            "ingest": self._ingest.state(),
            "rollouts": self._rollouts.state(),
            "params_version": self._params_version,
            "num_updates": self._num_updates,
        }
