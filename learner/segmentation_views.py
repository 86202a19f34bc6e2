"""Random changes of labelled frames: what a thing is stays, what it and its surroundings look like does not.

Labels say which pixels are walls, floors or things, so each can be changed by itself, and things can stand before
surroundings that they were never seen in. On the host, by numpy and OpenCV.

Frames have the size that the engine renders: there each pixel is of one thing alone, so a cut-out thing takes nothing
of its old surroundings along. A frame is shrunk for the network last.

Source: Tobin et al. 2017 (domain randomization: looks at random, so that the real one is one more); Ghiasi et al. 2021
(copy-paste of things between frames).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from gvz.core.env_config import LABEL_CLASSES

Frame = np.ndarray
"""f32[H W 3], 0..255 or beside it until its light is changed"""

_THINGS = ("enemy", "projectile", "kit", "poison", "other", "key")
DECORATIONS = ("scenery", "effect")
_PARTS = (("wall",), ("plane",), _THINGS, DECORATIONS)
"""what has colours of its own"""
_TINTED_SHARE = 0.2
_PATCHED_SHARE = 0.4
"""of other surroundings"""


class Shot(NamedTuple):
    """A frame of a task, as the engine renders it, and what it shows."""

    frame: np.ndarray
    """u8[H W 3]"""
    labels: np.ndarray
    """u8[H W], numbers of LABEL_CLASSES"""
    depth: np.ndarray
    """u8[H W], the engine's depth buffer: 0 is the nearest"""
    style: str | None = None
    """of OUTLINES, the engine's render style of the task's things"""


def changed_view(
    rng: np.random.Generator,
    shot: Shot,
    surroundings: Shot,
    decorations: Shot | None = None,
    others: Sequence[Shot] = (),
    known_styles: Sequence[str] = (),
    tints_and_patches: bool = True,
) -> tuple[np.ndarray, np.ndarray]:
    """A frame as it might look elsewhere, and its labels.

    Three of four keep colours, textures and light, and most of these have other surroundings: so looks meet that are
    known from different tasks. In the others, looks change as well. Some of the other surroundings have walls or floors
    in shades of one colour, or with patches of one colour each: else what is light, or of a strong colour, would be
    taken for a thing.

    What is put before other surroundings is hidden where their walls and things are nearer. The floor of all maps of a
    scenario is at one height, so things stand on it as they do in the game: far ones before far walls.

    Args:
        rng: of every choice.
        shot: whose things are to be seen, and whose decorations.
        surroundings: of another task of the scenario: things may stand before it.
        decorations: further ones, which then stand there as well.
        others: whose things then stand there as well.
        known_styles: of OUTLINES, those that some task has. Three of four styles that are drawn are of these, the
            others any of these or of the styles that are no outline.
        tints_and_patches: whether some of the other surroundings have them.

    Returns:
        (u8[H W 3], u8[H W]).
    """
    view, labels = shot.frame.astype(np.float32), shot.labels
    elsewhere, other_looks = rng.random(2) < (0.85, 0.25)
    if elsewhere:
        behind = _Scene.of(surroundings)
        tinted, patched = (rng.random(2) < (_TINTED_SHARE, _PATCHED_SHARE)) & tints_and_patches
        if tinted:
            behind.view = _tinted(rng, behind.view, behind.labels)
        if patched:
            behind.view = _patched(rng, behind.view, behind.labels, shot.frame[_is(shot.labels, _THINGS) == 1])
        if other_looks:
            behind.view = _other_parts(rng, behind.view, behind.labels)
        if decorations is not None:
            behind.add(decorations.frame.astype(np.float32), decorations, DECORATIONS)
        for one in (shot, *others):
            things = one.frame.astype(np.float32)
            if other_looks:
                things = _other_colours(rng, things, 0.5)
            if one is shot:
                behind.add(things, shot, DECORATIONS)
            style = _drawn_style(rng, known_styles) if one.style is None else one.style
            if style is not None:
                things = _STYLES[style](rng, things, behind.view)
            behind.add(things, one, _THINGS)
        view, labels = behind.view, behind.labels
    elif other_looks:
        view = _other_parts(rng, view, labels)
    return _other_light(rng, view) if other_looks else np.clip(view, 0, 255).astype(np.uint8), labels


