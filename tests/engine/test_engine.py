"""An engine starts under a limit, dies when it hangs or its owner ends, and leaves nothing."""

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest
import vizdoom

from gvz.core import janitor
from gvz.core.errors import ConfigError, EngineError, ResourceError
from gvz.engine import process as engine_process
from gvz.engine.engine import Engine, EngineConfig, check_config, screen_resolutions
from tests.waiting import wait_until

pytestmark = pytest.mark.engine

STOCK_WAD = Path(vizdoom.scenarios_path) / "defend_the_center.wad"


def config(**changes: object) -> EngineConfig:
    values: dict[str, object] = {
        "wad": STOCK_WAD,
        "buttons": ("ATTACK", "TURN_LEFT", "TURN_RIGHT"),
        "variables": ("KILLCOUNT", "HEALTH", "AMMO2"),
        "start_tic": 10,
    }
    return EngineConfig(**{**values, **changes})


@pytest.fixture
def engine() -> Iterator[Engine]:
    engine = Engine(config())
    yield engine
    engine.close()


def traces(engine: Engine) -> list[str]:
    """Whatever there is of an engine: shared memory, directory, record, process."""
    found = [str(path) for path in janitor.SHM_DIR.glob(f"*{engine.instance_id}")]
    found += [str(engine.log.parent)] if engine.log.parent.exists() else []
    found += [path.name for path in janitor.runtime_dir().glob("*.json") if engine.log.parent.name in path.read_text()]
    return found + ([f"pid {engine.pid}"] if janitor.process_start(engine.pid) is not None else [])


HEAD = (
    "from pathlib import Path; from gvz.engine.engine import Engine, EngineConfig\n"
    f"config = EngineConfig(wad=Path({str(STOCK_WAD)!r}), buttons=(), variables=())\n"
)


def run(code: str, **options: object) -> subprocess.CompletedProcess[str]:
    """Runs code that may use `config` and Engine in a process of its own."""
    command = [sys.executable, "-W", "error", "-c", HEAD + code]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False, **options)


def test_an_episode_is_played_and_ends_with_the_players_death(engine: Engine):
    state = engine.new_episode(seed=5)
    assert state.tic == 10
    assert state.game_variables is not None
    assert state.game_variables.tolist() == [0, 100, 26]
    assert (state.screen_buffer.shape, state.screen_buffer.dtype) == ((144, 256, 3), np.uint8)
    after = engine.step([0, 1, 0], 4)
    assert after is not None
    assert after.tic == 14
    assert (after.screen_buffer != state.screen_buffer).any()
    for _ in range(1000):
        if engine.step([0, 0, 0], 4) is None:
            break
    assert engine.variable("HEALTH") <= 0
    assert engine.variables()[1] == engine.variable("HEALTH")
    died_at = engine.tic()
    assert engine.step([0, 0, 0], 4) is None
    assert engine.tic() == died_at


def test_the_screen_is_the_states_without_a_copy_and_goes_on_to_the_moment_of_death(engine: Engine):
    state = engine.new_episode(seed=5)
    last = np.empty(0)
    while state is not None:
        np.testing.assert_array_equal(engine.screen, state.screen_buffer)
        last = state.screen_buffer
        state = engine.step([0, 0, 0], 4)
    assert (engine.screen != last).any()
    with pytest.raises(ValueError, match="read-only"):
        engine.screen[0, 0, 0] = 0


def test_colours_are_red_green_blue(engine: Engine):
    ammo_and_health = engine.new_episode(seed=5).screen_buffer[-24:-8, 30:100].astype(int)  # red digits
    red, _green, blue = ammo_and_health.reshape(-1, 3).T
    assert (red > 2 * blue).sum() > 100
    assert (blue > 2 * red).sum() == 0


def test_close_leaves_nothing_and_may_be_repeated(engine: Engine):
    assert len(traces(engine)) == 6
    engine.close()
    assert traces(engine) == []
    engine.close()
    for use in (
        lambda: engine.new_episode(1),
        engine.tic,
        lambda: engine.variable("HEALTH"),
        lambda: engine.command("x"),
    ):
        with pytest.raises(EngineError, match="it was closed, or died before"):
            use()


