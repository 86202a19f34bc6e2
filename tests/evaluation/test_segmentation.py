"""Labelled frames of the real engine, batches of them, and scores of what a network says."""

import itertools
import multiprocessing
import os
import resource
import signal
import subprocess
import sys
import threading
from collections import Counter
from contextlib import closing
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import psutil
import pytest

from gvz.core import janitor
from gvz.core.env_config import LABEL_CLASSES
from gvz.core.errors import GvzError
from gvz.env import DoomEnv
from gvz.evaluation import segmentation
from gvz.evaluation.players import RandomPlayer, ScriptedPlayer
from gvz.evaluation.segmentation import BatchSpec
from gvz.evaluation.workers import _Processes, worker_processes
from gvz.scenarios.base import Textures
from gvz.segmentation import INPUT_HEIGHT, INPUT_WIDTH, network_input
from gvz.tasks import parse_task
from learner.segmentation import normalized
from tests.waiting import wait_until

ENEMY, KIT = LABEL_CLASSES.index("enemy"), LABEL_CLASSES.index("kit")


@pytest.mark.parametrize(
    ("ratings", "relevant", "expected"),
    [
        ([0.9, 0.8, 0.7, 0.1], [1, 1, 0, 0], 1.0),
        ([0.9, 0.8, 0.7, 0.1], [0, 0, 1, 1], (1 / 3 + 2 / 4) / 2),
        ([0.1, 0.8, 0.7, 0.9], [1, 0, 1, 0], (1 / 3 + 2 / 4) / 2),
        ([0.3], [1], 1.0),
    ],
)
def test_average_precision_of_hand_worked_ranks(ratings: list[float], relevant: list[int], expected: float):
    assert segmentation.average_precision(np.array(ratings), np.array(relevant, bool)) == pytest.approx(expected)


def test_a_cell_shows_a_class_if_an_eighth_of_its_pixels_do():
    labels = np.zeros((40, 8, 12), np.uint8)  # 2x3 cells each
    labels[:, 0, :2] = ENEMY  # two pixels of the first cell
    labels[:, 4, 8:11] = ENEMY  # three of the last
    labels[:, 0, 4] = ENEMY  # one of the second: too few
    labels[:20, 7, 0] = KIT
    probabilities = np.full((40, 2, 3, len(LABEL_CLASSES)), 0.1, np.float32)
    probabilities[:, 0, 0, ENEMY], probabilities[:, 1, 2, ENEMY], probabilities[:, 0, 1, ENEMY] = 0.9, 0.5, 0.3
    assert segmentation.score(probabilities[:, :, :], labels) == {}, "80 cells are too few for a score"
    labels, probabilities = np.concatenate([labels] * 2), np.concatenate([probabilities] * 2)
    assert segmentation.score(probabilities, labels) == {"enemy": 1.0}
    probabilities[:, 0, 1, ENEMY] = 1.0  # now 80 cells that show none stand before all
    expected = np.mean([rank / (rank + 80) for rank in range(1, 161)])
    assert segmentation.score(probabilities, labels)["enemy"] == pytest.approx(expected)


def test_things_weigh_more_in_the_loss_than_what_covers_the_screen():
    weights = dict(zip(LABEL_CLASSES, segmentation.CLASS_WEIGHTS.tolist(), strict=True))
    assert {name for name, weight in weights.items() if weight == 1.0} == {"wall", "plane", "weapon"}
    assert set(weights.values()) == {1.0, 8.0}


@pytest.mark.engine
def test_frames_of_varied_maps_show_many_of_them(monkeypatch):
    begun, players = list[str](), list[str]()

    def episode_seed(task_id: str, episode: int, base_seed: int) -> int:
        assert base_seed != 0, "no episodes that evaluations have"
        begun.append(task_id)
        return episode  # and so each its map

    monkeypatch.setattr(segmentation, "episode_seed", episode_seed)
    for kind in (RandomPlayer, ScriptedPlayer):
        monkeypatch.setattr(segmentation, kind.__name__, lambda of=kind: players.append(of.__name__) or of())
    varied, default = "seek_and_kill/varied-10", "seek_and_kill/default"  # every episode lasts for 60 frames
    assert segmentation.labelled_frames(parse_task(varied), 60).textures is None
    assert segmentation.labelled_frames(parse_task(default), 60).textures is not None
    assert begun == [varied] * 3 + [default]
    assert players == ["ScriptedPlayer", "RandomPlayer", "ScriptedPlayer", "ScriptedPlayer"]


