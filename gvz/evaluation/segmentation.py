"""Frames with the engine's labels, to train a segmentation network on and to score it by."""

import itertools
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future
from contextlib import closing
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from gvz.core.env_config import LABEL_CLASSES, SIGHT_CLASSES, EnvConfig
from gvz.env import DoomEnv
from gvz.evaluation.play import episode_seed
from gvz.evaluation.players import Player, RandomPlayer, ScriptedPlayer
from gvz.scenarios.base import Task, Textures
from gvz.scenarios.compiler import task_content
from gvz.segmentation import INPUT_HEIGHT, INPUT_WIDTH
from learner.segmentation import CELL
from learner.segmentation_views import OUTLINES, Shot, changed_view, mirrored, moved, num_pixels_gained, shrunk


class Labelled(NamedTuple):
    """Frames of a task, as the engine renders them."""

    frames: np.ndarray
    """u8[N H W 3]"""
    labels: np.ndarray
    """u8[N H W], numbers of LABEL_CLASSES"""
    depths: np.ndarray
    """u8[N H W], the engine's depth buffer"""
    style: str | None = None
    """the engine's render style of the task's things, if it shows nothing of them but their outline"""
    textures: Textures | None = None
    """of the task's walls, floors and ceilings; None: every map has its own"""

    def shot(self, rng: np.random.Generator) -> Shot:
        """One of the frames, drawn at random."""
        number = rng.integers(len(self.frames))
        return Shot(self.frames[number], self.labels[number], self.depths[number], self.style)


Batch = tuple[np.ndarray, np.ndarray]
"""(screens u8[B H W 3], labels u8[B H W])"""
_ARRAYS = ("frames", "labels", "depths")
CLASS_WEIGHTS = np.where(np.isin(LABEL_CLASSES, ("wall", "plane", "weapon")), 1.0, 8.0).astype(np.float32)
"""f32[C] of pixels in the loss: things cover few of them, and all weigh the same, so that none is taken for another"""
_BASE_SEED = 7
"""of the episodes; evaluations have 0"""
_DECISIONS_APART = 5
"""between frames of an episode, which hardly differ otherwise"""
_FRAMES_PER_EPISODE = 60
_FRAMES_PER_MAP = 20
"""of a varied map, so that frames show many maps"""
_CLEAN_SHARE = 0.15
"""of a batch's frames that are only mirrored"""
_MOVED_SHARE = 0.7
_DECORATED_SHARE = 0.5
"""of the other frames"""
_NUM_OTHERS = 2
"""frames whose things stand there, too: a frame of a task shows few"""
_TRIES = 3
"""surroundings that are drawn; those are taken that hide least and show least of their own"""
_MIN_CELLS = 100
"""that show a class, for a score of it"""


def labelled_frames(task: Task, num_frames: int) -> Labelled:
    """Frames of a task that a random player and the scripted one see in turns, an episode each.

    Raises:
        EngineError: the engine does not start, or dies.
    """
    frames, labels, depths, episode = [], [], [], 0
    height, width = EnvConfig().render_height, EnvConfig().render_width
    config = EnvConfig(frame_height=height, frame_width=width, buffers=("depth", "labels"))
    frames_per_episode = _FRAMES_PER_EPISODE if task.maps is None else _FRAMES_PER_MAP
    with closing(DoomEnv(task, config)) as env:
        while len(frames) < num_frames:
            seed = episode_seed(task.id, episode, _BASE_SEED)
            observation, info = env.reset(options={"episode_seed": seed})
            player: Player = RandomPlayer() if episode % 2 else ScriptedPlayer()
            player.begin(env, observation, info, seed)
            for decision in range(frames_per_episode * _DECISIONS_APART):
                assert isinstance(observation, dict)
                if decision % _DECISIONS_APART == 0:
                    frames.append(observation["screen"])
                    labels.append(observation["labels"][:, :, 0])
                    depths.append(observation["depth"][:, :, 0])
                observation, _, terminated, truncated, info = env.step(player.act())
                player.observe(observation, info)
                if terminated or truncated or len(frames) == num_frames:
                    break
            episode += 1
    return Labelled(np.stack(frames), np.stack(labels), np.stack(depths), *_looks(task))


class BatchSpec(NamedTuple):
    """How batches are made."""

    batch_size: int
    """B"""
    seed: int
    """of all choices"""
    tints_and_patches: bool = True
    """whether surfaces get them, see `changed_view`"""


