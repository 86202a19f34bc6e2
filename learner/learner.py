"""What a learner is to the training loop: step records in, gradient steps, parameters out.

The loop in gvz/run/train.py knows these protocols alone. How records are kept and drawn (a replay, rollouts), and on
which device, is the learner's own matter. `learner.off_policy` learns from a replay, `learner.on_policy` from rollouts.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import jax

from gvz.transport.messages import StepBlock
from learner.agents.base import Agent
from learner.checkpoint import Restored
from learner.ingest import Staleness


class Learner(Protocol):
    """One run's learner, from its first record to its last gradient step."""

    @property
    def params(self) -> Any:
        """The parameters that evaluation reads, a pytree on the device."""
        ...

    def num_steps_allowed(self) -> int:
        """Decisions that it takes now; at least 1 whenever `can_update` is False."""
        ...

    def add(self, blocks: Sequence[StepBlock], params_version: int) -> int:
        """Takes step records; `params_version` is the newest that was published. Returns the decisions among them.

        Raises:
            TransportError: a record does not belong to this run, or does not continue its lane's stream.
        """
        ...

    def add_episode(self, task: int, normalized_score: float) -> None:
        """Takes the score of a finished episode of the task with this index, in percent of the task's upper bound."""
        ...

    def can_update(self) -> bool:
        """The next gradient steps are paid for with decisions."""
        ...

    def update(self) -> int:
        """Does gradient steps, if they are paid for; does not wait for the device. Returns their number."""
        ...

    def epsilon(self, env_steps: int) -> float:
        """Probability of a uniformly random action after this number of decisions of the run."""
        ...

    def acting_params(self) -> jax.Array:
        """What is acted by, as one vector float32[P] on the device: a copy, which no gradient step changes."""
        ...

    def take_metrics(self) -> dict[str, float]:
        """Means since the last call, by name (docs/reference/metrics.md). Waits for the device.

        Raises:
            NonFiniteError: as `check_finite`.
        """
        ...

    def take_staleness(self) -> Staleness:
        """Age of the parameters that chose the decisions taken since the last call."""
        ...

    def check_finite(self) -> None:
        """Waits for the device.

        Raises:
            NonFiniteError: a loss or a gradient was not finite.
        """
        ...

    def arrays(self) -> dict[str, Any]:
        """All that it remembers on the device, for a checkpoint."""
        ...

    def state(self) -> dict[str, Any]:
        """All that it remembers on the host, for a checkpoint: msgpack types."""
        ...


class LearnerParts(Protocol):
    """What a learner is made of: sizes and settings, before anything is allocated."""

    @property
    def agent(self) -> Agent:
        """Whose acting function and loss."""
        ...

    @property
    def num_slots(self) -> int:
        """Step records that the learner keeps."""
        ...

    @property
    def batch_size(self) -> int:
        """Samples of a gradient step."""
        ...

    @property
    def num_updates_per_call(self) -> int:
        """Gradient steps of `Learner.update`, which no publication of the parameters divides."""
        ...

    def device_bytes(self) -> int:
        """Bytes of the records that the learner keeps on its devices, in all."""
        ...

    def host_bytes(self) -> int:
        """Bytes of the records that it keeps in numpy, whatever its devices are."""
        ...

    def array_shapes(self) -> dict[str, Any]:
        """Shapes and dtypes of `Learner.arrays()`."""
        ...

    def make(
        self, key: jax.Array, tasks: Sequence[str], diagnostics_dir: Path, restored: Restored | None = None
    ) -> Learner:
        """Makes the learner: an empty one, or one that goes on from a checkpoint.

        Args:
            key: JAX key of parameters, noise and sampling.
            tasks: a name for each task index, for the metrics.
            diagnostics_dir: existing directory where the batch of a non-finite update is saved.
            restored: a checkpoint with what `arrays()` and `state()` gave; further entries of either are ignored.
        """
        ...
