"""An engine starts under a limit, dies when it hangs or its owner ends, and leaves nothing."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import vizdoom

from gvz.core import janitor
from gvz.core.errors import ConfigError, EngineError
from gvz.engine import process as engine_process
from gvz.engine.engine import Engine, EngineConfig, check_config, screen_resolutions

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


def run(code: str, returncode: int = 0, **options: object) -> str:
    """Runs code that may use `config` and Engine in a process of its own, which ends with this code; its output."""
    command = [sys.executable, "-W", "error", "-c", HEAD + code]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False, **options)
    assert done.returncode == returncode, done.stderr
    return done.stdout


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
    begin = "engine = Engine(config); engine.new_episode(1); print(engine.instance_id, engine.log.parent)\n"
    instance_id, directory = run(begin + ending, code).split()
    assert not list(janitor.SHM_DIR.glob(f"*{instance_id}"))
    assert not Path(directory).exists()


@pytest.mark.parametrize("ending", ["sys.exit(0)", "del engine; sys.exit(0)"])
def test_a_forked_childs_exit_leaves_the_parents_engine_alone(ending: str):
    run(
        "import os, sys, warnings\n"
        "warnings.simplefilter('ignore')  # Python 3.12 warns of any fork beside threads\n"
        "engine = Engine(config); engine.new_episode(1)\n"
        "child = os.fork()\n"
        f"if child == 0: {ending}\n"
        "assert os.waitpid(child, 0)[1] == 0\n"
        "assert engine.step([], 4) is not None\n"
    )


def test_a_fork_does_not_watch_its_parents_engines():
    """It has the parent's call and the parent's lock as they were, without the threads that would end both."""
    run(
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


def test_nothing_is_written_into_the_working_directory_or_home(tmp_path: Path):
    run("Engine(config).new_episode(1)", cwd=tmp_path, env={**os.environ, "HOME": str(tmp_path)})
    assert list(tmp_path.iterdir()) == []


def test_nothing_but_our_records_is_written_into_the_temporary_directory(tmp_path: Path):
    environment = {name: value for name, value in os.environ.items() if name != "GVZ_RUNTIME_DIR"}
    run("Engine(config).new_episode(1)", env={**environment, "TMPDIR": str(tmp_path)})
    [records] = tmp_path.iterdir()
    assert records.name == f"gvizdoom-{os.getuid()}"
    assert list(records.glob("*.json")) == []


def test_home_and_working_directory_may_be_read_only():
    run("Engine(config).new_episode(1)", cwd="/proc", env={**os.environ, "HOME": "/proc"})


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
        "import dataclasses, select, sys; engine = Engine(dataclasses.replace(config, step_timeout_s=1.0))\n"
        "engine.new_episode(1); print(engine.pid, flush=True)\n"
        "while not select.select([sys.stdin], [], [], 0)[0]: engine.step([], 1)\n"
        "engine.step([], 1); engine.close()"
    )
    command = [sys.executable, "-c", HEAD + code]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as client:
        assert client.stdout is not None
        pid = int(client.stdout.readline())
        for number, pause_s in ((signal.SIGSTOP, 1.5), (signal.SIGCONT, 0.0)):  # as a container is paused
            os.kill(client.pid, number)
            os.kill(pid, number)
            time.sleep(pause_s)
        client.communicate(timeout=60)  # closes its input
        assert client.returncode == 0


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
