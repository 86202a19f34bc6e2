"""Bodies for `make bench-micro`: each augmentation of a batch, and several together. Each runs once in CI."""

import jax
import numpy as np
import pytest

from gvz.experiments.gate_sight import STRONG
from learner.augment import AUGMENTATIONS, augment


@pytest.mark.parametrize(("frame", "channels"), [((48, 84), 1), ((84, 84), 3)], ids=["48x84 grey", "84x84 RGB"])
@pytest.mark.parametrize("names", [*((name,) for name in AUGMENTATIONS), STRONG], ids="+".join)
def test_augmentation_of_32_stacks_of_4(benchmark, names: tuple[str, ...], frame: tuple[int, int], channels: int):
    frames = jax.device_put(np.random.default_rng(0).integers(0, 256, (32, *frame, 4 * channels), np.uint8))
    augmented_by = jax.jit(augment, static_argnums=(0, 3))

    def body() -> None:
        jax.block_until_ready(augmented_by(names, jax.random.key(0), frames, channels))

    benchmark.pedantic(body, rounds=50, warmup_rounds=2)
