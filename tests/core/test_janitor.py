"""The janitor removes what dead owners left, and nothing else."""

import contextlib
import errno
import fcntl
import json
import mmap
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil
import pytest
import vizdoom

from gvz.core import janitor
from gvz.core.errors import ResourceError
from gvz.core.stop import StopRequest
from gvz.engine import process
from gvz.run import doctor
from tests.processes import run_until_killed
from tests.waiting import wait_until

WRAPPER = Path(process.__file__).with_name("wrapper.py")
STOCK_WAD = Path(vizdoom.scenarios_path) / "defend_the_center.wad"


@pytest.fixture
def registry(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A registry of this test's own, so that records can be forged."""
    tmp_path.chmod(0o700)
    monkeypatch.setenv("GVZ_RUNTIME_DIR", str(tmp_path))
    return janitor.runtime_dir()


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    """A private directory, as `make_directory` names it."""
    path = tmp_path / "gvz-engine-0123456789abcdef"
    path.mkdir()
    return path


def give_up(directory: Path) -> None:
    """Unlocks the record of a directory, as the end of its owner does."""
    os.close(janitor._held.pop(directory))


def test_records_are_private(registry: Path):
    directory = Path("/tmp/gvz-engine-0123456789abcdef")
    janitor.record(directory)
    (path,) = registry.glob("*.json")
    assert path.stat().st_mode & 0o777 == 0o600
    assert registry.stat().st_mode & 0o777 == 0o700
    janitor.forget(directory)
    assert list(registry.iterdir()) == []
    janitor.forget(directory)  # again, and of what was never recorded


def test_a_signal_comes_after_python_has_tried_the_temporary_directory(monkeypatch: pytest.MonkeyPatch):
    """It tries with a file, which an exception would leave there."""
    tried = list[str]()

    def gettempdir() -> str:
        signal.raise_signal(signal.SIGTERM)
        tried.append("/tmp")
        return "/tmp"

    monkeypatch.setattr(tempfile, "gettempdir", gettempdir)
    with pytest.raises(KeyboardInterrupt), StopRequest(at_once=True):
        janitor.make_directory()
    assert tried == ["/tmp"]


def test_a_temporary_directory_goes_with_its_block_or_with_the_next_start(registry: Path):
    with janitor.temporary_directory() as directory:
        (directory / "file").touch()
        assert directory.stat().st_mode & 0o777 == 0o700
        assert janitor.clean_dead_instances() == []
    assert not directory.exists()
    code = "from gvz.core import janitor\nwith janitor.temporary_directory() as d: print(d, flush=True); input()"
    killed = Path(run_until_killed(code))
    assert janitor.dead_instances() == [str(killed)]
    assert janitor.clean_dead_instances() == [f"directory {killed}"]
    assert not killed.exists()
    assert list(registry.iterdir()) == []


def test_a_directory_that_cannot_be_made_leaves_no_record(registry: Path, tmp_path: Path):
    with pytest.raises(FileNotFoundError):
        janitor.make_directory(tmp_path / "absent")
    assert not [*registry.iterdir(), *(held for held in janitor._held if tmp_path in held.parents)]


def test_a_record_whose_owner_was_killed_before_it_wrote_is_removed(registry: Path):
    (registry / "gvz-engine-x.json").touch()
    assert janitor.dead_instances() == []
    assert janitor.clean_dead_instances() == []
    assert list(registry.iterdir()) == []


def test_a_record_that_a_janitor_took_for_a_dead_owner_s_is_written_again(
    registry: Path, directory: Path, monkeypatch: pytest.MonkeyPatch
):
    lock, looks = janitor.records.lock, []

    def lock_late(file) -> bool:
        if not looks:
            looks.append(1)
            assert janitor.clean_dead_instances() == []  # between the file and its lock
        return lock(file)

    monkeypatch.setattr(janitor.records, "lock", lambda file: lock_late(file) if file.writable() else lock(file))
    janitor.record(directory)
    assert len(list(registry.glob("*.json"))) == 1
    assert janitor.clean_dead_instances() == []
    assert directory.exists()
    janitor.forget(directory)


def test_what_a_living_owner_has_is_left_alone(registry: Path, directory: Path):
    janitor.record(directory)
    assert janitor.clean_dead_instances() == []
    assert directory.exists()
    assert len(list(registry.glob("*.json"))) == 1
    janitor.forget(directory)


def test_what_a_process_has_is_left_alone_while_its_interpreter_has_ended_and_its_threads_may_not(
    registry: Path, directory: Path
):
    code = (
        "import ctypes; from pathlib import Path; from gvz.core import janitor\n"
        f"janitor.record(Path({str(directory)!r})); libc = ctypes.CDLL(None)\n"
        "libc.strdup.restype = ctypes.c_void_p; text = ctypes.c_void_p(libc.strdup(b'ended'))  # Python frees its own\n"
        "libc.__cxa_atexit(libc.pause, None, None); libc.__cxa_atexit(libc.puts, text, None)\n"
        "libc.setbuf(ctypes.c_void_p.in_dll(libc, 'stdout'), None)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as owner:
        assert owner.stdout is not None
        ended = owner.stdout.readline()
        found = janitor.dead_instances(), janitor.clean_dead_instances()
        owner.kill()
    assert (ended, found) == ("ended\n", ([], []))
    assert janitor.clean_dead_instances() == [f"directory {directory}"]
    assert list(registry.iterdir()) == []


def test_what_another_living_process_has_is_left_alone_until_it_ends(registry: Path, directory: Path):
    code = (
        "from pathlib import Path; from gvz.core import janitor\n"
        f"janitor.record(Path({str(directory)!r})); print(1, flush=True); input()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as owner:
        assert owner.stdout is not None
        owner.stdout.readline()
        owner.send_signal(signal.SIGSTOP)  # a stopped process lives
        assert (janitor.dead_instances(), janitor.clean_dead_instances()) == ([], [])
        owner.kill()
        owner.wait()
    assert janitor.clean_dead_instances() == [f"directory {directory}"]
    assert not directory.exists()
    assert list(registry.iterdir()) == []
    assert janitor.clean_dead_instances() == []


@pytest.mark.parametrize(
    "name",
    [
        "",
        "gvz-engine-relative",
        "/tmp/gvz-engine-x/../../home",
        "/home/someone",
        "/tmp/x",
        "/tmp/gvz-engine-x/..",
    ],
)
def test_forged_records_delete_nothing(registry: Path, name: str):
    (registry / "forged.json").write_text(json.dumps({"directory": name}))
    (line,) = janitor.clean_dead_instances()
    assert line.startswith("left alone: unreadable record")
    assert (registry / "forged.json").exists()
    with pytest.raises(ValueError, match=r"record of .*: want an absolute path that ends in gvz-engine-"):
        janitor.record(Path(name))


def test_without_locks_records_are_left_alone_and_the_doctor_goes_on(
    registry: Path, directory: Path, monkeypatch: pytest.MonkeyPatch
):
    def flock(*_: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", flock)
    with pytest.raises(ResourceError, match="cannot be locked"):
        janitor.record(directory)
    (line,) = janitor.clean_dead_instances()
    assert line.startswith(f"left alone: unreadable record {registry}")
    assert "cannot be locked: No locks available" in line
    assert doctor.check_leftovers().state == "ok"


@pytest.mark.parametrize(
    "text",
    ["{", "[" * 100_000, "[]", '{"directory": 5}', json.dumps({"directory": f"/{'a' * 300}/gvz-engine-x"})],
    ids=range(5),
)
def test_a_record_that_is_damaged_is_reported_and_left(registry: Path, text: str):
    path = registry / "gvz-engine-x.json"
    path.write_text(text)
    assert len(janitor.dead_instances()) <= 1  # a name can be too long only for the disk
    (line,) = janitor.clean_dead_instances()
    assert str(path) in line
    assert path.exists()


@pytest.mark.usefixtures("registry")
def test_a_process_without_the_instance_id_is_not_killed(directory: Path):
    with subprocess.Popen(["sleep", "60"]) as bystander:
        start = janitor.process_start(bystander.pid)
        (directory / janitor.INSTANCE_FILE).write_text(f"{bystander.pid} {start} Abc123\n")
        janitor.record(directory)
        give_up(directory)
        assert janitor.clean_dead_instances() == [f"directory {directory}"]
        assert bystander.poll() is None
        bystander.kill()


@pytest.mark.usefixtures("registry")
def test_an_engine_is_dead_before_its_shared_memory_is_removed(directory: Path, monkeypatch: pytest.MonkeyPatch):
    command = [sys.executable, "-c", "print(1, flush=True); input()", "Abc123"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as engine:
        assert engine.stdout is not None
        engine.stdout.readline()  # the kernel shows a process before its arguments
        found: list[int | None] = []
        monkeypatch.setattr(janitor, "_unlink_shm", lambda _: found.append(janitor.process_start(engine.pid)) or [])
        start = janitor.process_start(engine.pid)
        (directory / janitor.INSTANCE_FILE).write_text(f"{engine.pid} {start} Abc123\n")
        janitor.clean_engine(directory)
        engine.kill()
    assert found == [None] * 3


@pytest.mark.usefixtures("registry")
def test_an_instance_file_that_is_not_ours_is_reported(directory: Path):
    (directory / janitor.INSTANCE_FILE).write_text("1 2 ../../etc\n")
    janitor.record(directory)
    give_up(directory)
    (line,) = janitor.clean_dead_instances()
    assert "want process id, start time, instance id" in line
    assert directory.exists()


@pytest.mark.engine
def test_a_killed_client_takes_its_engine_along_and_the_janitor_the_rest(registry: Path):
    line = run_until_killed(
        "from pathlib import Path; from gvz.engine.engine import Engine, EngineConfig\n"
        f"e = Engine(EngineConfig(wad=Path({str(STOCK_WAD)!r}), buttons=(), variables=()))\n"
        "print(e.pid, e.instance_id, e.log.parent, flush=True); input()"
    )
    pid, instance_id, directory = line.split()
    wait_until(lambda: janitor.process_start(int(pid)) is None, "the engine's end")
    left = {path.name for path in janitor.SHM_DIR.glob(f"*{instance_id}")}
    assert left == {f"ViZDoom{part}{instance_id}" for part in ("SM", "MQCtr", "MQDoom")}
    removed = janitor.clean_dead_instances()
    assert sorted(removed) == sorted([*(f"shared memory {name}" for name in left), f"directory {directory}"])
    assert not list(janitor.SHM_DIR.glob(f"*{instance_id}"))
    assert not Path(directory).exists()
    assert list(registry.glob("*.json")) == []


@pytest.mark.engine
def test_an_engine_killed_before_it_was_one_leaves_nothing(registry: Path):
    """What its client had made by then is known from the launcher."""
    code = (
        "from pathlib import Path; from gvz.engine.engine import Engine, EngineConfig\n"
        f"Engine(EngineConfig(wad=Path({str(STOCK_WAD)!r}), buttons=(), variables=()))"
    )
    for _ in range(20):  # on a busy machine, an engine may be one before it is seen
        with subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE) as client:
            wrappers: list[psutil.Process] = []
            while not wrappers and client.poll() is None:
                with contextlib.suppress(psutil.Error):
                    children = psutil.Process(client.pid).children()
                    wrappers = [child for child in children if str(WRAPPER) in child.cmdline()[:3]]
            for wrapper in wrappers:
                wrapper.kill()
            client.wait(120)
        directories = [Path(json.loads(path.read_text())["directory"]) for path in registry.glob("*.json")]
        if directories and not (directories[0] / janitor.INSTANCE_FILE).exists():
            break
        janitor.clean_dead_instances()
    assert client.returncode != 0
    (directory,) = directories
    assert not (directory / janitor.INSTANCE_FILE).exists()
    instance_id = (directory / janitor.ARGUMENTS_FILE).read_text().split("+viz_instance_id ")[1].split()[0]
    assert len(list(janitor.SHM_DIR.glob(f"ViZDoomMQ*{instance_id}"))) == 2
    janitor.clean_dead_instances()
    assert not list(janitor.SHM_DIR.glob(f"*{instance_id}"))
    assert not directory.exists()


@pytest.mark.usefixtures("registry")
def test_what_a_client_had_made_when_it_died_before_the_launch_is_what_nobody_holds(directory: Path):
    janitor.record(directory)
    give_up(directory)
    names = [f"ViZDoomMQ{part}" for part in ("Ctrlost", "Doomlost", "Ctrheld", "Ctrran", "Ctrold")] + ["ViZDoomSMran"]
    files = {name: janitor.SHM_DIR / f"{name}{os.getpid()}" for name in names}
    try:
        files["ViZDoomMQCtrold"].write_bytes(b"queue")
        time.sleep(0.05)
        (directory / janitor.LAUNCHER_FILE).touch()
        for name in set(files) - {"ViZDoomMQCtrold"}:
            files[name].write_bytes(b"queue")
        with files["ViZDoomMQCtrheld"].open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ):
            removed = janitor.clean_dead_instances()
        lost = [files[name].name for name in ("ViZDoomMQCtrlost", "ViZDoomMQDoomlost")]
        mine = [line for line in removed if line.endswith((str(os.getpid()), str(directory)))]  # others run beside it
        assert mine == [*(f"shared memory {name}" for name in lost), f"directory {directory}"]
        assert [name for name, file in files.items() if not file.exists()] == ["ViZDoomMQCtrlost", "ViZDoomMQDoomlost"]
    finally:
        for file in files.values():
            file.unlink(missing_ok=True)


def test_a_launched_engine_without_a_client_removes_what_that_had_made(tmp_path: Path):
    queue = janitor.SHM_DIR / f"ViZDoomMQCtrtest{os.getpid()}"
    queue.touch()
    words = [sys.executable, "-IS", WRAPPER, "1", tmp_path, tmp_path / "log", "true"]
    done = subprocess.run([*words, "+viz_instance_id", f"test{os.getpid()}"], check=False)
    assert (done.returncode, queue.exists()) == (1, False)


@pytest.mark.engine
@pytest.mark.usefixtures("registry")
def test_an_engine_that_outlived_its_owner_is_ended():
    from gvz.engine.engine import Engine, EngineConfig

    engine = Engine(EngineConfig(wad=STOCK_WAD, buttons=(), variables=()))
    give_up(engine.log.parent)
    assert f"engine {engine.instance_id} (pid {engine.pid})" in janitor.clean_dead_instances()
    wait_until(lambda: janitor.process_start(engine.pid) is None, "the engine's end")
    engine.close()


def test_a_zombie_is_dead():
    process = subprocess.Popen(["true"])
    wait_until(lambda: janitor.process_start(process.pid) is None, "the end of the process")
    assert Path(f"/proc/{process.pid}").exists(), "not reaped yet"
    process.wait()


def test_a_stopped_process_lives():
    with subprocess.Popen(["sleep", "60"]) as process:
        process.send_signal(signal.SIGSTOP)
        assert janitor.process_start(process.pid) is not None
        process.kill()


def test_a_runtime_directory_that_others_can_enter_is_refused(registry: Path):
    registry.chmod(0o755)
    with pytest.raises(ResourceError, match=r"want a directory of user \d+ that nobody else can enter"):
        janitor.runtime_dir()


def test_a_runtime_directory_that_is_a_link_is_refused(registry: Path, tmp_path: Path):
    registry.rmdir()
    registry.symlink_to(tmp_path)
    with pytest.raises(ResourceError, match="that nobody else can enter"):
        janitor.runtime_dir()


def test_a_runtime_directory_that_cannot_be_made_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    file = tmp_path / "file"
    file.touch(mode=0o700)
    monkeypatch.setenv("GVZ_RUNTIME_DIR", str(file))
    with pytest.raises(ResourceError, match="set GVZ_RUNTIME_DIR or TMPDIR to a writable directory"):
        janitor.runtime_dir()


def test_a_relative_runtime_directory_is_refused(monkeypatch: pytest.MonkeyPatch):
    """Processes in other directories would not find its records, nor this one after a change of directory."""
    monkeypatch.setenv("GVZ_RUNTIME_DIR", "here")
    with pytest.raises(ResourceError, match="GVZ_RUNTIME_DIR: got here, want an absolute path"):
        janitor.runtime_dir()


def test_records_are_in_the_temporary_directory_also_where_a_login_has_one_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.delenv("GVZ_RUNTIME_DIR")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))  # cron and batch jobs lack it, and must find the same records
    assert janitor.runtime_dir() == tmp_path / "temporary" / f"gvizdoom-{os.getuid()}"
