"""Curricula: which task is drawn, and that a run goes on with the same draws."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest

from actors.pool import lanes_to_begin_with
from gvz.core.env_config import EnvConfig
from gvz.core.errors import ConfigError
from gvz.run.assemble import assemble
from gvz.run.config_files import load_config
from gvz.run.curriculum import Curriculum
from gvz.run.curriculum_config import CurriculumConfig, first_tasks, steps_of
from gvz.run.monitor import Counts
from gvz.run.train import Trainer
from gvz.task_table import task_table
from gvz.transport.messages import EpisodeStats

TASKS = tuple(f"defend_the_center/{name}" for name in ("default", "gore", "stone_wall", "gore+mossy_bricks"))
TABLE = task_table(TASKS, EnvConfig(), 0.99)
"""levels 0, 1, 1, 2"""


def ended(task: int) -> EpisodeStats:
    return EpisodeStats(
        lane=0, task=task, episode=0, seed=0, score=0.0, reward=0.0, reward_components={}, length_frames=4,
        length_steps=1, params_version=0, terminated=True, truncated=False, cut=False,
    )  # fmt: skip


def curriculum(state=None, **fields) -> Curriculum:
    return Curriculum(CurriculumConfig(**fields), TABLE, 7, state)


def play(lessons: Curriculum, percent_of, episodes: int) -> list[int]:
    """The tasks drawn, each played as soon as it is drawn; scores are percent_of(task, number), or a number."""
    drawn = [0]
    for number in range(episodes):
        drawn.append(
            lessons.next_task(ended(drawn[-1]), percent_of(drawn[-1], number) if callable(percent_of) else percent_of)
        )
    return drawn[1:]


def test_games_begin_with_tasks_of_open_levels():
    assert first_tasks(CurriculumConfig(kind="level"), TABLE) == (0,)
    assert first_tasks(CurriculumConfig(kind="uniform"), TABLE) == (0, 1, 2, 3)
    config = load_config("rainbow_4task")
    pool = assemble(dataclasses.replace(config, curriculum=CurriculumConfig(kind="level")), Path()).pool_config
    easiest = np.flatnonzero(np.equal(steps_of(config.table), 0))
    assert sorted(set(lanes_to_begin_with(pool, None).tasks)) == list(easiest)
    assert 0 < len(easiest) < len(config.table)


def test_a_fixed_game_keeps_its_task():
    assert curriculum().next_task(ended(2), 10.0) is None


def test_uniform_draws_every_task_alike():
    counts = np.bincount(play(curriculum(kind="uniform"), 0.0, 4_000), minlength=4)
    assert np.abs(counts - 1_000).max() < 4 * 1_000**0.5


def test_the_lane_whose_episode_has_ended_has_the_task_that_was_drawn_and_a_cut_episode_draws_none():
    assigned, drawn = list[tuple[int, int]](), list[tuple[int, float]]()
    trainer, silent = Trainer.__new__(Trainer), lambda *_, **__: None
    told = [msgspec.structs.replace(ended(task), lane=9 - task, score=110.0, cut=task == 1) for task in range(3)]
    parts: Any = SimpleNamespace(table=TABLE)
    pool: Any = SimpleNamespace(poll=lambda: told, assign=lambda *given: assigned.append(given))
    lessons: Any = SimpleNamespace(next_task=lambda end, percent: drawn.append((end.task, percent)) or 3 - end.task)
    trainer._parts, trainer._pool, trainer._curriculum, trainer._counts = parts, pool, lessons, Counts()
    trainer._telemetry = SimpleNamespace(episode=silent)  # pyright: ignore
    trainer._learner = SimpleNamespace(add_episode=silent)  # pyright: ignore
    trainer._supervise()
    assert drawn == [(0, 10.0), (2, 10.0)]
    assert assigned == [(9, 3), (7, 1)]


def test_runs_of_other_seeds_draw_other_tasks():
    drawn = [play(Curriculum(CurriculumConfig(kind="uniform"), TABLE, seed), 0.0, 40) for seed in (7, 7, 8)]
    assert drawn[0] == drawn[1] != drawn[2]


def test_the_next_level_opens_when_every_task_of_the_last_is_learned():
    lessons = curriculum(kind="level", learned_percent=60.0, window_episodes=5)
    assert set(play(lessons, 59.0, 50)) == {0}
    for _ in range(5):
        lessons.next_task(ended(0), 61.0)
    np.testing.assert_allclose(lessons.probabilities(), [1 / 3, 1 / 3, 1 / 3, 0])
    for number in range(10):
        lessons.next_task(ended(1), 100.0)
        assert lessons.probabilities()[3] == 0, number
    for _ in range(5):
        lessons.next_task(ended(2), 60.0)
    np.testing.assert_allclose(lessons.probabilities(), [1 / 4] * 4)
    for _ in range(5):
        lessons.next_task(ended(0), 0.0)
    resumed = curriculum(lessons.state(), kind="level", learned_percent=60.0, window_episodes=5)
    np.testing.assert_allclose(resumed.probabilities(), [1 / 4] * 4, err_msg="a level that was opened stays open")


def test_drawn_maps_open_by_their_strength():
    names = [f"procedural-train+layout={x}+textures={x}+decorations={x}+lights={x}+entities={x}" for x in (0.5, 0)]
    table = task_table(("health_gathering/procedural", *(f"health_gathering/{n}" for n in names)), EnvConfig(), 0.99)
    lessons = Curriculum(CurriculumConfig(kind="level", window_episodes=2, learned_percent=50.0), table, 7)
    for opened in ([0, 0, 1], [0, 0.5, 0.5], [1 / 3] * 3):
        np.testing.assert_allclose(lessons.probabilities(), opened)
        newest = np.flatnonzero(opened)[0] if opened[0] else len(opened) - np.count_nonzero(opened)
        for _ in range(2):
            lessons.next_task(ended(int(newest)), 60.0)


def test_progress_draws_where_the_score_moves_most():
    lessons = curriculum(kind="progress", staleness_share=0.0)
    counts = np.bincount(play(lessons, lambda task, number: number / 20 if task == 2 else 30.0, 2_000), minlength=4)
    by_rank = 1 / np.arange(1, 5) / (1 / np.arange(1, 5)).sum()
    assert counts[2] / 2_000 == pytest.approx(by_rank[0], abs=0.06)
    lessons = curriculum(kind="progress", staleness_share=1.0)
    drawn = np.array(play(lessons, 30.0, 2_000))
    assert np.diff(np.flatnonzero(drawn == 3)).max() < 30, "a stale task comes back"
    since = np.array([np.argmax(drawn[::-1] == task) for task in range(4)])  # the last draw was of one that has 0
    np.testing.assert_allclose(lessons.probabilities(), since / since.sum())
    lessons = curriculum(kind="progress", staleness_share=0.0, temperature=0.5)
    play(lessons, 30.0, 8)
    squares = np.array([1 / 16, 1 / 9, 1 / 4, 1])  # (1 / rank)^(1 / 0.5)
    np.testing.assert_allclose(sorted(lessons.probabilities()), squares / squares.sum())


def test_progress_is_the_distance_of_the_last_score_and_its_average_over_five_windows():
    """With windows of one episode the average keeps 4/5 of its distance from the score at each episode."""
    lessons = curriculum(kind="progress", staleness_share=0.0, window_episodes=1)
    for task, scores in enumerate(([50, 40, 40, 40], [50, 56], [50, 43.4])):  # 10 * 0.8^3 = 5.12, 4.8 and 5.28
        for score in scores:
            lessons.next_task(ended(task), score)
    np.testing.assert_array_equal(lessons.probabilities(), [0, 0, 0, 1], "a task without a score comes first")
    lessons.next_task(ended(3), 50)
    np.testing.assert_allclose(lessons.probabilities(), np.array([1 / 2, 1 / 3, 1, 1 / 4]) * 12 / 25)


@pytest.mark.parametrize(
    "settings",
    [
        {"kind": "uniform"},
        {"kind": "level", "window_episodes": 4, "learned_percent": 0.0},
        {"kind": "progress", "window_episodes": 4},
    ],
    ids=["uniform", "level", "progress"],
)
def test_a_run_that_goes_on_draws_the_same(settings):
    def score(task, number):
        return 10.0 * task + number % 7

    whole = curriculum(**settings)
    play(whole, score, 40)
    state = msgspec.msgpack.decode(msgspec.msgpack.encode(whole.state()))
    resumed = curriculum(state, **settings)
    assert play(whole, score, 40) == play(resumed, score, 40)


def test_what_cannot_be_is_refused():
    config = load_config("rainbow_quick")
    for kind, message in (
        ("level", "all tasks have level 0"),
        ("uniform", "got uniform for one task"),
        ("progress", "got progress for one task"),
    ):
        with pytest.raises(ConfigError, match=message):
            dataclasses.replace(config, curriculum=CurriculumConfig(kind=kind))
    for kind, unused in (("uniform", "window_episodes"), ("level", "temperature"), ("progress", "learned_percent")):
        with pytest.raises(ConfigError, match=rf"curriculum\.{unused}: got 9.*curriculum\.kind {kind}"):
            CurriculumConfig(kind=kind, **{unused: 9})
    with pytest.raises(ConfigError, match=r"curriculum\.learned_percent: got 101\.0, want 0\.\.100"):
        CurriculumConfig(learned_percent=101.0)
