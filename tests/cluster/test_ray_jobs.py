"""Experiments on a cluster of three nodes: the real command, a node that loses its power, Ctrl-C, and bad input."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import ModuleType, SimpleNamespace

import psutil
import pytest

from gvz.cluster import job_host, ray_jobs
from gvz.cluster.job_host import hold_cores
from gvz.cluster.ray_jobs import Share
from gvz.core import records, stop
from gvz.core.errors import ConfigError, GvzError
from gvz.experiments import inventory
from gvz.experiments.jobs import Command
from gvz.experiments.plan import read_plan
from tests.processes import arguments
from tests.waiting import wait_until

TIMEOUT_S = 150.0
RUN = "rainbow_4task/defend_the_center/train4/seed_1111"
DRIVER = """
import sys
from pathlib import Path
sys.path.insert(0, {directory!r})
from test_schedule import Program
from gvz.cluster.ray_jobs import open_places
from gvz.experiments.schedule import run_jobs
results = Path({results!r})
with open_places({address!r}, results, 1, None, None) as places:
    sys.exit(run_jobs([Program(id=f"job{{n}}", results=results, first={code!r}) for n in range({count})], places))
"""
SHOW = """
import json, os, pathlib, time
shown = [sorted(os.sched_getaffinity(0)), [n for n in os.environ if n.startswith(("RAY_", "OMP_"))]]
print(json.dumps([*shown, os.environ["CUDA_VISIBLE_DEVICES"]]))
here = pathlib.Path({results!r}, f"at-{{os.getpid()}}")
here.touch()
while len(list(here.parent.glob("at-*"))) < 2:  # until a second job runs beside it
    time.sleep(0.05)
"""
SAVE = """
import os, pathlib, signal, sys, time
here = pathlib.Path({results!r}, str(os.getpid()))
def saved(number, _):
    here.with_suffix(".saved").write_text(str(number))
    sys.exit(128 + number)
signal.signal(signal.SIGINT, saved); signal.signal(signal.SIGHUP, saved)
here.with_suffix(".begun").touch()
time.sleep(200)
"""

LONG = """
import os, pathlib, time
begun = pathlib.Path({results!r}, "begun")
if not begun.exists():
    begun.write_text(str(os.getpid()))
    time.sleep(200)
