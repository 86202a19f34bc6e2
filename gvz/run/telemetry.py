"""What a run records about itself: rows of metrics, episodes and faults, TensorBoard events, Weights & Biases.

Scalars are named `group/name_unit` and are the same in metrics.jsonl and wherever else they go; each is explained in
docs/reference/metrics.md. Episode rows carry no wall-clock time, so that two synchronous runs with one seed write the
same bytes.
"""

import errno
import io
import json
import os
import socket
import struct
import time
import uuid
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
from tensorboardX.proto.event_pb2 import Event, SessionLog  # pyright: ignore[reportAttributeAccessIssue]  # made at run time
from tensorboardX.record_writer import masked_crc32c
from tensorboardX.summary import scalar

from gvz.core.errors import ConfigError
from gvz.core.files import written_whole
from gvz.run.config import LogConfig
from gvz.run.progress import TaskStatus
from gvz.run.rundir import RunDir, disk_checked
from gvz.task_table import TaskTable
from gvz.transport.messages import EpisodeStats, Fault

RECENT_EPISODES = 30
"""episodes in a task's recent score (as `learner.kpi_window_episodes`)"""
UPLOAD_TIMEOUT_S = 600.0
"""for what is not yet with Weights & Biases when a run ends; the rest stays in `wandb/`, for `wandb sync`"""


class Rates:
    """Rates per second of counters between two calls."""

    def __init__(self) -> None:
        self._last: dict[str, float] = {}
        self._time_s = time.monotonic()

    def __call__(self, counters: Mapping[str, float]) -> dict[str, float]:
        """The rate of each counter since the last call, per second; 0 at the first."""
        now = time.monotonic()
        passed_s = max(now - self._time_s, 1e-9)
        rates = {name: (value - self._last.get(name, value)) / passed_s for name, value in counters.items()}
        self._last, self._time_s = dict(counters), now
        return rates


class Telemetry:
    """Writes the records of one run and remembers the recent score of each task."""

    def __init__(self, run: RunDir, table: TaskTable, config: LogConfig, logged_updates: int):
        """Opens the records. Events of a stopped run that come after `logged_updates` gradient steps, its last row that
        stays, are hidden.

        Raises:
            ConfigError: wandb is wanted, and not installed or not logged in. ResumeError: the disk is full.
        """
        self._run, self._table = run, table
        self._recent: list[deque[float]] = [deque(maxlen=RECENT_EPISODES) for _ in table.rows]
        self._episodes = [0] * len(table)
        with disk_checked(run.path):
            self._events = start_events(run.tensorboard, logged_updates + 1) if config.tensorboard else None
        self._wandb = start_wandb(run) if config.wandb else None

    def episode(self, stats: EpisodeStats, *, num_updates: int, env_steps: int) -> None:
        """Records a finished episode."""
        if not stats.cut:
            self._episodes[stats.task] += 1
            self._recent[stats.task].append(stats.score)
        self._run.append(
            "episodes.jsonl",
            {
                "num_updates": num_updates,
                "env_steps": env_steps,
                "task": self._table.ids[stats.task],
                "lane": stats.lane,
                "episode": stats.episode,
                "seed": stats.seed,
                "score": stats.score,
                "normalized_score": self._table.percent(stats.task, stats.score),
                "reward": stats.reward,
                "reward_components": stats.reward_components,
                "length_frames": stats.length_frames,
                "length_steps": stats.length_steps,
                "params_version": stats.params_version,
                "terminated": stats.terminated,
                "truncated": stats.truncated,
                "cut": stats.cut,
            },
        )

    def fault(self, fault: Fault, *, num_updates: int) -> None:
        """Records something that failed and was handled."""
        row = {"num_updates": num_updates, "time_s": time.time(), **msgspec.structs.asdict(fault)}
        self._run.append("faults.jsonl", row)

    def scalars(self, num_updates: int, values: Mapping[str, float]) -> None:
        """Records a row of scalars at a gradient step."""
        row = {**values, **{f"task/{t.task}/score": t.score for t in self.task_statuses() if t.episodes}}
        self._run.append("metrics.jsonl", {"num_updates": num_updates, "time_s": time.time(), **row})
        if self._events is not None:
            now = time.time()
            events = (Event(step=num_updates, wall_time=now, summary=scalar(*item)) for item in row.items())
            self._write_events(b"".join(map(event_record, events)), num_updates)
        if self._wandb is not None:
            self._wandb.log({"num_updates": num_updates, **row})

    def _write_events(self, data: bytes, num_updates: int) -> None:
        """After a write that failed, events end, because their file is damaged. The records have the same scalars."""
        assert self._events is not None
        try:
            if self._events.write(data) < len(data):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError as error:
            self._events.close()
            self._events = None
            message = f"TensorBoard's events end at update {num_updates} ({error}); metrics.jsonl has the same scalars"
            self.fault(Fault(actor=-1, lane=None, kind="tensorboard", message=message), num_updates=num_updates)

    def task_statuses(self) -> tuple[TaskStatus, ...]:
        """Recent play of each task."""
        return tuple(
            TaskStatus(
                task=row.task.id,
                episodes=self._episodes[i],
                score=sum(self._recent[i]) / len(self._recent[i]) if self._recent[i] else float("nan"),
                upper_bound=row.upper_bound,
            )
            for i, row in enumerate(self._table.rows)
        )

    def state(self) -> dict[str, Any]:
        """What a resumed run goes on from."""
        return {"episodes": list(self._episodes), "recent": [list(r) for r in self._recent]}

    def restore(self, state: Mapping[str, Any]) -> None:
        """The inverse of `state`."""
        self._episodes = list(state["episodes"])
        self._recent = [deque(r, maxlen=RECENT_EPISODES) for r in state["recent"]]

    def close(self) -> None:
        """Flushes the events. Can be repeated."""
        if self._events is not None:
            self._events.close()
        if self._wandb is not None:
            self._wandb.finish()
            self._wandb = None


