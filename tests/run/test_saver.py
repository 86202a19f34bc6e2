"""The checkpoints of a run over its life: when they are written, and which stay."""

import shutil
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gvz.core.durable import saved_steps
from gvz.core.errors import ResumeError
from gvz.run.config import CheckpointConfig
from gvz.run.monitor import Counts
from gvz.run.saver import Saver, Snapshot
from learner import checkpoint

STATE = {"w": np.zeros(2, np.float32)}


ALONE: Any = SimpleNamespace(num_common_saved=None, may_save=lambda: True)


def started(
    path: Path, num_updates: int, keep: int = 2, report: Callable[[str, float], None] = lambda *_: None
) -> tuple[Saver, Counts]:
    counts = Counts(updates=num_updates, saved_updates=num_updates)
    run: Any = SimpleNamespace(path=path, checkpoints=path / "checkpoints")
    snapshot = Snapshot(STATE, STATE, {})
    config = CheckpointConfig(period_updates=1000, period_s=900.0, keep=keep)
    return Saver(run, config, counts, lambda: snapshot, report), counts


def test_a_slow_run_is_saved_after_a_time_and_still_at_the_multiples(tmp_path, monkeypatch):
    now_s = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now_s[0])
    saver, counts = started(tmp_path, 0)
    several: Any = SimpleNamespace(num_common_saved=0, may_save=lambda: True)
    another_writes: Any = SimpleNamespace(num_common_saved=0, may_save=lambda: False)
    saved = []
    for at_s, num_updates, group in (
        (901, 0, ALONE),  # its warm-up
        (902, 3, several),  # processes have clocks of their own, so they agree on gradient steps alone
        (903, 3, ALONE),
        (1000, 60, ALONE),
        (1804, 700, ALONE),
        (1805, 1000, another_writes),
        (1805, 1001, ALONE),  # a multiple of the period in gradient steps
        (2704, 1500, ALONE),
        (2706, 1500, ALONE),
    ):
        now_s[0], counts.updates = at_s, num_updates
        saver.save_when_due(group)
        saver.wait()
        if (newest := max(saved_steps(tmp_path / "checkpoints"), default=0)) not in saved:
            saved.append(newest)
    assert saved == [0, 3, 700, 1001, 1500]


def test_last_checkpoints_of_a_process_that_ends_alone_leave_the_one_that_all_have(tmp_path):
    group: Any = SimpleNamespace(num_common_saved=0, may_save=lambda: True)
    saver, counts = started(tmp_path, 0)
    for counts.updates in (1000, 2000):
        saver.save_when_due(group)
        assert saver.wait() == ""
        assert saver.num_saved == counts.updates
        group.num_common_saved = counts.updates
    assert saved_steps(tmp_path / "checkpoints") == [1000, 2000]
    for last in (2100, 2200):  # its actors fail, twice, and no other process has saved since 2000
        counts.updates = last
        saver.save_last(group, lambda: None)
        assert 2000 in saved_steps(tmp_path / "checkpoints")
        saver, counts = started(tmp_path, 2000)
        group.num_common_saved = 0  # until the processes have agreed on a step
    counts.updates = 2300
    saver.save_last(ALONE, lambda: None)
    assert saved_steps(tmp_path / "checkpoints") == [2200, 2300]


def test_a_checkpoint_that_is_given_up_takes_no_place_of_a_whole_one(tmp_path, monkeypatch):
    """A second Ctrl-C removes its files while the thread has just written the last of them."""
    saver, counts = started(tmp_path, 0, keep=1)
    counts.updates = 1000
    saver.save_last(ALONE, lambda: None)
    written, removing = threading.Event(), threading.Event()
    fsync_tree, rmtree = checkpoint.fsync_tree, shutil.rmtree

    def wait_for_the_removal(directory: Path) -> None:
        fsync_tree(directory)
        if directory.parent.name == "checkpoints":
            written.set()
            assert removing.wait(30)

    def remove_in_two_parts(path: Path, **options: bool) -> None:
        if threading.current_thread() is threading.main_thread():
            (path / "host.msgpack").unlink()
            removing.set()
            thread.join(30)
        rmtree(path, **options)

    monkeypatch.setattr(checkpoint, "fsync_tree", wait_for_the_removal)
    monkeypatch.setattr(shutil, "rmtree", remove_in_two_parts)
    counts.updates = 2000
    saver.save_when_due(ALONE)
    thread = next(thread for thread in threading.enumerate() if thread.name == "checkpoint 2000")
    assert written.wait(30)
    saver.abandon()
    assert not thread.is_alive()
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["1000"]
    checkpoint.verify(tmp_path / "checkpoints" / "1000")
    assert saver.wait() == "", "nobody is told that it is tried again"


@pytest.mark.parametrize("folder", ["checkpoints", "policies"])
def test_folders_that_cannot_be_made_are_told_in_one_line(tmp_path, folder):
    (tmp_path / folder).touch()
    with pytest.raises(ResumeError, match=f"^run directory {tmp_path}: File exists; mend this"):
        started(tmp_path, 0)


@pytest.mark.parametrize(
    ("where", "error", "said"),
    [
        ((threading.Thread, "start"), RuntimeError("can't start new thread"), "written: can't start new thread"),
        ((checkpoint, "snapshot"), MemoryError("8 GiB"), "there is no memory for a copy of its arrays: 8 GiB"),
    ],
    ids=["thread", "memory"],
)
def test_a_save_that_cannot_begin_is_reported_and_tried_again(tmp_path, monkeypatch, where, error, said):
    def fail(*_: object) -> None:
        raise error

    now_s, failures, retries_s = [0.0], list[str](), list[float]()
    monkeypatch.setattr(time, "monotonic", lambda: now_s[0])
    saver, counts = started(tmp_path, 0, report=lambda *told: (failures.append(told[0]), retries_s.append(told[1])))
    counts.updates = 1000
    with monkeypatch.context() as short:
        short.setattr(*where, fail)
        saver.save_when_due(ALONE)
        assert saver.wait() == failures[0]
        for now_s[0] in (59.0, 61.0, 180.0, 182.0, *map(float, range(10_000, 11_000_000, 10_000))):
            saver.save_when_due(ALONE)
            saver.wait()
    assert retries_s == [60.0, 120.0, 240.0, 480.0, 960.0, 1920.0, *[3600.0] * 1096], "a float has no 1,024th double"
    assert said in failures[0]
    assert saver.behind
    assert saver.num_saved == 0
    saver.save_last(ALONE, lambda: None)
    assert saved_steps(tmp_path / "checkpoints") == [1000]
    assert len(failures) == len(retries_s)
