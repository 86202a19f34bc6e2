"""Random changes of labelled frames: what a thing is stays, what it and its surroundings look like does not.

Labels say which pixels are walls, floors or things, so each can be changed by itself, and things can stand before
surroundings that they were never seen in. On the host, by numpy and OpenCV.

Source: Tobin et al. 2017 (domain randomization: looks at random, so that the real one is one more); Ghiasi et al. 2021
(copy-paste of things between frames); Lee et al. 2020 (random convolution).
"""

import cv2
import numpy as np

from gvz.core.env_config import LABEL_CLASSES

Frame = np.ndarray
"""f32[H W 3], 0..255 or beside it until the last step"""

_THINGS = ("enemy", "projectile", "kit", "poison", "other", "key")
_PARTS = (("wall",), ("plane",), _THINGS, ("scenery", "effect"))
"""what has colours of its own"""


def changed_view(
    rng: np.random.Generator,
    frame: np.ndarray,
    labels: np.ndarray,
    other_frame: np.ndarray,
    other_labels: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """A frame as it might look elsewhere, and its labels.

    Args:
        rng: of every choice.
        frame: u8[H W 3].
        labels: u8[H W], numbers of LABEL_CLASSES.
        other_frame: u8[H W 3], from another task of the scenario: things may stand before it.
        other_labels: u8[H W], its labels.

    Returns:
        (u8[H W 3], u8[H W]).
    """
    view = frame.astype(np.float32)
    if rng.random() < 0.4:
        things = _is(labels, _THINGS)
        if rng.random() < 0.7:
            view = _other_colours(rng, view, 0.5)
        view = np.where(things[..., None], view, other_frame.astype(np.float32))
        labels = np.where(things, labels, other_labels)
    if rng.random() < 0.5:
        view = _other_parts(rng, view, labels)
    view = _other_light(rng, view)
    if rng.random() < 0.7:
        view, labels = _other_place(rng, view, labels)
    return view.astype(np.uint8), labels


def mirrored(rng: np.random.Generator, frame: np.ndarray, labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Left and right are exchanged in half of the cases."""
    return (frame[:, ::-1], labels[:, ::-1]) if rng.random() < 0.5 else (frame, labels)


def _is(labels: np.ndarray, classes: tuple[str, ...]) -> np.ndarray:
    chosen = np.zeros(256, bool)
    chosen[[LABEL_CLASSES.index(name) for name in classes]] = True
    return chosen[labels]


def _other_colours(rng: np.random.Generator, view: Frame, strength: float) -> Frame:
    """Contrast about 110, tint and brightness, each drawn around no change."""
    contrast = np.exp(rng.normal(0, 0.35 * strength))
    tint = np.exp(rng.normal(0, 0.25 * strength, 3)).astype(np.float32)
    return (view - 110) * (contrast * tint).astype(np.float32) + np.float32(110 + rng.normal(0, 25 * strength))


def _other_parts(rng: np.random.Generator, view: Frame, labels: np.ndarray) -> Frame:
    """Walls, floors, things and scenery each get other colours or, walls and floors, another texture."""
    for part in _PARTS:
        if rng.random() < 0.5:
            here = _is(labels, part)[..., None]
            if part in (("wall",), ("plane",)) and rng.random() < 0.35:
                share = np.float32(rng.uniform(0.3, 1.0))
                changed = (1 - share) * view + share * _texture(rng, *labels.shape)
            else:
                changed = _other_colours(rng, view, 1.0)
            view = np.where(here, changed, view)
    return view


def _texture(rng: np.random.Generator, height: int, width: int) -> Frame:
    """Blocks or clouds, stripes, or grain, of a random colour and contrast."""
    kind = rng.integers(3)
    if kind == 0:
        coarse = rng.random((rng.integers(2, 14), rng.integers(2, 20), 3)).astype(np.float32)
        how = cv2.INTER_NEAREST if rng.integers(2) else cv2.INTER_LINEAR
        pattern = cv2.resize(coarse, (width, height), interpolation=how)
    elif kind == 1:
        y, x = np.mgrid[:height, :width]
        angle, frequency, phase = rng.random() * np.pi, rng.uniform(0.1, 1.5), rng.random() * 2 * np.pi
        wave = np.sin((x * np.cos(angle) + y * np.sin(angle)) * frequency + phase) / 2 + 0.5
        pattern = np.repeat(wave[..., None], 3, axis=-1)
    else:
        grain = cv2.GaussianBlur(rng.random((height, width, 3)).astype(np.float32), (0, 0), rng.uniform(0.4, 2.0))
        pattern = (grain - 0.5) * 3 + 0.5
    contrast, colour = rng.uniform(10, 120) * (0.6 + 0.4 * rng.random(3)), rng.random(3) * 200
    return (pattern * contrast + colour).astype(np.float32)


def _other_light(rng: np.random.Generator, view: Frame) -> Frame:
    """The whole frame: colours, their order, inversion, a random filter, gamma. The result is within 0..255."""
    if rng.random() < 0.7:
        view = _other_colours(rng, view, 0.6)
    kind = rng.random()
    if kind < 0.15:
        view = np.repeat(view.mean(axis=-1, keepdims=True), 3, axis=-1)
    elif kind < 0.25:
        view = view[..., rng.permutation(3)]
    elif kind < 0.32:
        view = 255 - view
    if rng.random() < 0.15:
        kernel = (rng.normal(0, 1, (3, 3)) / 3).astype(np.float32)
        kernel[1, 1] += 1
        view = cv2.filter2D(np.ascontiguousarray(view), -1, kernel)
    view = np.clip(view, 0, 255)
    if rng.random() < 0.4:
        view = 255 * (view / 255) ** np.float32(np.exp(rng.normal(0, 0.4)))
    return view


def _other_place(rng: np.random.Generator, view: Frame, labels: np.ndarray) -> tuple[Frame, np.ndarray]:
    """Larger or smaller by up to 1.4, and moved by up to 10 pixels; edges are mirrored."""
    height, width = labels.shape
    scale = np.exp(rng.uniform(-0.35, 0.35))
    x, y = rng.uniform(-10, 10, 2)
    move = np.array([[scale, 0, (width - 1) / 2 * (1 - scale) + x], [0, scale, (height - 1) / 2 * (1 - scale) + y]])

    def moved(picture: np.ndarray, how: int) -> np.ndarray:
        picture = np.ascontiguousarray(picture)
        return cv2.warpAffine(picture, move, (width, height), flags=how, borderMode=cv2.BORDER_REFLECT)

    return moved(view, cv2.INTER_LINEAR), moved(labels, cv2.INTER_NEAREST)