def start_events(directory: Path, num_updates: int) -> io.FileIO:
    """A new file of TensorBoard events, which hides older events from `num_updates` on: a stopped run wrote them.

    (tensorboardX's own `SummaryWriter` writes in a thread, which ends at the first error. Its queue then blocks the
    logging thread for ever.)
    """
    directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    file = (directory / f"events.out.tfevents.{time.time():.0f}.{socket.gethostname()}").open("ab", buffering=0)
    file.write(
        event_record(Event(wall_time=time.time(), file_version="brain.Event:2"))
        + event_record(Event(step=num_updates, session_log=SessionLog(status=SessionLog.START)))
    )
    return file


def event_record(event: Any) -> bytes:
    """An event as it stands in a file: its length, the length's checksum, the event, its checksum."""
    data = event.SerializeToString()
    length = struct.pack("<Q", len(data))
    return length + struct.pack("<I", masked_crc32c(length)) + data + struct.pack("<I", masked_crc32c(data))


def start_wandb(run: RunDir) -> Any:  # wandb.Run, a type only where the extra is installed
    """The Weights & Biases run of a run directory, begun or, where one began before, gone on with.

    WANDB_MODE, WANDB_PROJECT, WANDB_ENTITY and the others of its environment variables hold; with WANDB_MODE=offline
    all stays in `wandb/` of the run directory, for `wandb sync`. The directory must have its config.json.

    Raises:
        ConfigError: wandb is not installed, or does not know who logs.
    """
    try:
        import wandb  # pyright: ignore[reportMissingImports]  # an extra
    except ImportError as error:
        raise ConfigError(
            f"log.wandb: {error}; install it (pip install 'gvizdoom[wandb]') or leave --log.wandb out"
        ) from error
    saved = json.loads((run.path / "config.json").read_text())
    id_file = run.path / "wandb_id"  # a resumed run is the same run there, one begun with --fresh another
    if not id_file.exists():
        with written_whole(id_file) as writing:
            writing.write_text(uuid.uuid4().hex[:12])
    # versions that cannot bound the last upload wait for it
    can_bound = "finish_timeout" in wandb.Settings.model_fields
    bounded: dict[str, Any] = {"finish_timeout": UPLOAD_TIMEOUT_S} if can_bound else {}
    try:
        started = wandb.init(
            dir=str(run.path),
            project=None if "WANDB_PROJECT" in os.environ else "gvizdoom",
            id=id_file.read_text(),
            resume="allow",
            name=f"{saved['config']['name']}/seed_{saved['config']['seed']}",
            config=saved,
            settings=wandb.Settings(console="off", silent=True, **bounded),
        )
    except wandb.Error as error:
        raise ConfigError(
            f"log.wandb: {error}; log in (wandb login), set WANDB_MODE=offline, or leave --log.wandb out"
        ) from error
    # a resumed run may repeat the rows after its checkpoint: their place is their gradient step, not their number
    started.define_metric("num_updates")
    started.define_metric("*", step_metric="num_updates")
    return started
