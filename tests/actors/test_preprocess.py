"""Frame stacks against plain concatenation."""

import numpy as np
import pytest

from actors.preprocess import push_frame, start_stack


@pytest.mark.parametrize("shape", [(6, 7, 3), (6, 7, 1), (1, 1, 3)])
@pytest.mark.parametrize("stack_size", [1, 2, 4])
def test_stacks_are_oldest_first_and_begin_with_the_first_frame_repeated(shape: tuple[int, int, int], stack_size: int):
    rng = np.random.default_rng(0)
    batch = np.zeros((2, *shape[:2], stack_size * shape[2]), np.uint8)
    stack = batch[1]
    for _ in range(2):  # the second episode sees nothing of the first
        frames = rng.integers(0, 256, (9, *shape), np.uint8)
        start_stack(stack, frames[0])
        history = [frames[0]] * stack_size
        np.testing.assert_array_equal(stack, np.concatenate(history, axis=-1))
        for frame in frames[1:]:
            push_frame(stack, frame)
            history = [*history[1:], frame]
            np.testing.assert_array_equal(stack, np.concatenate(history, axis=-1))
    assert not batch[0].any()
