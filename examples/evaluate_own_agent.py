"""Evaluates any function of frames by the benchmark's protocol, on the same episodes as every other player.

python examples/evaluate_own_agent.py --episodes 100 --workers 4; gvz report own_agent.jsonl
"""

from functools import partial
from pathlib import Path

import numpy as np
import tyro

from gvz.core.env_config import EnvConfig
from gvz.evaluation.episode_log import evaluate_player
from gvz.evaluation.play import Row
from gvz.evaluation.players import FramePlayer
from gvz.evaluation.statistics import bootstrap
from gvz.tasks import Task, named_tasks

ATTACK, TURN_LEFT, TURN_RIGHT = range(3)


def choose(stack: np.ndarray) -> int:
    """Turns to where the picture of Defend the Center changes most, and fires when that is the middle.

    stack: u8[48, 84, 2], the last two frames, the older one first.
    """
    moved = np.abs(stack[10:38, :, 1].astype(int) - stack[10:38, :, 0])
    left, middle, right = moved[:, :36].sum(), moved[:, 36:48].sum() * 3, moved[:, 48:].sum()
    return ATTACK if middle >= max(left, right) else TURN_LEFT if left > right else TURN_RIGHT


def mean_score(rows: list[Row], task: Task) -> str:
    """Mean with its 95% bootstrap interval."""
    return str(bootstrap([np.array([row["score"] for row in rows if row["task"] == task.id])]))


def main(
    name: str = "motion", episodes: int = 3, level: int = 0, workers: int = 0, out: Path = Path("own_agent.jsonl")
):
    """Plays every named task of a level; the same command resumes an interrupted evaluation.

    Episodes of a name are played once: whoever changes `choose` gives another name.
    """
    tasks = named_tasks("defend_the_center", level=level)
    rows = evaluate_player(
        partial(FramePlayer, choose, stack_size=2),
        tasks,
        out,
        name=name,
        episodes=episodes,
        env=EnvConfig(frame_height=48, grayscale=True),
        num_workers=workers,
    )
    for task in tasks:
        print(f"{task.id}: {mean_score(rows, task)} of {task.scenario.upper_bound('thesis'):.0f}")


if __name__ == "__main__":
    tyro.cli(main)