def test_an_interrupted_close_leaves_nothing(engine: Engine, monkeypatch: pytest.MonkeyPatch):
    clean = janitor.clean_engine

    def interrupted(directory: Path) -> list[str]:
        signal.raise_signal(signal.SIGINT)
        return clean(directory)

    monkeypatch.setattr(janitor, "clean_engine", interrupted)
    with pytest.raises(KeyboardInterrupt):
        engine.close()
    assert traces(engine) == []


def test_a_forgotten_engine_leaves_nothing():
    engine = Engine(config())
    instance_id, pid = engine.instance_id, engine.pid
    time.sleep(1.5 * engine_process._WATCH_PERIOD_S)  # the watchdog has looked at it, and must hold no reference to it
    del engine
    assert janitor.process_start(pid) is None
    assert not list(janitor.SHM_DIR.glob(f"*{instance_id}"))


@pytest.mark.parametrize(
    ("ending", "code"),
    [("", 0), ("raise KeyError", 1), ("import sys; sys.exit(3)", 3), ("engine.kill(); engine.close()", 0)],
)
def test_the_interpreters_exit_leaves_nothing(ending: str, code: int):
    done = run(
        f"engine = Engine(config); engine.new_episode(1); print(engine.instance_id, engine.log.parent)\n{ending}"
    )
    assert done.returncode == code
    instance_id, directory = done.stdout.split()
    assert not list(janitor.SHM_DIR.glob(f"*{instance_id}"))
    assert not Path(directory).exists()


@pytest.mark.parametrize("ending", ["sys.exit(0)", "del engine; sys.exit(0)"])
def test_a_forked_childs_exit_leaves_the_parents_engine_alone(ending: str):
    done = run(
        "import os, sys, warnings\n"
        "warnings.simplefilter('ignore')  # Python 3.12 warns of any fork beside threads\n"
        "engine = Engine(config); engine.new_episode(1)\n"
        "child = os.fork()\n"
        f"if child == 0: {ending}\n"
        "assert os.waitpid(child, 0)[1] == 0\n"
        "assert engine.step([], 4) is not None\n"
    )
    assert done.returncode == 0, done.stderr


def test_a_fork_does_not_watch_its_parents_engines():
    """It has the parent's call and the parent's lock as they were, without the threads that would end both."""
    done = run(
        "import os, signal, warnings; from gvz.engine import process\n"
        "warnings.simplefilter('ignore')  # Python 3.12 warns of any fork beside threads\n"
        "engine = Engine(config); engine.new_episode(1)\n"
        "with process._watched_lock:\n"
        "    engine.deadline = process.deadline(30.0); child = os.fork()\n"
        "if child == 0: signal.alarm(20); process._kill_overdue(float('inf')); os._exit(0)\n"
        "engine.deadline = None\n"
        "assert os.waitpid(child, 0)[1] == 0\n"
        "assert engine.step([], 4) is not None\n"
    )
    assert done.returncode == 0, done.stderr


def test_nothing_is_written_into_the_working_directory_or_home(tmp_path: Path):
    done = run("Engine(config).new_episode(1)", cwd=tmp_path, env={**os.environ, "HOME": str(tmp_path)})
    assert done.returncode == 0, done.stderr
    assert list(tmp_path.iterdir()) == []


def test_nothing_but_our_records_is_written_into_the_temporary_directory(tmp_path: Path):
    environment = {name: value for name, value in os.environ.items() if name != "GVZ_RUNTIME_DIR"}
    done = run("Engine(config).new_episode(1)", env={**environment, "TMPDIR": str(tmp_path)})
    assert done.returncode == 0, done.stderr
    [records] = tmp_path.iterdir()
    assert records.name == f"gvizdoom-{os.getuid()}"
    assert list(records.glob("*.json")) == []


def test_home_and_working_directory_may_be_read_only():
    done = run("Engine(config).new_episode(1)", cwd="/proc", env={**os.environ, "HOME": "/proc"})
    assert done.returncode == 0, done.stderr


def test_a_settings_file_that_vizdoom_would_load_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "_vizdoom.cfg").write_text("doom_skill = 5")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(EngineError, match=r"_vizdoom\.cfg: ViZDoom would load it over our settings"):
        Engine(config())


def test_a_killed_engine_raises(engine: Engine):
    engine.new_episode(1)
    engine.kill()
    with pytest.raises(EngineError, match=r"engine \w+ \(pid \d+, defend_the_center.wad\): advance: .*crash"):
        engine.step([1, 0, 0], 4)
    with pytest.raises(EngineError, match="not running"):
        engine.step([1, 0, 0], 4)
    engine.close()
    assert traces(engine) == []