class Batches:
    """Batches of changed frames, to train on. A batch follows from the tasks' frames, the spec and its number alone.

    Args:
        tasks: each frame of a batch is drawn at random from a task drawn at random.
        spec: how they are made.
    """

    def __init__(self, tasks: Sequence[Labelled], spec: BatchSpec):
        self._tasks, self._spec = tasks, spec
        self._styles = sorted({task.style for task in tasks if task.style is not None})
        self._decorated = [task for task in tasks if (task.labels == LABEL_CLASSES.index("scenery")).any()]
        by_textures = {task.textures: [one for one in tasks if one.textures == task.textures] for task in tasks}
        self._alike = list(by_textures.values())

    def __iter__(self) -> Iterator[Batch]:
        return map(self.batch, itertools.count())

    def batch(self, number: int) -> Batch:
        """The batch of this number, of the size that a network sees."""
        rng = np.random.default_rng((self._spec.seed, number))
        views = [self._view(rng) for _ in range(self._spec.batch_size)]
        return np.stack([view for view, _ in views]), np.stack([labels for _, labels in views])

    def _view(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        def drawn(tasks: Sequence[Labelled]) -> Shot:
            return tasks[int(rng.integers(len(tasks)))].shot(rng)

        def drawn_surroundings() -> Shot:
            """Textures that few tasks have are drawn as often as others."""
            return drawn(self._alike[int(rng.integers(len(self._alike)))])

        shot = drawn(self._tasks)
        view, labels, is_changed = shot.frame, shot.labels, rng.random() >= _CLEAN_SHARE
        if is_changed:
            decorations = drawn(self._decorated) if self._decorated and rng.random() < _DECORATED_SHARE else None
            others = [drawn(self._tasks) for _ in range(_NUM_OTHERS)]
            gained = partial(num_pixels_gained, (shot, *others))
            surroundings = max((drawn_surroundings() for _ in range(_TRIES)), key=gained)
            view, labels = changed_view(
                rng, shot, surroundings, decorations, others, self._styles, self._spec.tints_and_patches
            )
        if is_changed and rng.random() < _MOVED_SHARE:
            view, labels = moved(rng, view, labels, INPUT_HEIGHT, INPUT_WIDTH)
        else:
            view, labels = shrunk(view, labels, INPUT_HEIGHT, INPUT_WIDTH)
        return mirrored(rng, view, labels)


def keep_frames(task: Task, num_frames: int, directory: Path) -> None:
    """Puts `labelled_frames` of a task into a directory, where several processes can share them."""
    found, where = labelled_frames(task, num_frames), _kept(task, directory)
    where.mkdir(parents=True)
    for name in _ARRAYS:
        np.save(where / f"{name}.npy", getattr(found, name))


def batches_of_workers(
    executor: Executor, num_ahead: int, tasks: Sequence[Task], directory: Path, spec: BatchSpec
) -> Iterator[Batch]:
    """What `Batches` of the kept frames of these tasks has, in its order, made by other processes.

    Args:
        executor: the processes.
        num_ahead: batches that are made before they are asked for.
        tasks: of which `keep_frames` has kept frames.
        directory: where.
        spec: how they are made.
    """
    coming: deque[Future[Batch]] = deque()
    for number in itertools.count():
        coming.append(executor.submit(_batch, number, tuple(tasks), directory, spec))
        if len(coming) > num_ahead:
            yield coming.popleft().result()


def _batch(number: int, tasks: tuple[Task, ...], directory: Path, spec: BatchSpec) -> Batch:
    return _kept_batches(tasks, directory, spec).batch(number)


@cache
def _kept_batches(tasks: tuple[Task, ...], directory: Path, spec: BatchSpec) -> Batches:
    """A worker opens the files once; what it reads of them it shares with the others."""
    return Batches([_opened(task, directory) for task in tasks], spec)


def _opened(task: Task, directory: Path) -> Labelled:
    frames, labels, depths = (np.load(_kept(task, directory) / f"{name}.npy", mmap_mode="r") for name in _ARRAYS)
    return Labelled(frames, labels, depths, *_looks(task))


def _kept(task: Task, directory: Path) -> Path:
    return directory / task.id


def _looks(task: Task) -> tuple[str | None, Textures | None]:
    """`style` and `textures` of a task's frames."""
    styles = (task.scenario.attribute(name).content.entity.get("RenderStyle") for name in task.attributes)
    style = next((str(one) for one in styles if one in OUTLINES), None)
    return style, task_content(task, EnvConfig().profile).textures if task.maps is None else None


def score(probabilities: np.ndarray, labels: np.ndarray) -> Mapping[str, float]:
    """The average precision of each class that an agent acts on, 0..1: how well its cells stand before all others.

    A cell shows a class if an eighth of its pixels do. Classes in fewer than 100 cells have no score.

    Args:
        probabilities: f32[N h w C], C as LABEL_CLASSES.
        labels: u8[N H W], of any size.
    """
    n, h, w, _ = probabilities.shape
    size = (w * CELL, h * CELL)
    labels = np.stack([cv2.resize(one, size, interpolation=cv2.INTER_NEAREST) for one in labels])
    cells = labels.reshape(n, h, CELL, w, CELL).swapaxes(2, 3).reshape(n, h, w, CELL * CELL)
    found = {}
    for name in SIGHT_CLASSES:
        number = LABEL_CLASSES.index(name)
        shown = (cells == number).sum(axis=-1) >= CELL * CELL / 8
        if shown.sum() >= _MIN_CELLS:
            found[name] = average_precision(probabilities[..., number], shown)
    return found


def average_precision(ratings: np.ndarray, relevant: np.ndarray) -> float:
    """The mean over relevant items of the precision at their rank, by falling rating: 1 if they stand before all else.

    Source: Manning, Raghavan and Schuetze 2008, section 8.4. At equal ratings the order is that of the arrays.
    """
    hits = relevant.ravel()[np.argsort(-ratings.ravel(), kind="stable")]
    precision = np.cumsum(hits) / np.arange(1, hits.size + 1)
    return float(precision[hits].mean())
