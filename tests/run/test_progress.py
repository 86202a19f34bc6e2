"""What a person sees: every number on the panel and in the plain line, on a terminal and off it."""

import contextlib
import dataclasses
import io
import math
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rich.console import Console

from gvz.run.progress import PLAIN_PERIOD_S, Progress, Status, TaskStatus, format_duration, plain_line
from gvz.tasks import named_tasks

STATUS = Status(
    phase="training",
    num_updates=5_000,
    total_updates=20_000,
    row={
        "learner/updates_per_s": 50.0,
        "actors/decisions_per_s": 800.0,
        "actors/frames_per_s": 3_200.0,
        "replay/fill_share": 0.5,
        "learner/wait_share": 0.25,
        "actors/wait_share": 0.1,
        "actors/restarts": 2,
    },
    staleness_updates=12.0,
    loss=1.5,
    tasks=(
        TaskStatus(task="defend_the_center/gore", episodes=7, score=550.0, upper_bound=1100.0),
        TaskStatus(task="defend_the_center/default", episodes=0, score=float("nan"), upper_bound=1100.0),
    ),
)
PARTS = ("training", "5,000", "20,000", "05:00", "50.0 updates/s", "800 decisions/s", "3,200", "50%", "25%", "550/1100")


def test_the_plain_line_has_every_number():
    line = plain_line(STATUS)
    assert all(part in line for part in PARTS)
    assert "default -" in line
    assert "nan" not in line


def test_many_tasks_are_shown_by_level():
    ids = [task.id for task in named_tasks("defend_the_center", split="compositions")]
    played = {
        "defend_the_center/default": 110.0,
        "defend_the_center/gore": 550.0,
        "defend_the_center/fast_enemies": 275.0,
    }
    tasks = tuple(
        TaskStatus(task=name, episodes=int(name in played), score=played.get(name, math.nan), upper_bound=1100.0)
        for name in ids
    )
    line = plain_line(dataclasses.replace(STATUS, tasks=tasks))
    # (50 + 25) / 2 percent; levels without an episode have no score
    assert line.endswith(
        "level 0 (1 task) 10/100  level 1 (7 tasks) 38/100  level 2 (14 tasks) -  "
        "level 3 (27 tasks) -  level 4 (37 tasks) -"
    )


def test_off_a_terminal_lines_are_printed_rarely(monkeypatch):
    out = io.StringIO()
    with Progress(Console(file=out, width=300)) as progress:
        progress.show(STATUS)
        progress.show(STATUS)
        progress.say("checkpoint written")
        now_s = time.monotonic()
        monkeypatch.setattr(time, "monotonic", lambda: now_s + PLAIN_PERIOD_S)
        progress.show(STATUS)
    lines = out.getvalue().splitlines()
    assert len(lines) == 3
    assert lines[1] == "checkpoint written"


SPEAKING = """
from gvz.run.bars import Bar, Bars
from gvz.run.progress import Progress
with Progress() as progress, Bars(0.0) as bars:
    for speaker in (progress, bars) * 2:
        speaker.say("a line")
        bars.show([Bar(name="jobs", done=1, total=2, unit="jobs")])
print("goes on")
"""


@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize("where", ["pipe without a reader", "full disk", "closed"])
def test_progress_that_nobody_can_see_stops_nothing(where, unbuffered):
    """As in `gvz train 2>&1 | tee log`, of which Ctrl-C ends both. Python writes its buffer once more at its end."""
    environment = {**os.environ, "PYTHONUNBUFFERED": unbuffered}
    with contextlib.ExitStack() as until_closed:
        if where == "full disk":
            stderr = until_closed.enter_context(Path("/dev/full").open("w"))
        else:
            reading, stderr = os.pipe()
            os.close(reading)
            until_closed.callback(os.close, stderr)
        closing = [] if where != "closed" else ["bash", "-c", 'exec "$@" 2>&-', "bash"]
        command = [*closing, sys.executable, "-c", SPEAKING]
        done = subprocess.run(
            command, stdout=subprocess.PIPE, stderr=stderr, text=True, timeout=120, check=False, env=environment
        )
    assert (done.returncode, done.stdout) == (0, "goes on\n")


@pytest.mark.parametrize("command", [("gvz.launch", "--config", "none"), ("gvz.cli", "evaluate")])
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_an_error_that_nobody_can_see_has_its_exit_code(command, unbuffered):
    environment = {**os.environ, "PYTHONUNBUFFERED": unbuffered}
    with Path("/dev/full").open("w") as stderr:
        done = subprocess.run([sys.executable, "-m", *command], stderr=stderr, env=environment, check=False)
    assert done.returncode == 2


@pytest.mark.parametrize("width", [60, 80, 120])
def test_on_a_terminal_the_panel_has_every_number(width):
    out = io.StringIO()
    with Progress(Console(file=out, width=width, force_terminal=True, color_system=None)) as progress:
        progress.show(STATUS)
    text = out.getvalue()
    assert all(part in text for part in PARTS)
    assert "2 actor restarts" in text
    assert "parameters 12 updates old" in text
    assert "defend_the_center" in text
    assert "50.0" in text


def test_durations():
    assert [format_duration(s) for s in (None, 0, 61, 3723)] == ["--:--", "00:00", "01:01", "1:02:03"]


def test_on_a_narrow_terminal_the_panel_has_whole_names_and_scores():
    tasks = tuple(
        TaskStatus(task=task.id, episodes=12, score=1234.0, upper_bound=2100.0)
        for task in named_tasks("health_gathering", split="train8")
    )
    out = io.StringIO()
    with Progress(Console(file=out, width=40, force_terminal=True, color_system=None)) as progress:
        progress.show(dataclasses.replace(STATUS, tasks=tasks))
    text = out.getvalue()
    assert "…" not in text
    for task in tasks:
        assert re.search(rf"{task.task.partition('/')[2]} +1234/2100", text)
