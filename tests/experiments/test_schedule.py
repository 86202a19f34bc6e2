"""The scheduler with real processes: small Python programs in place of training."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from gvz.core import records
from gvz.core.errors import ConfigError, GvzError
from gvz.core.libraries import import_path
from gvz.experiments import inventory as progress
from gvz.experiments import places, schedule
from gvz.experiments.jobs import Command, Outlook
from gvz.experiments.places import Machine, Slot, gpus, make_slots
from gvz.experiments.process import LOST, Process
from gvz.experiments.schedule import run_jobs
from tests.waiting import wait_until

CORES = tuple(sorted(os.sched_getaffinity(0)))
SLOT = Slot(cores=CORES, environment={})


@pytest.fixture(autouse=True)
def quick_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Jobs of tests last less than the half second between two looks at them."""
    monkeypatch.setattr(schedule, "POLL_S", 0.05)


@dataclass(frozen=True, kw_only=True)
class Program:
    """A job that writes its file: `first`, then `second` when that one's text is there."""

    id: str
    results: Path
    first: str = "pass"
    second: str | None = None

    def outlook(self) -> Outlook:
        done = self.file.read_text() if self.file.exists() else ""
        for step, code in (("first", self.first), ("second", self.second)):
            if code is not None and f"{step} done" not in done:
                ending = f"\nopen({str(self.file)!r}, 'a').write('{step} done ')"
                command = Command(step=step, arguments=("-c", code + ending), total=1)
                return Outlook(next=command, begun=True, text=f"no {step} part")
        return Outlook(next=None, begun=True, text="")

    def done_count(self, step: str) -> int:
        return 0

    @property
    def file(self) -> Path:
        return self.results / f"{self.id}.txt"


def log(job: Program) -> str:
    return progress.log_file(job.results, job.id).read_text()


def test_jobs_are_done_command_by_command_and_done_ones_are_left_alone(tmp_path, capsys):
    two = Program(id="two", results=tmp_path, first="print('one')", second="print('two')")
    done = Program(id="done", results=tmp_path, first="raise SystemExit(9)")
    done.file.write_text("first done")
    assert run_jobs([two, done], Machine([SLOT])) == 0
    assert two.file.read_text() == "first done second done "
    assert log(two).count("# ended with exit code 0") == 2
    assert not progress.log_file(tmp_path, "done").exists()
    assert "done: two" in capsys.readouterr().err


@pytest.mark.parametrize("waiting", [0, 1])
def test_jobs_save_themselves_when_there_will_be_no_room_any_more(tmp_path, waiting):
    saves = f"""
import pathlib, signal, sys, time
def save(*_):
    pathlib.Path({str(tmp_path / "saved")!r}).touch()
    sys.exit(130)
signal.signal(signal.SIGINT, save)
pathlib.Path({str(tmp_path / "begun")!r}).touch()
time.sleep(60)
"""

    class Gone(Machine):
        def room(self, step: str | None = None) -> bool:
            if (tmp_path / "begun").exists():
                raise GvzError("its head is gone")
            return super().room(step)

    jobs = [Program(id=str(n), results=tmp_path, first=saves) for n in range(1 + waiting)]
    with pytest.raises(GvzError, match="its head is gone"):
        run_jobs(jobs, Gone([SLOT]))
    assert (tmp_path / "saved").exists()
    assert progress.job_state(tmp_path, "0", done=False, begun=True) == "stopped"


def test_a_failure_sinks_no_other_job_and_is_named_with_its_log(tmp_path, capsys):
    bad = Program(id="bad/one", results=tmp_path, first="print('no luck today'); raise SystemExit(3)")
    liar = Program(id="liar", results=tmp_path, first="import os; os._exit(0)")
    killed = Program(id="killed", results=tmp_path, first="import os; os.kill(os.getpid(), 9)")
    good = Program(id="good", results=tmp_path)
    assert run_jobs([bad, liar, killed, good], Machine(make_slots(2, CORES, ()))) == 1
    assert good.file.exists()
    err = capsys.readouterr().err
    assert f"FAILED (first: exit code 3; log {tmp_path}/logs/bad/one.log): bad/one" in err
    assert "no luck today" in err
    assert "FAILED (first: it ended as if all were done, but it has no first part; log " in err
    assert "FAILED (first: exit code 137 (SIGKILL: perhaps no memory was left); log " in err
    assert "3 jobs failed; the same command tries them again:" in err
    assert progress.job_state(tmp_path, "bad/one", done=False, begun=True) == "failed"


def test_a_job_stays_on_its_cores_and_has_its_slot_s_environment(tmp_path):
    shown = "import os; print(sorted(os.sched_getaffinity(0)), os.environ['CUDA_VISIBLE_DEVICES'])"
    job = Program(id="shown", results=tmp_path, first=shown)
    slot = Slot(cores=CORES[:1], environment={"CUDA_VISIBLE_DEVICES": "7"})
    assert run_jobs([job], Machine([slot])) == 0
    assert f"[{CORES[0]}] 7" in log(job)