def in_front(shot: Shot, labels: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """u8[H W]: 1 where nothing of these labels and depths hides what the shot shows. Floors and ceilings hide nothing.

    The engine draws a sprite whole that reaches below the floor.
    """
    return ((shot.depth <= depth) | (labels == LABEL_CLASSES.index("plane"))).astype(np.uint8)


def num_pixels_gained(shots: Sequence[Shot], surroundings: Shot) -> int:
    """Pixels of these shots' things and decorations that would be seen before surroundings, less those of own things.

    Own things are those that the surroundings show themselves.
    """

    def seen(shot: Shot) -> np.ndarray:
        return _is(shot.labels, _THINGS + DECORATIONS) * in_front(shot, surroundings.labels, surroundings.depth)

    gained = sum(np.count_nonzero(seen(shot)) for shot in shots)
    return int(gained - np.count_nonzero(_is(surroundings.labels, _THINGS)))


@dataclass
class _Scene:
    """What has been put together so far."""

    view: Frame
    labels: np.ndarray
    depth: np.ndarray

    @classmethod
    def of(cls, shot: Shot) -> "_Scene":
        return cls(shot.frame.astype(np.float32), shot.labels.copy(), shot.depth.copy())

    def add(self, view: Frame, shot: Shot, classes: tuple[str, ...]) -> None:
        """Puts what a shot shows of these classes before the scene, with the looks that it has in `view`."""
        seen = _is(shot.labels, classes) * in_front(shot, self.labels, self.depth)
        for new, old in ((view, self.view), (shot.labels, self.labels), (shot.depth, self.depth)):
            cv2.copyTo(new, seen, old)


def shrunk(view: np.ndarray, labels: np.ndarray, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """A frame u8[H W 3] and its labels u8[H W] in another size, as `network_input` shrinks a screen."""
    size = (width, height)
    return cv2.resize(view, size, interpolation=cv2.INTER_LINEAR), cv2.resize(
        labels, size, interpolation=cv2.INTER_NEAREST
    )


def moved(
    rng: np.random.Generator, view: np.ndarray, labels: np.ndarray, height: int, width: int
) -> tuple[np.ndarray, np.ndarray]:
    """As `shrunk`, but larger or smaller by up to 1.4, wider or narrower by 1.2, and up to a tenth of the height aside.

    Edges are mirrored.
    """
    ratio_y, ratio_x = height / labels.shape[0], width / labels.shape[1]
    scale_y = np.exp(rng.uniform(-0.35, 0.35))
    scale_x = scale_y * np.exp(rng.uniform(-0.2, 0.2))
    x, y = rng.uniform(-height / 10, height / 10, 2)

    def line(scale: float, ratio: float, size: int, offset: float) -> tuple[float, float]:
        """(slope, start): where a pixel of the frame comes to lie; the middle stays, but for the offset."""
        return scale * ratio, scale * (ratio - size) / 2 + (size - 1) / 2 + offset

    (slope_x, start_x), (slope_y, start_y) = line(scale_x, ratio_x, width, x), line(scale_y, ratio_y, height, y)
    move = np.array([[slope_x, 0, start_x], [0, slope_y, start_y]])

    def warped(picture: np.ndarray, how: int) -> np.ndarray:
        return cv2.warpAffine(picture, move, (width, height), flags=how, borderMode=cv2.BORDER_REFLECT)

    return warped(view, cv2.INTER_LINEAR), warped(labels, cv2.INTER_NEAREST)


def mirrored(rng: np.random.Generator, frame: np.ndarray, labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Left and right are exchanged in half of the cases."""
    return (frame[:, ::-1], labels[:, ::-1]) if rng.random() < 0.5 else (frame, labels)


def _is(labels: np.ndarray, classes: tuple[str, ...]) -> np.ndarray:
    """u8[H W], 1 where the label is one of the classes."""
    chosen = np.zeros(256, np.uint8)
    chosen[[LABEL_CLASSES.index(name) for name in classes]] = 1
    return cv2.LUT(labels, chosen)


def _drawn_style(rng: np.random.Generator, known_styles: Sequence[str]) -> str | None:
    """A render style for things that have none of OUTLINES, or none.

    Of OUTLINES only the known ones are drawn: others would show a network looks that only gate or test tasks have.
    """
    if rng.random() >= 0.6:
        return None
    allowed = tuple(name for name in _STYLES if name in known_styles or name not in OUTLINES)
    names = known_styles if known_styles and rng.random() < 0.75 else allowed
    return names[int(rng.integers(len(names)))]


def _other_colours(rng: np.random.Generator, view: Frame, strength: float) -> Frame:
    """Contrast about 110, tint and brightness, each drawn around no change."""
    contrast = np.exp(rng.normal(0, 0.35 * strength))
    slopes = contrast * np.exp(rng.normal(0, 0.25 * strength, 3))
    offsets = 110 * (1 - slopes) + rng.normal(0, 25 * strength)
    return cv2.transform(view, np.column_stack([np.diag(slopes), offsets]))


def _shadow(rng: np.random.Generator, _things: Frame, surroundings: Frame) -> Frame:
    """The engine takes a third of the light away; here it is somewhat more or less."""
    return surroundings * np.float32(1 - rng.uniform(0.25, 0.45))


def _translucent(rng: np.random.Generator, things: Frame, surroundings: Frame) -> Frame:
    return surroundings + np.float32(rng.uniform(0.3, 0.8)) * (things - surroundings)


def _fuzzy(rng: np.random.Generator, _things: Frame, surroundings: Frame) -> Frame:
    """Each pixel as dark as chance will have it."""
    return surroundings * rng.uniform(rng.uniform(0, 0.6), 1, (*surroundings.shape[:2], 1)).astype(np.float32)


def _stencil(rng: np.random.Generator, things: Frame, _surroundings: Frame) -> Frame:
    return np.full_like(things, rng.uniform(0, 255, 3))


_STYLES = {"STYLE_Shadow": _shadow, "STYLE_Translucent": _translucent, "STYLE_Fuzzy": _fuzzy, "STYLE_Stencil": _stencil}
"""f(rng, things, surroundings) -> things as the engine draws them in a render style"""
OUTLINES = ("STYLE_Shadow", "STYLE_Fuzzy")
"""render styles that show nothing of a thing but its outline: before other surroundings it looks different"""


def _tinted(rng: np.random.Generator, view: Frame, labels: np.ndarray) -> Frame:
    """Walls, or floors and ceilings, in shades of one colour, mostly a strong one."""
    part = (("wall",), ("plane",))[int(rng.integers(2))]
    colour = rng.random(3) ** 2
    shades = view.max(axis=-1, keepdims=True) * np.exp(rng.normal(0, 0.4))
    return cv2.copyTo((shades * colour / colour.max()).astype(np.float32), _is(labels, part), view.copy())


def _patched(rng: np.random.Generator, view: Frame, labels: np.ndarray, colours: np.ndarray) -> Frame:
    """Walls, floors and ceilings with one to five patches: strips or blocks, aslant and tapered as in perspective.

    Args:
        colours: u8[N 3], of things. Of ten patches three have one of these, four a light grey, and three any.
    """
    view, (height, width) = view.copy(), labels.shape
    for _ in range(int(rng.integers(1, 6))):
        kind = rng.random()
        if kind < 0.4:
            colour = rng.uniform(120, 255) + rng.normal(0, 10, 3)
        elif kind < 0.7 and len(colours):
            colour = colours[int(rng.integers(len(colours)))]
        else:
            colour = rng.uniform(0, 255, 3)
        if rng.random() < 0.5:
            length, thickness, taper = rng.uniform(20, 200), np.exp(rng.uniform(0.4, 2.6)), rng.uniform(0.3, 1.7)
        else:
            (length, thickness), taper = np.exp(rng.uniform(1.4, 4.1, 2)), rng.uniform(0.7, 1.3)
        ends = length / 2 * np.array([-1, 1])
        middle, half = ends * rng.normal(0, 0.3), thickness / 2 * np.array([1, taper])
        corners = np.column_stack([[*ends, *ends[::-1]], [*(middle - half), *(middle + half)[::-1]]])
        place = np.zeros((height, width), np.uint8)
        cv2.fillConvexPoly(place, np.rint(corners + rng.uniform(0, (width, height))).astype(np.int32), 1)
        part = (("wall", "plane"), ("wall",), ("plane",))[int(rng.integers(3))]
        grain = rng.normal(0, rng.uniform(0, 25), (height, width, 1))
        cv2.copyTo((colour + grain).astype(np.float32), place & _is(labels, part), view)
    return view


def _other_parts(rng: np.random.Generator, view: Frame, labels: np.ndarray) -> Frame:
    """Walls, floors, things and scenery each get other colours or, walls and floors, another texture."""
    for part in _PARTS:
        if rng.random() < 0.5:
            if part in (("wall",), ("plane",)) and rng.random() < 0.35:
                share = np.float32(rng.uniform(0.3, 1.0))
                changed = (1 - share) * view + share * _texture(rng, *labels.shape)
            else:
                changed = _other_colours(rng, view, 1.0)
            view = cv2.copyTo(changed, _is(labels, part), view.copy())
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


def _other_light(rng: np.random.Generator, view: Frame) -> np.ndarray:
    """The whole frame: colours, grey, gamma; u8[H W 3]."""
    if rng.random() < 0.6:
        view = _other_colours(rng, view, 0.5)
    if rng.random() < 0.05:
        view = cv2.transform(view, np.full((3, 3), 1 / 3))
    changed = np.clip(view, 0, 255).astype(np.uint8)
    if rng.random() < 0.4:
        levels = 255 * (np.arange(256) / 255) ** np.exp(rng.normal(0, 0.4))
        changed = cv2.LUT(changed, np.rint(levels).astype(np.uint8))
    return changed
