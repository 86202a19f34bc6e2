"""Frames that show what a network takes each pixel of the screen for: classes of things, from the screen alone.

The network is an ONNX file, which ONNX Runtime runs on one thread: in 0.6 ms of processor time, where OpenCV's takes
1.4 (96x168 pixels, 2-core Intel Xeon with AVX-512, 2026-11-25). `learner/segmentation.py` trains it with the engine's
labels; whoever plays needs none.
"""

import dataclasses
import hashlib
import shutil
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from gvz.core.env_config import LABEL_CLASSES, EnvConfig
from gvz.core.errors import ConfigError, ResumeError, nearest

SEGMENTERS = Path(__file__).parent / "segmenters"
KEPT_SEGMENTERS = "segmenters"
"""directory of a run with the networks that it learns with"""
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
        file: an ONNX file with one input, float32 [1, 3, H, W], and one output, the probabilities of LABEL_CLASSES
            [1, 11, h, w].

    Raises:
        ConfigError: not such a file.
    """

    def __init__(self, file: Path | str):
        import onnxruntime  # not before: it takes a third of a second, and most environments show the screen

        self._file = file
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

    def __reduce__(self) -> tuple[type["Segmenter"], tuple[Path | str]]:
        return Segmenter, (self._file,)


def network_input(screen: np.ndarray, height: int = INPUT_HEIGHT, width: int = INPUT_WIDTH) -> np.ndarray:
    """The screen u8[H W 3] as a network sees it: f32[3 height width], mean 0, deviation about 1."""
    small = cv2.resize(screen, (width, height), interpolation=cv2.INTER_LINEAR)
    mean, deviation = cv2.meanStdDev(small.reshape(-1, 1))
    return (np.moveaxis(small, -1, 0) - np.float32(mean[0, 0])) / np.float32(deviation[0, 0] + 12.75)


def segmented_frame(probabilities: np.ndarray, width: int, height: int, temperature: float = 1.0) -> np.ndarray:
    """The mean of CLASS_COLOURS by probability, f32[h w 11] -> u8[height width 3].

    Probabilities are first raised to 1 / temperature, and divided by their sum.
    """
    if temperature != 1.0:
        probabilities = probabilities ** np.float32(1 / temperature)
        probabilities /= probabilities.sum(axis=-1, keepdims=True)
    colours = np.rint(probabilities @ _COLOURS).astype(np.uint8)
    return cv2.resize(colours, (width, height), interpolation=cv2.INTER_LINEAR)


def segmenter_names() -> list[str]:
    """Names of the networks that come with GViZDoom, and of the sets of one for each scenario."""
    return sorted({file.relative_to(SEGMENTERS).parts[0].removesuffix(".onnx") for file in SEGMENTERS.rglob("*.onnx")})


def segmenter_file(scenario: str, config: EnvConfig) -> Path:
    """The file of a scenario's network: the configured one, or else that of the scenario's name.

    A set or a directory that lacks the scenario is an error: another network has been trained on other tasks.

    Raises:
        ConfigError: there is none.
    """
    name, known = config.segmenter or scenario, segmenter_names()
    directory = SEGMENTERS / name if name in known else Path(name)
    if directory.is_dir():
        file = directory / f"{scenario}.onnx"
    else:
        file = Path(name) if name.endswith(".onnx") else SEGMENTERS / f"{name}.onnx"
    if not file.is_file():
        if directory.is_dir() or not config.segmenter:
            raise ConfigError(
                f"env.segmenter: {config.segmenter or 'GViZDoom'} has no network for {scenario}; "
                f"`gvz segmenter --scenario {scenario}` trains one, and a directory takes it as {scenario}.onnx"
            )
        gone = f": no file {file.resolve()}" if name.endswith(".onnx") else nearest(name, known)
        raise ConfigError(
            f"env.segmenter: got {name!r}{gone}; want one of {', '.join(known) or 'none'}, the path of an .onnx file, "
            "or a directory of them"
        )
    return file


def segmenter_of(scenario: str, config: EnvConfig) -> Segmenter:
    """A scenario's network. One in a process serves all its games, until the file is another one.

    Raises:
        ConfigError: there is none.
    """
    file = segmenter_file(scenario, config)
    return _loaded(file, _digest(file))


def keep_segmenters(scenarios: Iterable[str], config: EnvConfig, directory: Path) -> None:
    """Copies the networks of segmented frames into a directory. One that is there already stays: a run's policies fit
    the networks that they learned with.

    Raises:
        ConfigError: a scenario has none.
    """
    if config.frames == "segmented":
        directory.mkdir(exist_ok=True)
        for scenario in scenarios:
            kept = directory / f"{scenario}.onnx"
            if not kept.exists():
                unfinished = kept.with_suffix(".unfinished")
                shutil.copyfile(segmenter_file(scenario, config), unfinished)
                unfinished.replace(kept)


def kept_digests(directory: Path) -> dict[str, str]:
    """Scenario -> digest of the network that `keep_segmenters` has put into a directory."""
    return {file.stem: _digest(file) for file in sorted(directory.glob("*.onnx"))}


def check_installed(scenarios: Iterable[str], config: EnvConfig, directory: Path) -> None:
    """Refuses to go on with other networks than those that `keep_segmenters` has put into a directory.

    Raises:
        ResumeError: names the scenarios whose configured network is another one.
    """
    kept = kept_digests(directory)
    changed = [name for name in scenarios if name in kept and kept[name] != _digest(segmenter_file(name, config))]
    if changed:
        raise ResumeError(
            f"env.segmenter: the networks for {', '.join(changed)} that are installed are not those in {directory}, "
            "with which the run has learned, and hosts use the installed ones; install the version that the run began "
            "with, or give another --run-dir"
        )


def _digest(file: Path) -> str:
    return hashlib.blake2b(file.read_bytes(), digest_size=8).hexdigest()


def with_kept_segmenters(config: EnvConfig, directory: Path) -> EnvConfig:
    """The configuration with the networks that `keep_segmenters` has put into a directory, if it has any. The path is
    absolute: actors run in a directory of their own.
    """
    return dataclasses.replace(config, segmenter=str(directory.absolute())) if directory.is_dir() else config


@cache
def _loaded(file: Path, digest: str) -> Segmenter:
    """The network of a file with these contents: a path may come to name another file."""
    del digest
    return Segmenter(file)
