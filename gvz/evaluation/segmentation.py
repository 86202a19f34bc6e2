"""Frames with the engine's labels, to train a segmentation network on and to score it by."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from gvz.core.env_config import LABEL_CLASSES, SIGHT_CLASSES, EnvConfig
from gvz.env import DoomEnv
from gvz.evaluation.play import episode_seed
from gvz.evaluation.players import Player, RandomPlayer, ScriptedPlayer
from gvz.scenarios.base import Task
from gvz.scenarios.map_set import MapSet
from gvz.segmentation import INPUT_HEIGHT, INPUT_WIDTH, network_input
from learner.segmentation import CELL
from learner.segmentation_views import changed_view, mirrored

Labelled = tuple[np.ndarray, np.ndarray]
"""frames u8[N INPUT_HEIGHT INPUT_WIDTH 3] and their labels u8[N INPUT_HEIGHT INPUT_WIDTH], numbers of LABEL_CLASSES"""

CLASS_WEIGHTS = np.where(np.isin(LABEL_CLASSES, ("wall", "plane", "weapon")), 1.0, 8.0).astype(np.float32)
"""f32[C] of pixels in the loss: things cover few of them, and all weigh the same, so that none is taken for another"""
_BASE_SEED = 7
"""of the episodes; evaluations have 0"""
_DECISIONS_APART, _FRAMES_PER_EPISODE = 5, 60
"""between frames of an episode, which hardly differ otherwise"""
_DRAWN_DECISIONS_APART, _DRAWN_FRAMES_PER_EPISODE = 12, 10
"""where every episode has another map, so that there are more maps"""
_CLEAN_SHARE = 0.3
"""of a batch's frames that are only mirrored"""
_MIN_CELLS = 100
"""that show a class, for a score of it"""


def drawn_tasks(tasks: Sequence[Task]) -> tuple[Task, ...]:
    """The same tasks on maps with drawn looks (`varied`): each once, without those that only change textures."""
    drawn: dict[str, Task] = {}
    for task in tasks:
        kept = [name for name in task.attributes if "textures" not in task.scenario.attribute(name).groups]
        one = Task(task.scenario, tuple(kept), MapSet("varied"))
        drawn[one.id] = one
    return tuple(drawn.values())


def labelled_frames(task: Task, num_frames: int) -> Labelled:
    """Frames of a task that a random player and the scripted one see in turns, an episode each.

    Raises:
        EngineError: the engine does not start, or dies.
    """
    frames, labels, episode = [], [], 0
    apart, per_episode = _DECISIONS_APART, _FRAMES_PER_EPISODE
    if task.maps is not None:
        apart, per_episode = _DRAWN_DECISIONS_APART, _DRAWN_FRAMES_PER_EPISODE
    config = EnvConfig(frame_height=INPUT_HEIGHT, frame_width=INPUT_WIDTH, buffers=("labels",))
    env = DoomEnv(task, config)
    try:
        while len(frames) < num_frames:
            seed = episode_seed(task.id, episode, _BASE_SEED)
            observation, info = env.reset(options={"episode_seed": seed})
            player: Player = RandomPlayer() if episode % 2 else ScriptedPlayer()
            player.begin(env, observation, info, seed)
            for decision in range(per_episode * apart):
                assert isinstance(observation, dict)
                if decision % apart == 0:
                    frames.append(observation["screen"])
                    labels.append(observation["labels"][:, :, 0])
                observation, _, terminated, truncated, info = env.step(player.act())
                player.observe(observation, info)
                if terminated or truncated or len(frames) == num_frames:
                    break
            episode += 1
    finally:
        env.close()
    return np.stack(frames), np.stack(labels)


def training_batches(tasks: Sequence[Labelled], batch_size: int, seed: int) -> Iterator[Labelled]:
    """Batches without end: (network inputs f32[B 3 H W], labels u8[B H W]), each frame of a task drawn at random."""
    rng = np.random.default_rng(seed)
    while True:
        inputs, answers = [], []
        for _ in range(batch_size):
            (frame, labels), (other, other_labels) = _drawn(rng, tasks), _drawn(rng, tasks)
            if rng.random() >= _CLEAN_SHARE:
                frame, labels = changed_view(rng, frame, labels, other, other_labels)
            frame, labels = mirrored(rng, frame, labels)
            inputs.append(network_input(np.ascontiguousarray(frame)))
            answers.append(labels)
        yield np.stack(inputs), np.stack(answers)


def _drawn(rng: np.random.Generator, tasks: Sequence[Labelled]) -> Labelled:
    frames, labels = tasks[int(rng.integers(len(tasks)))]
    number = rng.integers(len(frames))
    return frames[number], labels[number]


def score(probabilities: np.ndarray, labels: np.ndarray) -> Mapping[str, float]:
    """The average precision of each class that an agent acts on, 0..1: how well its cells stand before all others.

    A cell shows a class if an eighth of its pixels do. Classes in fewer than 100 cells have no score.

    Args:
        probabilities: f32[N h w C], C as LABEL_CLASSES.
        labels: u8[N H W].
    """
    n, h, w, _ = probabilities.shape
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