@pytest.mark.engine
def test_labelled_frames_are_the_same_each_time_and_show_what_the_task_has():
    task = parse_task("defend_the_center/gore")
    found, again = (segmentation.labelled_frames(task, 90) for _ in range(2))
    assert found.style is None
    assert found.frames.shape == (90, 144, 256, 3)
    assert found.labels.shape == found.depths.shape == (90, 144, 256)
    for one, other in zip(found[:3], again[:3], strict=True):
        np.testing.assert_array_equal(one, other)
    assert {LABEL_CLASSES[n] for n in np.unique(found.labels)} >= {"wall", "plane", "weapon", "enemy", "scenery"}
    assert len({frame.tobytes() for frame in found.frames}) > 80, "few frames are alike"


@pytest.mark.engine
@pytest.mark.parametrize("task", ["seek_and_kill/default", "seek_and_kill/shadows", "defend_the_center/fuzzy_enemies"])
def test_depth_is_that_of_things_even_of_those_that_are_drawn_as_outlines(task: str):
    """The composition of frames needs this. The enemies are taken away: what was behind them has more depth."""
    with closing(DoomEnv(task, frame_height=144, frame_width=256, buffers=("depth", "labels"))) as env:
        observation, _ = env.reset(options={"episode_seed": 1})
        assert env._engine is not None
        for _ in range(30):  # turns until one is in sight
            if (observation["labels"] == ENEMY).sum() > 40:
                break
            observation, *_ = env.step(env.unwrapped.action_meanings.index(("TURN_LEFT",)))
        depth, labels = observation["depth"][:, :, 0], observation["labels"][:, :, 0]
        for kind in ("Demon", "MarineChainsawVzd"):
            env._engine.command(f"remove {kind}")
        env._engine.advance([False] * len(env.task.scenario.buttons), 1)
        state = env._engine.state()
        assert state is not None
        assert (labels == ENEMY).sum() > 40
        behind = state.depth_buffer[labels == ENEMY]
        assert np.median(behind - depth[labels == ENEMY].astype(int)) > 0
        assert not depth[labels == LABEL_CLASSES.index("weapon")].any(), "nothing is put before the weapon"


@pytest.mark.engine
def test_frames_know_the_render_style_of_which_only_outlines_are_seen():
    tasks = ("seek_and_kill/shadows", "defend_the_center/fast_enemies+fuzzy_enemies", "health_gathering/shaded_kits")
    styles = [segmentation.labelled_frames(parse_task(task), 1).style for task in tasks]
    assert styles == ["STYLE_Shadow", "STYLE_Fuzzy", None]


@pytest.mark.engine
def test_frames_know_the_textures_of_their_task():
    names = ("default", "shadows", "red", "red+shadows")
    default, shadows, red, both = (
        segmentation.labelled_frames(parse_task(f"seek_and_kill/{name}"), 1).textures for name in names
    )
    assert default is not None
    assert shadows == default
    assert both == red != default


def test_batches_hold_screens_and_labels_of_all_tasks_and_follow_from_their_numbers():
    rng = np.random.default_rng(0)
    tasks = [
        segmentation.Labelled(
            rng.integers(0, 256, (5, 144, 256, 3), dtype=np.uint8),
            np.full((5, 144, 256), n, np.uint8),
            np.full((5, 144, 256), 9, np.uint8),
        )
        for n in (ENEMY, KIT)
    ]
    made = segmentation.Batches(tasks, BatchSpec(8, seed=3))
    batches = list(itertools.islice(made, 4))
    assert {int(n) for _, labels in batches for n in np.unique(labels)} == {ENEMY, KIT}
    assert not np.array_equal(batches[0][0], batches[1][0])
    for number in (3, 1, 0, 2):
        screens, labels = batches[number]
        assert (screens.shape, screens.dtype) == ((8, INPUT_HEIGHT, INPUT_WIDTH, 3), np.uint8)
        again, labels_again = made.batch(number)
        np.testing.assert_array_equal(again, screens)
        np.testing.assert_array_equal(labels_again, labels)