def test_a_job_executes_no_file_of_the_working_directory(tmp_path, monkeypatch):
    (tmp_path / "random.py").write_text("raise SystemExit(9)")
    monkeypatch.chdir(tmp_path)
    job = Program(id="job", results=tmp_path, first="import random; random.random()")
    assert run_jobs([job], Machine([SLOT])) == 0


def test_a_job_that_another_process_is_at_is_left_to_it(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("gvz.experiments.schedule.LOCKED_TIMEOUT_S", 1.0)
    job = Program(id="held", results=tmp_path, first="import time; time.sleep(60)")
    command = job.outlook().next
    assert command is not None
    file = progress.log_file(job.results, job.id)
    holder = Machine([SLOT]).start(file, command)
    assert holder is not None
    try:
        assert Machine([SLOT]).start(file, command) is None
        assert run_jobs([job, Program(id="free", results=tmp_path)], Machine([SLOT])) == 1
    finally:
        holder.kill()
    assert "left alone: held, which another process runs" in capsys.readouterr().err
    assert holder.poll() == 137


RUNNER = """
import sys
from pathlib import Path
sys.path.insert(0, {directory!r})
from test_schedule import SLOT, Machine, Program
from gvz.experiments.schedule import run_jobs
code = '''
import os, pathlib, signal, sys, time
def saved(*_):
    pathlib.Path({saved!r}).write_text("saved")
    sys.exit(130)
signal.signal(signal.SIGINT, saved); signal.signal(signal.SIGHUP, saved)
pathlib.Path({pid!r} + ".new").write_text(str(os.getpid())); os.rename({pid!r} + ".new", {pid!r})
time.sleep(100)
'''
sys.exit(run_jobs([Program(id="slow", results=Path({results!r}), first=code)], Machine([SLOT])))
"""


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGKILL, -9)])
def test_a_signal_reaches_the_jobs_which_save_and_none_is_left(tmp_path, number, code):
    pid, saved = tmp_path / "pid", tmp_path / "saved"
    text = RUNNER.format(directory=str(Path(__file__).parent), saved=str(saved), pid=str(pid), results=str(tmp_path))
    runner = subprocess.Popen([sys.executable, "-c", text])
    try:
        wait_until(pid.exists, "the job's start")
        runner.send_signal(number)
        assert runner.wait(60) == code
    finally:
        runner.kill()
    wait_until(saved.exists, "what the job saves")
    log_file = progress.log_file(tmp_path, "slow")
    wait_until(lambda: not records.is_locked(log_file), "the release of the job's log", 30)
    assert progress.job_state(tmp_path, "slow", done=False, begun=True) == "stopped"


SAVES = """
import sys, time
from pathlib import Path
from gvz.core.stop import StopRequest
with StopRequest() as stop:
    Path("begun").touch()
    while not stop.requested:
        time.sleep(0.001)
    time.sleep(0.5)  # it saves itself
    Path("saved.new").write_text(str(stop.exit_code))
    Path("saved.new").rename("saved")
"""
STARTS = """
import os, subprocess, sys, threading, time
for _ in range(3):
    threading.Thread(target=time.sleep, args=(100,), daemon=True).start()
job = [sys.executable, "-P", "-m", "gvz.experiments.child", str(os.getpid()), sys.argv[1]]
subprocess.run([*job, *sys.argv[2:]], start_new_session=True)
"""


@pytest.mark.parametrize("guard", [(), ("-m", "gvz.cluster.guard", str(CORES[0]))], ids=["here", "on a node"])
def test_a_job_whose_parent_is_killed_saves_itself(guard, tmp_path):
    """The kernel tells it of every thread of the parent that ends, and a second SIGTERM would end it at once."""
    command = ["nohup", sys.executable, "-c", STARTS, str(CORES[0]), *guard, "-c", SAVES]
    launcher = subprocess.Popen(command, cwd=tmp_path, env={**os.environ, "PYTHONPATH": import_path()})
    try:
        wait_until((tmp_path / "begun").exists, "the job's start")
    finally:
        launcher.kill()
        launcher.wait(30)
    wait_until((tmp_path / "saved").exists, "what the job saves")
    assert (tmp_path / "saved").read_text() == "129"


QUEUE = """
import sys
from pathlib import Path
sys.path.insert(0, {directory!r})
from test_schedule import SLOT, Machine, Program, schedule
schedule.POLL_S = 0.05
code = "import os, pathlib, time; pathlib.Path({results!r}, 'played').open('a').write('%s '); time.sleep(0.3)"
jobs = [Program(id=f"job{{n}}", results=Path({results!r}), first=code % n, second="pass") for n in range(12)]
sys.exit(schedule.run_jobs(jobs, Machine([SLOT])))
"""


def test_two_commands_in_one_directory_are_one_queue(tmp_path):
    text = QUEUE.format(directory=str(Path(__file__).parent), results=str(tmp_path))
    runners = [subprocess.Popen([sys.executable, "-c", text], stderr=subprocess.PIPE, text=True) for _ in range(2)]
    try:
        said = [runner.communicate(timeout=120)[1] for runner in runners]
    finally:
        for runner in runners:
            runner.kill()
    assert [runner.returncode for runner in runners] == [0, 0], said
    assert sorted((tmp_path / "played").read_text().split()) == sorted(str(n) for n in range(12)), "each job once"
    begun = [set(re.findall(r"first: job(\d+)", text)) for text in said]
    assert begun[0]
    assert begun[1]
    assert not begun[0] & begun[1]


