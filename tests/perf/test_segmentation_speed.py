"""Bodies for `make bench-micro`: a segmented frame, and a changed view to train a network on. Each runs once in CI."""

import cv2
import numpy as np

from gvz.core.env_config import EnvConfig
from gvz.segmentation import segmented_frame, segmenter_of
from learner.segmentation_views import Shot, changed_view


def test_a_segmented_frame_of_the_rendered_screen_on_one_thread(benchmark):
    screen = np.random.default_rng(0).integers(0, 256, (144, 256, 3), dtype=np.uint8)
    segment, threads = segmenter_of("seek_and_kill", EnvConfig()), cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        benchmark.pedantic(lambda: segmented_frame(segment(screen), 42, 24), rounds=200, warmup_rounds=5)
    finally:
        cv2.setNumThreads(threads)


def test_a_changed_view(benchmark):
    rng = np.random.default_rng(0)
    size = (144, 256)
    shots = [
        Shot(
            *(
                rng.integers(0, high, shape, dtype=np.uint8)
                for high, shape in ((256, (*size, 3)), (11, size), (99, size))
            )
        )
        for _ in range(3)
    ]
    benchmark.pedantic(lambda: changed_view(rng, *shots), rounds=200, warmup_rounds=5)
