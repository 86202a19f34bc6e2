"""Signals that ask a command to stop."""

import ctypes
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from typing import Any

import pytest

from gvz import cli
from gvz.core import stop as stops
from gvz.core.stop import SIGNALS, StopRequest, blocked_signals, told_of_delay, uninterrupted
from tests.waiting import wait_until


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    """Those of before."""
    before = {number: signal.getsignal(number) for number in SIGNALS}
    yield
    assert {number: signal.getsignal(number) for number in SIGNALS} == before


@pytest.mark.parametrize("first", SIGNALS)
def test_the_first_signal_asks_and_the_second_ends(first: signal.Signals):
    with StopRequest() as stop:
        signal.raise_signal(first)
        assert (stop.requested, stop.exit_code) == (True, 128 + first)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
        assert stop.exit_code == 128 + first


@pytest.mark.parametrize("first", SIGNALS)
def test_a_hangup_is_no_second_signal(first: signal.Signals):
    """A closed terminal sends two, and systemd sends one right after SIGTERM: the run is still saved."""
    with StopRequest() as stop:
        signal.raise_signal(first)
        signal.raise_signal(signal.SIGHUP)
        assert stop.exit_code == 128 + first


@pytest.mark.parametrize("number", SIGNALS)
def test_what_a_signal_raises_inside_a_destructor_is_raised_again(number: signal.Signals):
    class Interrupted:
        def __del__(self) -> None:
            signal.raise_signal(number)

    def play() -> None:
        Interrupted()
        pytest.fail(f"waited {threading.Event().wait(60)}")

    with pytest.raises(KeyboardInterrupt), StopRequest(at_once=True) as stop:
        play()
    assert stop.signal == number


def test_in_another_thread_than_the_main_one_a_command_runs_and_catches_no_signals():
    codes = [1, 1]

    def run() -> None:
        codes[:] = cli.main(["tasks", "--scenario", "rockets"]), cli.main(["train", "--config", "no-such"])

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert codes == [0, 2]


def test_under_nohup_a_hangup_stays_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with StopRequest() as stop:
            signal.raise_signal(signal.SIGHUP)
            assert not stop.requested
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_call_that_a_signal_does_not_end_is_spoken_of(monkeypatch: pytest.MonkeyPatch):
    libc, mutex, said = ctypes.CDLL(None), ctypes.create_string_buffer(64), list[str]()

    def hear(line: str) -> None:
        said.append(line)
        libc.pthread_mutex_unlock(mutex)

    monkeypatch.setattr(stops, "say", hear)
    main = threading.get_ident()

    def send_when_it_waits() -> None:
        wait_until(lambda: mutex[:4] == (2).to_bytes(4, sys.byteorder), "the call")  # glibc: locked, and waited for
        signal.pthread_kill(main, signal.SIGTERM)

    at_last = threading.Timer(60, libc.pthread_mutex_unlock, [mutex])
    with StopRequest() as stop, told_of_delay(stop):
        libc.pthread_mutex_lock(mutex)
        at_last.start()
        threading.Thread(target=send_when_it_waits, daemon=True).start()
        libc.pthread_mutex_lock(mutex)
        at_last.cancel()
        assert stop.signal == signal.SIGTERM
    assert said == ["stopping as soon as the call under way ends; a compilation can take a minute"]


def test_a_process_is_started_without_signals_until_it_ignores_them():
    code = (
        "import signal, sys; from gvz.core.stop import SIGNALS, ignore_signals\n"
        "print(flush=True); sys.stdin.read(1); ignore_signals()\n"
        "assert not signal.pthread_sigmask(signal.SIG_BLOCK, ())\n"
        "[signal.raise_signal(number) for number in SIGNALS]"
    )
    command = [sys.executable, "-c", code]
    with blocked_signals():
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        for number in SIGNALS:  # it has no handler yet, perhaps not even Python's
            process.send_signal(number)
    assert process.stdout is not None
    assert process.stdout.readline() == b"\n"
    for number in SIGNALS:
        process.send_signal(number)
    assert process.communicate(b"x", timeout=60) == (b"", b"")
    assert process.returncode == 0


def test_a_signal_that_comes_while_handlers_are_put_back_leaves_the_others(monkeypatch: pytest.MonkeyPatch):
    set_handler = signal.signal

    def interrupted(number: signal.Signals, handler: Any) -> Any:
        before = set_handler(number, handler)
        if handler == stop._handle:
            signal.raise_signal(number)
        return before

    with StopRequest(at_once=True) as stop:
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt), uninterrupted():
            patch.setattr(signal, "signal", interrupted)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
