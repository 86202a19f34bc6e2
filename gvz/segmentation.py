"""Frames that show what a network takes each pixel of the screen for: classes of things, from the screen alone.

The network is an ONNX file, which ONNX Runtime runs on one thread: in 0.6 ms of processor time, where OpenCV's takes
1.4 (`seek_and_kill`, 2-core Intel Xeon with AVX-512, 2026-11-25). `learner/segmentation.py` trains it with the engine's
labels; whoever plays needs none.
"""

from functools import cache
from pathlib import Path

import cv2
import numpy as np

from gvz.core.env_config import LABEL_CLASSES, EnvConfig
from gvz.core.errors import ConfigError, nearest

SEGMENTERS = Path(__file__).parent / "segmenters"
INPUT_HEIGHT, INPUT_WIDTH = 144, 252
"""pixels of the screen that a new network sees: nearly all that the engine renders"""
CLASS_COLOURS = {
    "wall": (0, 0, 0),
    "plane": (0, 0, 60),
    "weapon": (60, 60, 0),
    "scenery": (0, 0, 140),
    "effect": (60, 0, 60),
    "other": (90, 90, 90),
    "poison": (255, 0, 255),
    "enemy": (255, 0, 0),
    "key": (255, 255, 0),
    "kit": (0, 255, 0),
    "projectile": (0, 255, 255),
}
"""red, green and blue of each class in segmented frames"""
_COLOURS = np.array([CLASS_COLOURS[name] for name in LABEL_CLASSES], np.float32)


class Segmenter:
    """A segmentation network.

    Args:
        name: of a network that comes with GViZDoom (`segmenter_names`), or the path of an ONNX file with one input,
            float32 [1, 3, H, W], and one output, the probabilities of LABEL_CLASSES [1, 11, h, w].

    Raises:
        ConfigError: no such network, or not such a file.
    """

    def __init__(self, name: str):
        file = segmenter_file(name)
        import onnxruntime  # not before: it takes a third of a second, and most environments show the screen

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1  # games share the cores by processes
        options.log_severity_level = 4  # what it logs comes as an exception, too
        try:
            self._network = onnxruntime.InferenceSession(file, options, providers=["CPUExecutionProvider"])
            (frame,) = self._network.get_inputs()
            self._input, (_, _, self._height, self._width) = frame.name, frame.shape
            found = self(np.zeros((self._height, self._width, 3), np.uint8)).shape
        except Exception as error:  # its errors have no class in common
            raise ConfigError(f"env.segmenter: {file} is no segmentation network: {error}") from error
        if found[2] != len(LABEL_CLASSES):
            raise ConfigError(
                f"env.segmenter: {file} has {found[2]} classes, want {len(LABEL_CLASSES)}: {', '.join(LABEL_CLASSES)}"
            )

    def __call__(self, screen: np.ndarray) -> np.ndarray:
        """The screen u8[H W 3] -> probabilities of LABEL_CLASSES f32[h w 11]."""
        frame = network_input(screen, self._height, self._width)
        probabilities = np.asarray(self._network.run(None, {self._input: frame[None]})[0])
        return np.moveaxis(probabilities[0], 0, -1)


def network_input(screen: np.ndarray, height: int = INPUT_HEIGHT, width: int = INPUT_WIDTH) -> np.ndarray:
    """The screen u8[H W 3] as a network sees it: f32[3 height width], mean 0, deviation about 1."""
    small = cv2.resize(screen, (width, height), interpolation=cv2.INTER_LINEAR)
    mean, deviation = cv2.meanStdDev(small.reshape(-1, 1))
    return (np.moveaxis(small, -1, 0) - np.float32(mean[0, 0])) / np.float32(deviation[0, 0] + 12.75)


def segmented_frame(probabilities: np.ndarray, width: int, height: int) -> np.ndarray:
    """The mean of CLASS_COLOURS by probability, f32[h w 11] -> u8[height width 3]."""
    colours = np.rint(probabilities @ _COLOURS).astype(np.uint8)
    return cv2.resize(colours, (width, height), interpolation=cv2.INTER_LINEAR)


def segmenter_names() -> list[str]:
    """Names of the networks that come with GViZDoom."""
    return sorted(file.stem for file in SEGMENTERS.glob("*.onnx"))


def segmenter_file(name: str) -> Path:
    """The file of a network.

    Raises:
        ConfigError: there is none of this name.
    """
    file = Path(name) if name.endswith(".onnx") else SEGMENTERS / f"{name}.onnx"
    if not file.is_file():
        known = segmenter_names()
        raise ConfigError(
            f"env.segmenter: got {name!r}{nearest(name, known)}, want one of {', '.join(known) or 'none'}, or the path "
            "of an .onnx file"
        )
    return file


def segmenter_of(scenario: str, config: EnvConfig) -> Segmenter:
    """The network of segmented frames of a scenario: the configured one, or else that of the scenario's name.

    One in a process serves all its games.

    Raises:
        ConfigError: there is none.
    """
    return _loaded(config.segmenter or scenario)


@cache
def _loaded(name: str) -> Segmenter:
    return Segmenter(name)
