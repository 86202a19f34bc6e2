"""How much enemies differ from their surroundings in the frames that an agent sees.

    python -m benchmarks.contrast

measures this for Seek and Kill's `default` and for `complete` with each of its textures, and writes
results/reference/contrast.json.
"""

import json
from contextlib import closing

import cv2
import numpy as np

from benchmarks.reference import RECORDS
from gvz.core.env_config import LABEL_CLASSES, EnvConfig
from gvz.env import DoomEnv
from gvz.scenarios.base import Task
from gvz.tasks import scenario_named

FILE = RECORDS / "contrast.json"
ENEMY = LABEL_CLASSES.index("enemy")
NUM_EPISODES = 40
DECISIONS = 120
"""of an episode; every LOOK_PERIODth frame is measured"""
LOOK_PERIOD = 6
MIN_PIXELS = 12
"""least size of an enemy and of its surroundings in the agent's frame; smaller ones are not measured"""
RING_PIXELS = 4
"""width of the ring round an enemy that counts as its surroundings"""
STATUS_BAR_ROW = 70
"""of 84; below it is the status bar"""
LUMINANCE = (0.299, 0.587, 0.114)


def contrast(pixels: np.ndarray, around: np.ndarray) -> float:
    """Distance of the mean luminances in standard deviations of the surroundings' luminance.

    Args:
        pixels: of the thing, [N, 3].
        around: of what is round it, [M, 3].
    """
    inside, outside = pixels @ LUMINANCE, around @ LUMINANCE
    return float(abs(inside.mean() - outside.mean()) / max(outside.std(), 1.0))


def separation(pixels: np.ndarray, around: np.ndarray) -> float:
    """Fisher's distance of the mean colours: the contrast in the mixture of red, green and blue that separates best.

    Args:
        pixels: of the thing, [N, 3].
        around: of what is round it, [M, 3].
    """
    gap = pixels.mean(axis=0) - around.mean(axis=0)
    return float(np.sqrt(gap @ np.linalg.solve(np.cov(around.T) + np.eye(3), gap)))


def measure_contrast(task: Task, num_episodes: int = NUM_EPISODES) -> dict[str, float]:
    """Medians over the enemies that a randomly walking agent meets.

    Returns: num_enemies (sightings), contrast, separation.

    Raises:
        EngineError: the engine failed.
    """
    rng = np.random.default_rng(0)
    found = []
    with closing(DoomEnv(task, EnvConfig(buffers=("labels",)), recycle_episodes=0)) as env:
        walk = [env.action_meanings.index((button,)) for button in ("MOVE_FORWARD", "TURN_LEFT", "TURN_RIGHT")]
        for episode in range(num_episodes):
            env.reset(options={"episode_seed": episode})
            action = walk[0]
            for decision in range(DECISIONS):
                if decision % LOOK_PERIOD == 0:
                    action = rng.choice(walk, p=[0.5, 0.25, 0.25])
                observation, _, terminated, truncated, _ = env.step(action)
                if terminated or truncated:
                    break
                if decision % LOOK_PERIOD == LOOK_PERIOD - 1:
                    assert isinstance(observation, dict)
                    found += _sightings(observation["screen"], observation["labels"][..., 0] == ENEMY)
    medians = np.median(found, axis=0)
    return {"num_enemies": len(found), "contrast": float(medians[0]), "separation": float(medians[1])}


def _sightings(screen: np.ndarray, enemies: np.ndarray) -> list[tuple[float, float]]:
    """Contrast and separation of each enemy, or group of enemies that touch, that is large enough."""
    values = []
    kernel = np.ones((2 * RING_PIXELS + 1,) * 2, np.uint8)
    num_groups, groups = cv2.connectedComponents(enemies.astype(np.uint8))
    for group in range(1, num_groups):
        inside = groups == group
        around = cv2.dilate(inside.astype(np.uint8), kernel).astype(bool) & ~enemies
        around[STATUS_BAR_ROW:] = False
        if min(inside.sum(), around.sum()) >= MIN_PIXELS:
            values.append((contrast(screen[inside], screen[around]), separation(screen[inside], screen[around])))
    return values


def main() -> None:
    """Measures and writes FILE."""
    scenario = scenario_named("seek_and_kill")
    textures = [a.name for a in scenario.attributes if "textures" in a.groups]
    rest = tuple(name for name in scenario.complete if name not in textures)
    sets = {"default": (), **{f"complete with {name}": (name, *rest) for name in textures}}
    rows = {name: measure_contrast(Task(scenario, attributes)) for name, attributes in sets.items()}
    FILE.write_text(json.dumps({"command": "python -m benchmarks.contrast", "rows": rows}, indent=1) + "\n")
    print(FILE.read_text())


if __name__ == "__main__":
    main()
