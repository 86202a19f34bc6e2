"""Bodies for `make bench`: each augmentation of a batch. Each runs once in CI."""

import jax
import numpy as np
import pytest

from learner.augment import AUGMENTATIONS, augment


@pytest.mark.parametrize(("frame", "channels"), [((48, 84), 1), ((84, 84), 3)], ids=["48x84 grey", "84x84 RGB"])
@pytest.mark.parametrize("name", AUGMENTATIONS)
def test_augmentation_of_32_stacks_of_4(benchmark, name: str, frame: tuple[int, int], channels: int):
    frames = jax.device_put(np.random.default_rng(0).integers(0, 256, (32, *frame, 4 * channels), np.uint8))
    augmented_by = jax.jit(augment, static_argnums=(0, 3))

    def body() -> None:
        jax.block_until_ready(augmented_by((name,), jax.random.key(0), frames, channels))

    benchmark.pedantic(body, rounds=50, warmup_rounds=2)