@pytest.mark.parametrize("call", ["advance", "new_episode"])
def test_a_hung_engine_is_killed_and_raises(call: str):
    engine = Engine(config(step_timeout_s=0.5))
    engine.new_episode(1)
    os.kill(engine.pid, signal.SIGSTOP)
    start = time.monotonic()
    with pytest.raises(EngineError, match=f"{call}: no answer within 0.5 s, killed"):
        engine.advance([1, 0, 0], 4) if call == "advance" else engine.new_episode(2)
    assert time.monotonic() - start < 60  # on a loaded machine; it takes less than a second
    engine.close()
    assert traces(engine) == []


def test_an_engine_that_was_stopped_together_with_its_client_lives():
    code = (
        "import dataclasses, time; engine = Engine(dataclasses.replace(config, step_timeout_s=1.0))\n"
        "engine.new_episode(1); print(engine.pid, flush=True); end = time.monotonic() + 6\n"
        "while time.monotonic() < end: engine.step([], 1)\n"
        "engine.close()"
    )
    with subprocess.Popen([sys.executable, "-c", HEAD + code], stdout=subprocess.PIPE, text=True) as client:
        assert client.stdout is not None
        pid = int(client.stdout.readline())
        for number in (signal.SIGSTOP, signal.SIGCONT):  # as a container is paused
            os.kill(client.pid, number)
            os.kill(pid, number)
            time.sleep(2.5)
        assert client.wait(60) == 0


def test_the_terminals_ctrl_c_is_not_for_the_engine(engine: Engine):
    assert os.getpgid(engine.pid) == engine.pid != os.getpgid(0)


def test_an_engine_blocks_no_signal_although_its_launcher_did(engine: Engine):
    status = dict(line.split(":\t") for line in Path(f"/proc/{engine.pid}/status").read_text().splitlines())
    assert int(status["SigBlk"], 16) == 0


def test_a_hung_engine_can_be_closed(engine: Engine):
    os.kill(engine.pid, signal.SIGSTOP)
    start = time.monotonic()
    engine.close()
    assert time.monotonic() - start < 60  # on a loaded machine; it takes less than a second
    assert traces(engine) == []


def test_an_engine_that_starts_too_late_is_given_up_and_cleared_away():
    before = set(janitor.runtime_dir().glob("*.json"))
    with pytest.raises(EngineError, match=r"not started within 0\.02 s"):
        Engine(config(start_timeout_s=0.02))
    wait_until(lambda: set(janitor.runtime_dir().glob("*.json")) <= before, "the removal of the engine's record")


@contextlib.contextmanager
def stopped_start(where: Path) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """A process that was interrupted while its engine starts, and this engine's process id, which is stopped."""
    code = (
        "import time\n"
        "try:\n    engine = Engine(config); time.sleep(60)\n"
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
    done = run(
        "import ctypes, os, time; from gvz.engine.process import one_of\n"
        "with one_of(['test-fork'], time.monotonic() + 5):\n"
        "    pid = ctypes.CDLL(None).fork() or (time.sleep(60), os._exit(0))  # as C++ forks\n"
        "try:\n"
        "    with one_of(['test-fork'], time.monotonic() + 0.05): pass\n"
        "finally: os.kill(pid, 9)"
    )
    assert done.returncode == 0, done.stderr
    (janitor.runtime_dir() / "test-fork.lock").unlink()


def test_the_log_is_emptied_when_it_has_grown(engine: Engine):
    engine.new_episode(1)
    with engine.log.open("ab") as file:
        file.write(b"x" * 2**21)
    engine.new_episode(2)
    assert engine.log.stat().st_size < 2**16


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"buttons": ("ATTACK", "FLY")}, "unknown Button 'FLY'"),
        ({"variables": ("MANA",)}, "unknown GameVariable 'MANA'"),
        (
            {"width": 84, "height": 84},
            r"render_width, render_height: got 84x84, want one of 160x120, 200x125, .*1920x1080",
        ),
    ],
)
def test_what_vizdoom_does_not_have_is_a_config_error(changes: dict[str, object], message: str):
    with pytest.raises(ConfigError, match=message):
        check_config(config(**changes))


def test_the_default_render_size_is_one_of_vizdooms():
    assert (256, 144) in screen_resolutions()
