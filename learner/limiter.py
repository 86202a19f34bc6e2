"""Holds actors and learner to one ratio of decisions to gradient steps.

Without it two runs with one seed are different experiments on different machines. The limiter is two counters and a
window; it waits for nobody. The learner does no update that is not paid for with decisions, and takes no decision
out of the actors' rings that is too far ahead of its updates; actors are held back by their full rings.
"""

import math
from fractions import Fraction


class RateLimiter:
    """Decisions inserted and updates done, and how many more of each are allowed.

    With `lead = env_steps - warmup_steps - env_steps_per_update * updates`, an update is allowed while lead stays at
    least 0 after it, and decisions are allowed while lead is below `tolerance`, or below what one call of
    `num_updates_per_call` updates costs if that is more. So one side can always go on: where a call is not yet paid
    for, lead is below its cost, and at least one decision is allowed.
    """

    def __init__(
        self, env_steps_per_update: float, warmup_steps: int, tolerance: int, num_updates_per_call: int = 1
    ) -> None:
        """Starts at zero decisions and zero updates.

        Args:
            env_steps_per_update: decisions (all games together) for one gradient step, more than 0.
            warmup_steps: decisions before the first update.
            tolerance: decisions by which the actors may lead.
            num_updates_per_call: gradient steps that are done at once, at least 1.
        """
        # exact, and what was written: as a float 0.1 is a little more than a tenth, and ten updates cost over one step
        self._ratio = Fraction(str(env_steps_per_update))
        self._warmup_steps = warmup_steps
        self._num_updates_per_call = num_updates_per_call
        self._window = max(tolerance, self._ratio * num_updates_per_call)
        self._env_steps = 0
        self._updates = 0

    @property
    def num_updates(self) -> int:
        """Updates done."""
        return self._updates

    def num_updates_allowed(self) -> int:
        """Updates that are paid for and not done: whole calls of num_updates_per_call."""
        paid = math.floor((self._env_steps - self._warmup_steps) / self._ratio)
        calls = (paid - self._updates) // self._num_updates_per_call
        return max(0, calls) * self._num_updates_per_call

    def num_steps_allowed(self) -> int:
        """Decisions that may still be taken in. At least 1 whenever no update is allowed."""
        limit = self._warmup_steps + self._ratio * self._updates + self._window
        return max(0, math.ceil(limit) - self._env_steps)

    def insert(self, num_env_steps: int) -> None:
        """Counts decisions that were taken in."""
        self._env_steps += num_env_steps

    def update(self, num_updates: int) -> None:
        """Counts updates that were done."""
        self._updates += num_updates

    def state(self) -> dict[str, int]:
        """Returns what a checkpoint keeps."""
        return {"env_steps": self._env_steps, "updates": self._updates}

    def restore(self, state: dict[str, int]) -> None:
        """Goes on from `state`: no second warm-up, and no updates but those that were still owed."""
        self._env_steps, self._updates = state["env_steps"], state["updates"]