def test_most_views_are_changed_and_moved_and_have_the_surroundings_that_gain_most(monkeypatch):
    """Of 300 views; each step is noted instead of done, and surroundings gain by their depth."""
    noted, drawn = Counter[str](), list[int]()

    def gained(shots, surroundings) -> int:
        assert len(shots) == 3, "a frame and two others"
        drawn.append(int(surroundings.depth[0, 0]))
        return drawn[-1]

    def changed(_rng, shot, surroundings, _decorations, others, styles, tints_and_patches):
        noted["changed"] += 1
        assert (len(others), styles, tints_and_patches) == (2, ["STYLE_Shadow"], False)
        assert surroundings.depth[0, 0] == max(drawn[-3:])
        return shot.frame, shot.labels

    def noting(name: str):
        return lambda *given: (noted.update([name]), [one for one in given if isinstance(one, np.ndarray)])[1]

    monkeypatch.setattr(segmentation, "num_pixels_gained", gained)
    monkeypatch.setattr(segmentation, "changed_view", changed)
    for name in ("moved", "shrunk", "mirrored"):
        monkeypatch.setattr(segmentation, name, noting(name))
    frames, labels = np.zeros((1, 2, 2, 3), np.uint8), np.zeros((1, 2, 2), np.uint8)
    tasks = [segmentation.Labelled(frames, labels, labels + n, "STYLE_Shadow" if n else None) for n in range(4)]
    segmentation.Batches(tasks, BatchSpec(300, seed=0, tints_and_patches=False)).batch(0)
    assert len(drawn) == 3 * noted["changed"]
    assert noted["mirrored"] == noted["moved"] + noted["shrunk"] == 300
    assert noted["changed"] == pytest.approx(300 * 0.85, abs=24)
    assert noted["moved"] == pytest.approx(300 * 0.85 * 0.7, abs=32)


@pytest.mark.engine
def test_workers_make_the_same_batches(tmp_path):
    tasks = [parse_task(f"seek_and_kill/{name}") for name in ("default", "shadows")]
    here = segmentation.Batches([segmentation.labelled_frames(task, 3) for task in tasks], BatchSpec(2, seed=5))
    with worker_processes(2, "died") as executor:
        list(executor.map(partial(segmentation.keep_frames, num_frames=3, directory=tmp_path), tasks))
        theirs = list(
            itertools.islice(segmentation.batches_of_workers(executor, 3, tasks, tmp_path, BatchSpec(2, seed=5)), 6)
        )
    assert len(theirs) == 6
    for (screens, labels), (screens_there, labels_there) in zip(here, theirs, strict=False):
        np.testing.assert_array_equal(screens_there, screens)
        np.testing.assert_array_equal(labels_there, labels)


def test_a_worker_keeps_to_one_core():
    with worker_processes(1, "died") as executor:
        assert executor.submit(cv2.getNumThreads).result() == 1


def test_a_worker_that_dies_is_told_and_the_others_end():
    before = set(multiprocessing.active_children())
    with pytest.raises(GvzError, match="one of them died"), worker_processes(2, "one of them died") as executor:
        executor.submit(os._exit, 1).result()
    assert set(multiprocessing.active_children()) <= before


def test_a_worker_that_cannot_be_started_is_told_and_those_before_it_end():
    before = set(multiprocessing.active_children())
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    message = r"worker process ([2-9]|1\d) of 40 cannot be started: Too many open files; use fewer"
    resource.setrlimit(resource.RLIMIT_NOFILE, (psutil.Process().num_fds() + 20, limits[1]))
    try:
        with pytest.raises(GvzError, match=message), worker_processes(40, "died"):
            pytest.fail("the block ran")
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)
    assert set(multiprocessing.active_children()) <= before


def test_also_the_first_worker_is_started_without_signals():
    """Python's resource tracker, which the first spawn of a process starts, would unblock two of them."""
    code = (
        "import signal; from multiprocessing import util\n"
        "from gvz.core.stop import SIGNALS; from gvz.evaluation.workers import worker_processes\n"
        "spawn, blocked = util.spawnv_passfds, []\n"
        "def noted(*arguments):\n"
        "    blocked.append(signal.pthread_sigmask(signal.SIG_BLOCK, ()))\n"
        "    return spawn(*arguments)\n"
        "util.spawnv_passfds = noted\n"
        "with worker_processes(1, 'died'): assert blocked[-1].issuperset(SIGNALS), blocked\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_a_second_ctrl_c_comes_after_the_clean_up(monkeypatch):
    before, left, kill = set(multiprocessing.active_children()), [], _Processes.kill

    def interrupted(processes):
        signal.raise_signal(signal.SIGINT)
        kill(processes)

    monkeypatch.setattr(_Processes, "kill", interrupted)
    monkeypatch.setattr(
        janitor, "clean_dead_instances", lambda: left.append(set(multiprocessing.active_children()) - before)
    )
    with pytest.raises(KeyboardInterrupt) as raised, worker_processes(1, "died"):
        raise KeyboardInterrupt("the first")
    assert raised.value.args == ()
    assert left == [set()]


def test_a_worker_s_error_is_raised_here_and_the_worker_goes_on():
    with worker_processes(1, "died") as executor:
        with pytest.raises(ZeroDivisionError) as raised:
            executor.submit(divmod, 1, 0).result()
        assert "in a worker process" in raised.value.__notes__[0]
        with pytest.raises(TypeError, match="pickle"):
            executor.submit(threading.Lock).result()
        assert executor.submit(divmod, 7, 2).result() == (3, 1)


def test_workers_have_nothing_in_shared_memory_that_a_kill_of_all_processes_would_leave():
    code = (
        "import os; from gvz.evaluation.workers import worker_processes\n"
        "if __name__ == '__main__':\n"
        "    with worker_processes(2, 'died') as executor:\n"
        "        print(*{executor.submit(os.getpid).result() for _ in range(9)}, flush=True); input()"
    )
    command = [sys.executable, "-c", code]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True) as client:
        assert client.stdout is not None
        workers = [int(pid) for pid in client.stdout.readline().split()]
        mapped = [Path(f"/proc/{pid}/maps").read_text() for pid in (client.pid, *workers)]
        os.killpg(client.pid, signal.SIGKILL)
    assert workers
    assert not any("/dev/shm" in maps for maps in mapped)
    wait_until(lambda: not any(map(janitor.process_start, workers)), "the workers' end")