"""


def begin(cluster, results: Path, code: str, count: int) -> subprocess.Popen[str]:
    programs = str(Path(__file__).parents[1] / "experiments")
    shown = {"directory": programs, "results": str(results), "address": cluster.address, "count": count}
    text = DRIVER.format(code=code.format(results=str(results)), **shown)
    command = [sys.executable, "-c", text]
    return subprocess.Popen(command, env=cluster.environment, stderr=subprocess.PIPE, text=True, start_new_session=True)


def all_done(driver: subprocess.Popen[str]) -> str:
    """What it has said; kills it where it is stuck."""
    try:
        return driver.communicate(timeout=TIMEOUT_S)[1]
    finally:
        driver.kill()


@pytest.mark.e2e
def test_jobs_spread_over_the_nodes_each_on_a_core_of_its_own_and_know_nothing_of_ray(cluster, tmp_path):
    driver = begin(cluster, tmp_path, SHOW, 2)
    said = all_done(driver)
    assert driver.returncode == 0, said
    assert "done: job0" in said
    assert "done: job1" in said
    logs = [inventory.log_file(tmp_path, f"job{n}").read_text().splitlines() for n in range(2)]
    shown = [json.loads(line) for log in logs for line in log if line.startswith("[[")]
    assert [(rays, devices) for _, rays, devices in shown] == [([], ""), ([], "")]
    if len(os.sched_getaffinity(0)) > 1:
        (first, _, _), (second, _, _) = shown
        assert len(first) == len(second) == 1
        assert first != second


@pytest.mark.e2e
@pytest.mark.parametrize(("number", "code", "job_sees"), [(signal.SIGINT, 130, "2"), (signal.SIGKILL, -9, "1")])
def test_a_signal_reaches_the_jobs_which_save_and_none_is_left(cluster, tmp_path, number, code, job_sees):
    driver = begin(cluster, tmp_path, SAVE, 3)
    try:
        wait_until(lambda: len(list(tmp_path.glob("*.begun"))) == 2, "two jobs", TIMEOUT_S, process=driver)
        jobs = [psutil.Process(int(file.stem)) for file in tmp_path.glob("*.begun")]
        os.killpg(driver.pid, number)
        said = driver.communicate(timeout=100)[1]
    finally:
        driver.kill()
    assert driver.returncode == code, said
    assert not psutil.wait_procs(jobs, timeout=60)[1]
    assert [file.read_text() for file in tmp_path.glob("*.saved")] == [job_sees] * 2


@pytest.mark.e2e
def test_a_job_whose_node_loses_its_power_goes_on_elsewhere(cluster, tmp_path):
    driver = begin(cluster, tmp_path, LONG, 1)
    begun = tmp_path / "begun"
    try:
        wait_until(lambda: begun.exists() and begun.read_text(), "the job's start", TIMEOUT_S, process=driver)
        cluster.kill_node_of(psutil.Process(int(begun.read_text())))
        cluster.tell("add")
    finally:
        said = all_done(driver)
    assert driver.returncode == 0, said
    assert "lost with its machine" in said
    assert "done: job0" in said
    assert not records.is_locked(inventory.log_file(tmp_path, "job0"))


@pytest.mark.e2e
@pytest.mark.engine
@pytest.mark.slow
def test_a_run_whose_node_loses_its_power_goes_on_elsewhere_from_its_checkpoint(cluster, tmp_path):
    results = tmp_path / "results"
    flags = ("--results", str(results), "--scale", "0.001", "--cluster", cluster.address, "--job-cores", "1")
    command = [sys.executable, "-m", "gvz.cli", "experiment", "run", "rainbow_evaluation", *flags]
    driver = subprocess.Popen(command, env=cluster.environment, stderr=subprocess.PIPE, text=True, cwd=tmp_path)
    log, directory = inventory.log_file(results, RUN), results / "runs" / RUN
    try:
        checkpoint = directory / "checkpoints" / "100"
        wait_until(checkpoint.exists, "the first checkpoint", TIMEOUT_S, process=driver)
        at_work = [p for p in psutil.process_iter() if str(directory) in arguments(p) and "gvz.launch" in arguments(p)]
        cluster.kill_node_of(at_work[0])
        cluster.tell("add")
        resumed = "goes on from update 100"
        wait_until(lambda: resumed in log.read_text(), "the resumed run", TIMEOUT_S, process=driver)
        said = driver.communicate(timeout=400)[1]
    finally:
        driver.kill()
    assert driver.returncode == 0, said
    assert "lost with its machine" in said
    assert not records.is_locked(log)
    assert f"done: {RUN}" in said
    assert "done: players/random" in said
    plan = read_plan(results)
    assert plan is not None
    (run,) = plan.runs()
    rows = [json.loads(line) for line in (directory / "evaluation.jsonl").read_text().splitlines()]
    played = [(row["num_updates"], row["task"], row["episode"]) for row in rows]
    tasks = plan.evaluations()[run.id].tasks
    assert sorted(played) == sorted((c, t, n) for c in run.checkpoints for t in tasks for n in range(2))


@pytest.mark.e2e
def test_a_cluster_that_a_job_does_not_fit_on_is_refused(cluster, tmp_path):
    flags = ("--results", str(tmp_path / "results"), "--scale", "0.001", "--cluster", cluster.address)
    done = cluster.run("experiment", "run", "rainbow_evaluation", *flags)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "no node has 2 cores and 0 GPUs for a job; lower --job-cores" in done.stderr
    assert not (tmp_path / "results" / "plan.json").exists()


@pytest.mark.parametrize(
    ("cores", "gpus", "step", "fits"),
    [
        *[(2, 0.0, "train", 8), (2, 1.0, "train", 4), (2, 0.3, "train", 8), (1, 0.5, "train", 8), (1, 0.4, "train", 8)],
        *[(2, 2.0, "train", 2), (2, 1.0, "evaluate", 8), (2, 1.0, None, 8), (17, 0.0, "train", 0)],
    ],
)
def test_shares_of_a_node_with_16_cores_and_4_gpus(cores, gpus, step, fits):
    assert Share(cores=cores, gpus=gpus).fits(16.0, 4.0, step) == fits


@pytest.mark.parametrize(
    ("limit", "used", "train", "evaluate"),
    [
        (None, [], True, True),
        (None, ["train"], False, True),  # the one GPU is taken
        (None, ["train", *["evaluate"] * 3], False, False),  # four jobs on eight cores
        (None, ["evaluate"] * 3, True, True),
        (None, ["evaluate"] * 4, False, False),
        (2, ["evaluate"], True, True),
        (2, ["evaluate"] * 2, False, False),
    ],
)
def test_a_job_has_room_where_its_step_the_cores_and_the_limit_allow_one_more(limit, used, train, evaluate):
    places = ray_jobs.ClusterPlaces.__new__(ray_jobs.ClusterPlaces)  # connecting is the other tests' matter
    places._share, places._limit, places._looked_s = Share(cores=2, gpus=1.0), limit, time.monotonic() + 60.0
    places._nodes = [(4.0, 1.0), (4.0, 0.0)]
    places._used = [SimpleNamespace(step=step) for step in used]
    assert (places.room("train"), places.room("evaluate"), places.room()) == (train, evaluate, evaluate)


def test_a_job_on_a_part_of_a_gpu_takes_that_part_of_its_memory(monkeypatch):
    ray, got = ModuleType("ray"), []
    actor = SimpleNamespace(start=SimpleNamespace(remote=lambda *given: got.append(given[-1])))
    vars(ray).update(remote=lambda **_: lambda _: SimpleNamespace(remote=lambda: actor))
    monkeypatch.setitem(sys.modules, "ray", ray)
    for step, gpus in (("train", 0.5), ("train", 1.0), ("evaluate", 0.5)):
        ray_jobs.RemoteProcess(Path("log"), Command(step=step, arguments=(), total=1), Share(gpus=gpus))
    assert got == [{"XLA_PYTHON_CLIENT_MEM_FRACTION": "0.450"}, {}, {"CUDA_VISIBLE_DEVICES": ""}]


@pytest.mark.parametrize(
    ("flags", "text"),
    [
        (["--job-cores", "0", "--cluster", "10.0.0.1:1"], "--job-cores: got 0, want at least 1"),
        (
            ["--job-gpus", "1.5", "--cluster", "10.0.0.1:1"],
            "--job-gpus: got 1.5, want a part of one (0.5), or whole ones",
        ),
        (["--job-gpus", "1"], "--job-cores and --job-gpus are for a cluster (--cluster)"),
        (["--cluster", "ray://10.0.0.1:1"], "Ray's client (ray://) is not enough"),
    ],
)
def test_bad_flags_are_one_line(flags, text, tmp_path, refusal, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("RAY_AUTH_TOKEN", "0" * 32)
    assert text in refusal("experiment", "run", "rainbow_evaluation", "--scale", "0.001", *flags)
    assert list(tmp_path.iterdir()) == []


def test_a_core_has_one_holder_and_too_few_free_cores_are_none(monkeypatch, tmp_path):
    tmp_path.chmod(0o700)
    monkeypatch.setenv("GVZ_RUNTIME_DIR", str(tmp_path))
    allowed = sorted(os.sched_getaffinity(0))
    first, locks = hold_cores(1)
    assert len(first) == 1
    assert hold_cores(len(allowed)) == (tuple(allowed), [])
    for lock in locks:
        lock.close()
    every, locks = hold_cores(len(allowed))
    assert (sorted(every), len(locks)) == (allowed, len(allowed))
    for lock in locks:
        lock.close()


def test_a_job_takes_idle_cores_and_not_those_that_every_container_would_take(monkeypatch, tmp_path):
    """Containers of one machine see all its cores, but each its own locks alone."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(16)))
    monkeypatch.setattr(job_host, "idle_cores", lambda: list(range(4, 12)))
    taken = set()
    for container in range(20):
        (tmp_path / f"{container}").mkdir(mode=0o700)
        monkeypatch.setenv("GVZ_RUNTIME_DIR", str(tmp_path / f"{container}"))
        held = [hold_cores(4) for _ in range(3)]
        first, second, third = (set(cores) for cores, _ in held)
        assert first | second == set(range(4, 12))
        assert len(third - first - second) == 4, "busy ones where no others are free"
        taken.add(frozenset(first))
        for lock in (lock for _, locks in held for lock in locks):
            lock.close()
    assert len(taken) > 1


