"""What each augmentation costs: processor time for a batch of 32 stacks of four frames, in two sizes of frames.

Each is measured alone and at full strength, as a compiled function, and the four of `gate_sight` also together. There
is no goal. Processor time, which a run may be limited by, depends little on other work beside it.
"""

import time
from collections.abc import Callable
from functools import partial
from itertools import product

from benchmarks.rounds import Budget, Row, alternate, measured

FRAMES = {"48x84 grey": (48, 84, 1), "84x84 RGB": (84, 84, 3)}
"""of `rainbow_general` and of `rainbow_4task`"""
QUICK_NAMES = (("shift",),)
CALLS = 30
"""of a body"""


def measure(budget: Budget) -> list[Row]:
    """A row for each augmentation and size."""
    from gvz.experiments.gate_sight import STRONG
    from learner.augment import AUGMENTATIONS

    names = QUICK_NAMES if budget.quick else (*((name,) for name in AUGMENTATIONS), STRONG)
    bodies = {
        f"{' + '.join(together)}, {size}": partial(_processor_s, _augment(together, FRAMES[size]))
        for size, together in product(FRAMES, names)
    }
    seconds = alternate(budget.rounds, bodies)
    return [measured(name, "ms", [1000 * s for s in values]) for name, values in seconds.items()]


def _processor_s(call: Callable[[], None]) -> float:
    """Mean processor time of one call, of all threads."""
    start = time.process_time()
    for _ in range(CALLS):
        call()
    return (time.process_time() - start) / CALLS


def _augment(names: tuple[str, ...], frame_shape: tuple[int, int, int]) -> Callable[[], None]:
    """A compiled and warm function that changes a batch."""
    import jax
    import numpy as np

    from learner.augment import augment

    height, width, channels = frame_shape
    frames = np.random.default_rng(0).integers(0, 256, (32, height, width, 4 * channels), np.uint8)
    arguments = jax.random.key(0), jax.device_put(frames)
    change = jax.jit(lambda key, frames: augment(names, key, frames, channels))

    def body() -> None:
        jax.block_until_ready(change(*arguments))

    body()
    return body