def test_a_screen_is_normalized_in_training_as_it_is_later():
    screens = np.random.default_rng(0).integers(10, 90, (2, INPUT_HEIGHT, INPUT_WIDTH, 3), dtype=np.uint8)
    screens[1] = 0
    expected = [np.moveaxis(network_input(screen), 0, -1) for screen in screens]
    np.testing.assert_allclose(normalized(screens), expected, atol=2e-6)  # ten seeds, three instruction sets: 2.4e-7


def test_decorations_come_into_the_frames_of_tasks_that_have_none():
    """One task of eight has decorations, and every third frame gets them: 0.85 changed, 0.85 elsewhere, half of these.

    Puffs of shots, which every task has, are no decorations.
    """
    scenery, effect = LABEL_CLASSES.index("scenery"), LABEL_CLASSES.index("effect")
    labels = np.zeros((8, 3, 144, 256), np.uint8)
    labels[:, :, 40:60, 40:60], labels[0, :, 80:120, 100:140] = effect, scenery
    frames = np.random.default_rng(0).integers(0, 256, (3, 144, 256, 3), dtype=np.uint8)
    tasks = [segmentation.Labelled(frames, one, np.full((3, 144, 256), 9, np.uint8)) for one in labels]
    batches = itertools.islice(segmentation.Batches(tasks, BatchSpec(8, seed=0)), 75)
    shown = np.mean([(one == scenery).any() for _, answers in batches for one in answers])
    assert 0.39 <= shown <= 0.57, "0.36, and some of the 600 frames that are of this task; ten seeds: 0.45 to 0.52"


def test_surroundings_of_each_look_are_drawn_as_often():
    """Seven tasks have one look, and the eighth has another. None shows a thing, so all surroundings are as good.

    Of a hundred frames, 28 keep their own surroundings, an eighth of these the eighth task's. 72 get others, half of
    these the eighth task's. It would be an eighth of all if tasks were drawn.
    """
    rng = np.random.default_rng(0)
    grey, red = Textures("A", "A", "A"), Textures("B", "B", "B")
    wall, plane = LABEL_CLASSES.index("wall"), LABEL_CLASSES.index("plane")
    frames = rng.integers(0, 256, (3, 144, 256, 3), dtype=np.uint8)
    labels = [np.full((3, 144, 256), plane if n < 7 else wall, np.uint8) for n in range(8)]
    depths = np.full((3, 144, 256), 9, np.uint8)
    tasks = [segmentation.Labelled(frames, one, depths, None, grey if n < 7 else red) for n, one in enumerate(labels)]
    batches = itertools.islice(segmentation.Batches(tasks, BatchSpec(8, seed=0)), 75)
    shown = np.mean([(one == wall).any() for _, answers in batches for one in answers])
    assert 0.31 <= shown <= 0.48, "0.28 / 8 + 0.72 / 2 = 0.40; 0.125 if tasks were drawn"


def test_a_network_sees_frames_of_mean_zero_whatever_their_light():
    rng = np.random.default_rng(0)
    screen = rng.integers(40, 120, (144, 256, 3), dtype=np.uint8)
    dark, bright = network_input(screen), network_input(screen * 2)
    assert dark.shape == (3, INPUT_HEIGHT, INPUT_WIDTH)
    assert abs(dark.mean()) < 1e-5
    np.testing.assert_allclose(dark.std() * (1 + 12.75 / np.std(screen)), 1, rtol=0.2)
    assert np.corrcoef(dark.ravel(), bright.ravel())[0, 1] > 0.999
