"""Bars and lines: how much is done, how quickly, what is left."""

import io
import math

import pytest
from rich.console import Console

from gvz.run import bars
from gvz.run.bars import Bar, Bars


def bar(done: int, **fields) -> Bar:
    return Bar(**{"name": "evaluate", "done": done, "total": 30, "unit": "episodes", **fields})


@pytest.fixture
def clock(monkeypatch):
    time_s = [100.0]
    monkeypatch.setattr(bars.time, "monotonic", lambda: time_s[0])
    return time_s


def test_off_a_terminal_there_is_a_line_now_and_then_and_at_the_end(clock):
    out = io.StringIO()
    with Bars(60, Console(file=out, width=200)) as shown:
        for second, done in enumerate((0, 1, 10, 30)):
            clock[0] = 100.0 + 30 * second
            shown.show([bar(done), bar(30, name="other", text="another")])
    assert out.getvalue().splitlines() == [
        "0/30  - episodes/s  eta --:--  evaluate",
        "30/30  - episodes/s  eta --:--  another",
        "10/30  0.17 episodes/s  eta 02:00  evaluate",
        "30/30  - episodes/s  eta --:--  another",
        "30/30  0.33 episodes/s  eta 00:00  evaluate",
        "30/30  - episodes/s  eta --:--  another",
    ]


def test_on_a_narrow_terminal_there_are_lines():
    out = io.StringIO()
    with Bars(60, Console(file=out, width=bars.LEAST_WIDTH - 1, force_terminal=True, color_system=None)) as shown:
        shown.show([bar(30)])
    assert out.getvalue() == "30/30  - episodes/s  eta --:--  evaluate\n"


def test_no_lines_are_no_lines():
    out = io.StringIO()
    with Bars(math.inf, Console(file=out, width=200)) as shown:
        shown.show([bar(30)])
    assert out.getvalue() == ""


def test_on_a_terminal_each_has_a_bar_as_long_as_it_is_shown(clock):
    out = io.StringIO()
    with Bars(60, Console(file=out, width=200, force_terminal=True, color_system=None)) as shown:
        shown.show([bar(1), bar(2, name="gone")])
        clock[0] += 10
        shown.show([bar(21)])
        shown.say("a line that stays")
    *_, last = out.getvalue().split("a line that stays")
    assert "21/30 2.00 episodes/s  eta 00:04 evaluate" in last
    assert "gone" not in last
