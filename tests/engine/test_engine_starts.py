"""How an engine starts, and what is left when it does not."""

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from gvz.core import janitor
from gvz.core.errors import EngineError, ResourceError
from gvz.engine import process as engine_process
from gvz.engine.engine import Engine
from tests.engine.test_engine import HEAD, config, run
from tests.waiting import wait_until

pytestmark = pytest.mark.engine


def test_an_engine_that_starts_too_late_is_given_up_and_cleared_away():
    before = set(janitor.runtime_dir().glob("*.json"))
    with pytest.raises(EngineError, match=r"not started within 0\.02 s"):
        Engine(config(start_timeout_s=0.02))
    wait_until(lambda: set(janitor.runtime_dir().glob("*.json")) <= before, "the removal of the engine's record")


@contextlib.contextmanager
def stopped_start(where: Path) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """A process that was interrupted while its engine starts, and this engine's process id, which is stopped."""
    code = (
        "import time; from dataclasses import replace\n"
        "try:\n    engine = Engine(replace(config, start_timeout_s=600)); time.sleep(60)\n"
        "except KeyboardInterrupt: print('interrupted', flush=True)"
    )
    process = subprocess.Popen(
        [sys.executable, "-W", "error", "-c", HEAD + code],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "TMPDIR": str(where)},
    )
    with process:
        wait_until(lambda: list(where.glob("gvz-engine-*/instance")), "the engine", process=process)
        [directory] = where.glob("gvz-engine-*")
        wait_until(lambda: (directory / "instance").read_text().endswith("\n"), "its number", process=process)
        instance = janitor.read_instance(directory)
        assert instance is not None
        os.kill(instance[0], signal.SIGSTOP)
        process.send_signal(signal.SIGINT)
        assert process.stdout is not None
        assert process.stdout.readline() == "interrupted\n"
        yield process, instance[0]


def test_an_interrupted_start_leaves_nothing_and_does_not_abort_the_process(tmp_path: Path):
    with stopped_start(tmp_path) as (process, engine):
        time.sleep(0.5)  # the interpreter is at its end
        os.kill(engine, signal.SIGCONT)
        assert process.communicate(timeout=60) == ("", "")
        assert process.returncode == 0
    assert list(tmp_path.iterdir()) == []


def test_a_signal_of_the_terminal_does_not_end_a_launcher_and_so_its_client(tmp_path: Path):
    """The launcher is in the client's process group until it is an engine."""
    code = (
        "import signal; from gvz.engine import process\n"
        "write = process.write_launcher\n"
        "def stopping(*arguments):\n"
        "    file = write(*arguments)\n"
        "    begin, become = file.read_text().split('exec ')\n"
        "    file.write_text(f'{begin}kill -STOP $$\\nexec {become}')\n"
        "    return file\n"
        "process.write_launcher = stopping\n"
        "for number in (signal.SIGTERM, signal.SIGHUP): signal.signal(number, signal.default_int_handler)\n"
        "for attempt in range(3):\n"
        "    try: Engine(config)\n"
        "    except KeyboardInterrupt: print('interrupted', flush=True)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", HEAD + code],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "TMPDIR": str(tmp_path)},
        process_group=0,
    ) as process:
        assert process.stdout is not None
        launchers: set[psutil.Process] = set()
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            [launcher] = wait_until(lambda: stopped_children(process) - launchers, "the launcher", process=process)
            launchers.add(launcher)
            os.killpg(process.pid, number)
            assert process.stdout.readline() == "interrupted\n"
        for launcher in launchers:
            launcher.send_signal(signal.SIGCONT)
        assert process.wait(60) == 0
    assert list(tmp_path.iterdir()) == []


def stopped_children(process: "subprocess.Popen[str]") -> set[psutil.Process]:
    return {child for child in psutil.Process(process.pid).children() if child.status() == psutil.STATUS_STOPPED}


def test_a_second_interruption_does_not_wait_for_the_engine_that_starts(tmp_path: Path):
    with stopped_start(tmp_path) as (process, engine):
        deadline = time.monotonic() + 50
        while process.poll() is None and time.monotonic() < deadline:
            time.sleep(1.0)
            process.send_signal(signal.SIGINT)
        assert process.returncode == 130
        assert "interrupted while an engine starts; the next start removes what it leaves\n" in process.communicate()[1]
    wait_until(lambda: janitor.process_start(engine) is None, "the end of the engine")


def test_what_vizdoom_refuses_is_an_engine_error(tmp_path: Path):
    with pytest.raises(EngineError, match=r"did not start: FileDoesNotExistException.*nowhere\.wad"):
        Engine(config(wad=tmp_path / "nowhere.wad"))


@pytest.mark.parametrize(
    ("name", "value", "error", "message"),
    [
        ("_SHM_BYTES", 2**60, ResourceError, r"/dev/shm: \d+ MiB free, an engine needs \d+; enlarge it"),
        # as on a file system mounted noexec
        ("_LAUNCHER_MODE", 0o600, EngineError, "set TMPDIR to a directory where they may run"),
    ],
)
def test_what_forbids_a_start_is_said_and_nothing_of_it_left(
    name: str, value: int, error: type[Exception], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(engine_process, name, value)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    before = set(janitor.runtime_dir().glob("*.json"))
    with pytest.raises(error, match=message):
        Engine(config())
    assert list(tmp_path.iterdir()) == []
    assert set(janitor.runtime_dir().glob("*.json")) == before


def test_few_start_at_a_time_and_a_killed_holder_gives_its_place_back():
    holder_code = (
        "import time; from gvz.engine.process import one_of\n"
        "with one_of(['test-place'], time.monotonic() + 5): print('held', flush=True); input()"
    )
    command = [sys.executable, "-c", holder_code]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        with (
            pytest.raises(EngineError, match="other processes held test-place for the whole time-out"),
            engine_process.one_of(["test-place"], time.monotonic() + 0.05),
        ):
            pass
        with engine_process.one_of(["test-place", "test-place-2"], time.monotonic() + 0.05):
            holder.kill()
    with engine_process.one_of(["test-place"], time.monotonic() + 5):
        pass
    for name in ("test-place", "test-place-2"):
        (janitor.runtime_dir() / f"{name}.lock").unlink()


def test_a_place_is_free_after_its_block_though_a_fork_of_the_block_lives():
    """An engine is such a fork until it becomes another program, which takes long on a busy machine."""
    run(
        "import ctypes, os, time; from gvz.engine.process import one_of\n"
        "with one_of(['test-fork'], time.monotonic() + 5):\n"
        "    pid = ctypes.CDLL(None).fork() or (time.sleep(60), os._exit(0))  # as C++ forks\n"
        "try:\n"
        "    with one_of(['test-fork'], time.monotonic() + 0.05): pass\n"
        "finally: os.kill(pid, 9)"
    )
    (janitor.runtime_dir() / "test-fork.lock").unlink()
