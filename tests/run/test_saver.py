"""The checkpoints of a run over its life: which stay when one of several processes ends alone."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from gvz.core.durable import saved_steps
from gvz.run.config import CheckpointConfig
from gvz.run.monitor import Counts
from gvz.run.saver import Saver, Snapshot

STATE = {"w": np.zeros(2, np.float32)}


def started(path: Path, num_updates: int) -> tuple[Saver, Counts]:
    counts = Counts(updates=num_updates, saved_updates=num_updates)
    run: Any = SimpleNamespace(path=path, checkpoints=path / "checkpoints")
    snapshot = Snapshot(STATE, STATE, {})
    return Saver(run, CheckpointConfig(period_updates=1000, keep=2), counts, lambda: snapshot, lambda *_: None), counts


def test_last_checkpoints_of_a_process_that_ends_alone_leave_the_one_that_all_have(tmp_path):
    group: Any = SimpleNamespace(num_common_saved=0, may_save=lambda: True)
    saver, counts = started(tmp_path, 0)
    for counts.updates in (1000, 2000):
        saver.save_when_due(group)
        assert saver.wait() == ""
        group.num_common_saved = counts.updates
    assert saved_steps(tmp_path / "checkpoints") == [1000, 2000]
    for last in (2100, 2200):  # its actors fail, twice, and no other process has saved since 2000
        counts.updates = last
        saver.save_last(group, lambda: None)
        assert 2000 in saved_steps(tmp_path / "checkpoints")
        saver, counts = started(tmp_path, 2000)
        group.num_common_saved = 0  # until the processes have agreed on a step
    alone: Any = SimpleNamespace(num_common_saved=None)
    counts.updates = 2300
    saver.save_last(alone, lambda: None)
    assert saved_steps(tmp_path / "checkpoints") == [2200, 2300]
