"""Bodies for `make bench-micro`: a segmented frame, and a changed view to train a network on. Each runs once in CI."""

import cv2
import numpy as np

from gvz.segmentation import INPUT_HEIGHT, INPUT_WIDTH, Segmenter, segmented_frame
from learner.segmentation_views import changed_view


def test_a_segmented_frame_of_the_rendered_screen_on_one_thread(benchmark):
    screen = np.random.default_rng(0).integers(0, 256, (144, 256, 3), dtype=np.uint8)
    segment, threads = Segmenter("seek_and_kill"), cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        benchmark.pedantic(lambda: segmented_frame(segment(screen), 42, 24), rounds=200, warmup_rounds=5)
    finally:
        cv2.setNumThreads(threads)


def test_a_changed_view(benchmark):
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (2, INPUT_HEIGHT, INPUT_WIDTH, 3), dtype=np.uint8)
    labels = rng.integers(0, 11, (2, INPUT_HEIGHT, INPUT_WIDTH), dtype=np.uint8)
    arguments = (frames[0], labels[0], frames[1], labels[1])
    benchmark.pedantic(lambda: changed_view(rng, *arguments), rounds=200, warmup_rounds=5)