class Nodes(Machine):
    """Other machines, on which each command ends at once, by this code."""

    def __init__(self, code: int, settle_s: float = 0.0):
        self.code, self.settle_s, self.num_started = code, settle_s, 0

    def room(self, step: str | None = None) -> bool:
        return True

    def start(self, log: Path, command: Command) -> Process:
        self.num_started += 1
        ended: Any = SimpleNamespace(where="n7", problem="", poll=lambda: self.code, kill=lambda: None)
        return ended

    def end(self, process: Process) -> None:
        pass


@dataclass(frozen=True, kw_only=True)
class Watched(Program):
    """Its progress is what `looks` gives, one after the other; the last one is that it is done."""

    looks: Iterator[str]

    def outlook(self) -> Outlook:
        following, text = super().outlook().next, next(self.looks, "done")
        return Outlook(next=None if text == "done" else following, begun=True, text=text)


def test_a_job_that_loses_machines_goes_on_until_it_has_lost_three_without_progress(tmp_path, capsys):
    """A look before each start, and one after each loss."""
    looks = iter(["0", "1", "1", "2", "2", "2", "2", "2"])
    nodes = Nodes(LOST)
    assert run_jobs([Watched(id="one", results=tmp_path, looks=looks)], nodes) == 1
    assert nodes.num_started == 4, "the first two made progress"
    assert "FAILED (first: lost 3 machines without progress, the last was n7; log " in capsys.readouterr().err


def test_what_a_command_wrote_elsewhere_may_be_seen_a_while_later(tmp_path, capsys):
    looks = ["nothing"] * 4
    assert run_jobs([Watched(id="one", results=tmp_path, looks=iter(looks))], Nodes(0, settle_s=60.0)) == 0
    assert run_jobs([Watched(id="two", results=tmp_path, looks=iter(looks))], Nodes(0, settle_s=0.0)) == 1
    assert "it ended as if all were done, but it has nothing" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("jobs", "cores", "devices", "shares"),
    [
        (None, range(4), (), [(0, 2), (1, 3)]),
        (None, range(1), (), [(0,)]),
        (3, range(2), (), [(0,), (1,), (0,)]),
        (None, range(4), ("0",), [(0, 1, 2, 3)]),
        (None, range(2), ("0", "1", "2"), [(0,), (1,)]),
    ],
)
def test_cores_are_shared_out(jobs, cores, devices, shares):
    assert [slot.cores for slot in make_slots(jobs, list(cores), devices)] == shares


def test_jobs_of_one_gpu_share_its_memory():
    slots = make_slots(4, range(8), ("0", "3"))
    assert [slot.environment["CUDA_VISIBLE_DEVICES"] for slot in slots] == ["0", "3", "0", "3"]
    assert {slot.environment["XLA_PYTHON_CLIENT_MEM_FRACTION"] for slot in slots} == {"0.450"}
    shares = [slot.environment["XLA_PYTHON_CLIENT_MEM_FRACTION"] for slot in make_slots(3, range(8), ("0", "3"))]
    assert shares == ["0.450"] * 3, "the first GPU has two of them"
    assert make_slots(2, range(8), ("0", "3"))[0].environment.keys() == {"CUDA_VISIBLE_DEVICES"}


def test_hidden_gpus_are_not_used(monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert gpus() == ()
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2,5")
    assert gpus() == ("2", "5")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "-1")
    assert gpus() == ()


def test_gpus_have_the_driver_s_numbers_also_where_parts_of_one_are_listed(tmp_path, monkeypatch):
    parts = "  MIG 1g.10gb     Device  0: (UUID: MIG-b)"
    listed = f"GPU 0: NVIDIA H100 (UUID: GPU-a)\n{parts}\n{parts}\nGPU 1: NVIDIA H100 (UUID: GPU-c)"
    (tmp_path / "nvidia-smi").write_text(f"#!/bin/sh\necho '{listed}'\n")
    (tmp_path / "nvidia-smi").chmod(0o700)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    assert gpus() == ("0", "1")


def test_a_driver_that_does_not_answer_is_named(tmp_path, monkeypatch):
    (tmp_path / "nvidia-smi").write_text("#!/bin/sh\nexec sleep 60\n")
    (tmp_path / "nvidia-smi").chmod(0o700)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    monkeypatch.setattr(places, "LIST_TIMEOUT_S", 0.2)
    with pytest.raises(ConfigError, match=r"waited 0\.2 s for nvidia-smi -L; mend the driver, or set CUDA_VISIBLE_DEV"):
        gpus()


def test_no_jobs_at_once_is_refused():
    with pytest.raises(ConfigError, match="--jobs: got 0, want at least 1"):
        make_slots(0, CORES, ())
