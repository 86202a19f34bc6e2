"""The learner of transitions from a replay: records -> replay -> gradient steps -> priorities.

Nothing here waits for the device but `take_metrics` and `check_finite`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gvz.transport.messages import StepBlock
from learner import replay, store, train_step
from learner.agents.base import Params
from learner.checkpoint import Restored
from learner.export import flatten_params
from learner.ingest import Ingest, Staleness
from learner.kpi import TaskKpis
from learner.limiter import RateLimiter
from learner.sharding import Learning, placement


@dataclass(frozen=True, kw_only=True, slots=True)
class OffPolicyParts(Learning):
    """What an `OffPolicyLearner` is made of (`LearnerParts`)."""

    num_updates_per_call: int
    """gradient steps in one jitted call"""

    def array_shapes(self) -> dict[str, Any]:
        return {
            "learner": jax.eval_shape(self.init, jax.random.key(0)),
            "replay": jax.eval_shape(lambda: replay.init(self.replay_spec)),
        }

    @property
    def num_slots(self) -> int:
        return self.replay_spec.num_slots

    @property
    def batch_size(self) -> int:
        return self.config.batch_size

    def device_bytes(self) -> int:
        return replay.memory_bytes(self.replay_spec)

    def host_bytes(self) -> int:
        return 0

    def make(
        self, key: jax.Array, tasks: Sequence[str], diagnostics_dir: Path, restored: Restored | None = None
    ) -> "OffPolicyLearner":
        return OffPolicyLearner(self, key, tasks, diagnostics_dir, restored)


class OffPolicyLearner:
    """Rainbow, DQN and whatever else learns from replayed transitions."""

    def __init__(
        self,
        parts: OffPolicyParts,
        key: jax.Array,
        tasks: Sequence[str],
        diagnostics_dir: Path,
        restored: Restored | None = None,
    ):
        """As `LearnerParts.make`."""
        config, spec = parts.config, parts.replay_spec
        self._parts, self._tasks, self._diagnostics_dir = parts, tuple(tasks), diagnostics_dir
        self._placement = placement(parts)
        self._flatten = jax.jit(flatten_params)
        self._train_steps: dict[int, train_step.TrainStep] = {}
        self._ingest = Ingest(spec)
        self._limiter = RateLimiter(
            config.env_steps_per_update, config.warmup_steps, config.step_tolerance, parts.num_updates_per_call
        )
        self._kpis = TaskKpis(spec.num_tasks, config)
        if restored is None:
            self._state, self._replay = self._placement.init(key)
        else:
            arrays, state = restored.arrays, restored.host
            self._state, self._replay = self._placement.place(arrays["learner"], arrays["replay"])
            self._ingest.restore(state["ingest"])
            self._limiter.restore(state["limiter"])
            self._kpis.restore(state["kpis"])

    @property
    def params(self) -> Params:
        average = self._state.average_params
        return self._placement.one_copy(self._state.params if average is None else average)

    def num_steps_allowed(self) -> int:
        return self._limiter.num_steps_allowed()

    def add(self, blocks: Sequence[StepBlock], params_version: int) -> int:
        for arrays in self._placement.blocks(self._ingest, blocks, params_version):
            self._replay = self._placement.add(self._replay, arrays)
        steps = self._ingest.take_env_steps()
        self._limiter.insert(steps)
        return steps

    def add_episode(self, task: int, normalized_score: float) -> None:
        self._kpis.add(task, normalized_score)

    def can_update(self) -> bool:
        return self._limiter.num_updates_allowed() > 0

    def update(self) -> int:
        """Does gradient steps as the protocol says.

        Raises:
            ConfigError: before the first one, the replay holds no complete transition.
        """
        count = min(self._parts.num_updates_per_call, self._parts.config.total_updates - self._limiter.num_updates)
        if self._limiter.num_updates_allowed() < count:
            return 0
        weights = jnp.asarray(self._kpis.weights())
        self._state, self._replay = self._train_step(count)(self._state, self._replay, weights)
        self._limiter.update(count)
        return count

    def _train_step(self, num_updates: int) -> train_step.TrainStep:
        if num_updates not in self._train_steps:
            replay.check_can_sample(self._parts.replay_spec, self._replay)
            self._train_steps[num_updates] = self._placement.make_train_step(num_updates)
        return self._train_steps[num_updates]

    def epsilon(self, env_steps: int) -> float:
        """1 during warm-up, whatever the agent; then the agent's."""
        since_warmup = env_steps - self._parts.config.warmup_steps
        return 1.0 if since_warmup < 0 else self._parts.agent.epsilon(since_warmup)

    def acting_params(self) -> jax.Array:
        return self._flatten(self._placement.one_copy(self._state.params))

    def take_metrics(self) -> dict[str, float]:
        """Means of the train step as `learner/...`, what the replay holds as `replay/...`."""
        state = self._placement.local(self._state)
        means, state = train_step.read_metrics(state, self._tasks, self._diagnostics_dir)
        self._state = self._placement.settled(state)
        stored = np.asarray(store.records_per_task(self._parts.replay_spec, self._replay.store))
        shares = zip(self._tasks, (stored / stored.sum()).tolist(), strict=True)
        metrics = {f"learner/{name}": value for name, value in means.items()}
        metrics["replay/fill_share"] = float(stored.sum()) / self._parts.num_slots
        return {**metrics, **{f"replay/share/{name}": share for name, share in shares}}

    def take_staleness(self) -> Staleness:
        return self._ingest.take_staleness()

    def check_finite(self) -> None:
        train_step.check_finite(self._placement.local(self._state), self._diagnostics_dir)

    def arrays(self) -> dict[str, Any]:
        state, replay_state = self._placement.canonical(self._state, self._replay)
        return {"learner": state, "replay": replay_state}

    def state(self) -> dict[str, Any]:
        return {"ingest": self._ingest.state(), "limiter": self._limiter.state(), "kpis": self._kpis.state()}