@pytest.mark.parametrize("ip", ["127.0.0.1", "::1"])
def test_a_head_that_is_gone_is_named(ip, monkeypatch):
    monkeypatch.setattr(ray_jobs, "HEAD_TIMEOUT_S", 0.1)
    family = socket.AF_INET6 if ":" in ip else socket.AF_INET
    if family == socket.AF_INET6 and not Path("/proc/net/if_inet6").exists():
        pytest.skip("this machine has no IPv6")
    ray = ModuleType("ray")
    nodes = [{"Alive": alive, "Resources": {"CPU": 2.0}} for alive in (True, False)]
    monkeypatch.setattr(ray, "nodes", lambda: nodes, raising=False)
    monkeypatch.setitem(sys.modules, "ray", ray)
    places = ray_jobs.ClusterPlaces.__new__(ray_jobs.ClusterPlaces)  # connecting is the other tests' matter
    places._share, places._answered_s = Share(), time.monotonic()
    with socket.create_server((ip, 0), family=family) as head:
        places._address = address = f"{f'[{ip}]' if ':' in ip else ip}:{head.getsockname()[1]}"
        places._look()
    assert places._nodes == [(2.0, 0.0)]
    places._look()  # for a moment, that may be the network
    assert places._nodes == []
    time.sleep(0.2)
    with pytest.raises(GvzError, match=f"cluster {re.escape(address)}: its head is gone; the jobs save themselves"):
        places._look()


def test_a_head_that_takes_connections_but_answers_nothing_is_gone_after_a_while(monkeypatch):
    """A stopped process, or a machine without memory: Ray itself waits for it without end."""
    monkeypatch.setattr(stop, "stuck", set())
    answers = threading.Event()
    ray = ModuleType("ray")
    monkeypatch.setattr(ray, "nodes", answers.wait, raising=False)
    monkeypatch.setitem(sys.modules, "ray", ray)
    places = ray_jobs.ClusterPlaces.__new__(ray_jobs.ClusterPlaces)
    places._answered_s = time.monotonic()
    with socket.create_server(("127.0.0.1", 0)) as head:
        places._address = f"127.0.0.1:{head.getsockname()[1]}"
        places._look(0.1)
        assert places._nodes == []
        monkeypatch.setattr(ray_jobs, "SILENT_TIMEOUT_S", 0.0)
        with pytest.raises(GvzError, match="its head is gone"):
            places._look(0.1)
    (asking,) = stop.stuck
    answers.set()
    asking.join(10.0)
    assert not asking.is_alive()


def test_a_share_of_nothing_is_refused():
    with pytest.raises(ConfigError, match="--job-gpus: got -1"):
        Share(gpus=-1)
