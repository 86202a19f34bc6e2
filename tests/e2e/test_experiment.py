"""The real command on real Doom: experiments that share a run, one job killed in the middle, run again, a report."""

import json
import os
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path

import psutil
import pytest
from command import STARTED, TIMEOUT_S, alive

from gvz.core.durable import saved_steps
from gvz.experiments import inventory as progress
from gvz.experiments.plan import read_plan
from tests.processes import arguments
from tests.waiting import wait_until

pytestmark = [
    pytest.mark.e2e,
    pytest.mark.engine,
    pytest.mark.timeout(1800),
    pytest.mark.usefixtures("nothing_left"),
]

RAINBOW = "rainbow_4task/defend_the_center/train4/seed_1111"
DQN = "dqn_4task/defend_the_center/train4/seed_1111"


def command(*words: str) -> list[str]:
    return [sys.executable, "-m", "gvz.cli", "experiment", *words]


def begin(results: Path) -> subprocess.Popen[str]:
    names = ("algorithm_comparison", "rainbow_evaluation")
    flags = ("--results", str(results), "--scale", "0.001", "--jobs", "2")
    runner = subprocess.Popen(command("run", *names, *flags), stderr=subprocess.PIPE, text=True, start_new_session=True)
    STARTED.append(runner)
    return runner


def training_process(runner: subprocess.Popen[str], run: str) -> psutil.Process:
    (found,) = [p for p in psutil.Process(runner.pid).children() if any(a.endswith(run) for a in arguments(p))]
    return found


def test_a_killed_job_sinks_no_other_goes_on_when_run_again_and_every_episode_is_there_once(tmp_path):
    results = tmp_path / "results"
    runner = begin(results)
    checkpoint = results / "runs" / RAINBOW / "checkpoints" / "100"
    wait_until(checkpoint.exists, "the first checkpoint", TIMEOUT_S, process=runner)
    training_process(runner, RAINBOW).kill()
    _, err = runner.communicate(timeout=900)
    assert runner.returncode == 1, err
    assert f"exit code 137 (SIGKILL: perhaps no memory was left); log {results}/logs/{RAINBOW}.log): {RAINBOW}" in err
    assert f"done: {DQN}" in err
    assert "done: players/random" in err
    status = subprocess.run(command("status", "--results", str(results)), capture_output=True, text=True, check=False)
    assert status.returncode == 1
    assert f"failed   {RAINBOW}" in status.stdout

    again = begin(results)
    _, err = again.communicate(timeout=900)
    assert again.returncode == 0, err
    assert "goes on from update 100" in progress.log_file(results, RAINBOW).read_text()
    status = subprocess.run(command("status", "--results", str(results)), capture_output=True, text=True, check=False)
    assert status.returncode == 0, status.stdout
    assert status.stdout.count("done  ") == 3

    plan = read_plan(results)
    assert plan is not None
    for run in plan.runs():
        wanted = plan.evaluations()[run.id]
        file = progress.run_directory(results, run) / "evaluation.jsonl"
        played = Counter(
            (row["num_updates"], row["task"], row["episode"]) for row in map(json.loads, file.read_text().splitlines())
        )
        assert set(played.values()) == {1}
        assert played.keys() == {(c, t, n) for c in run.checkpoints for t in wanted.tasks for n in range(2)}

    report = [sys.executable, "-m", "gvz.cli", "report", str(results), "--out", str(tmp_path / "report")]
    subprocess.run(report, check=True, timeout=300)
    page = (tmp_path / "report" / "report.html").read_text()
    for experiment in plan.experiments():
        assert experiment.title in page


def test_a_gate_s_runs_end_by_their_processor_time_and_its_report_has_both_tables(tmp_path):
    results = tmp_path / "results"
    flags = ("run", "gate_defend", "--results", str(results), "--scale", "0.001", "--jobs", "2")
    done = subprocess.run(command(*flags), capture_output=True, text=True, check=False, timeout=1200)
    assert done.returncode == 0, done.stderr
    plan = read_plan(results)
    assert plan is not None
    runs = plan.runs()
    names = ["rainbow_quick+shots_cost", "rainbow_quick+shots_free"]
    assert [run.agent for run in runs] == names
    for run in runs:
        directory = progress.run_directory(results, run)
        assert progress.last_processor_s(directory) >= run.max_processor_s == 0.4
        assert json.loads((directory / "config.json").read_text())["config"]["max_processor_s"] == 0.4
        newest = saved_steps(directory / "policies")[-1]
        assert newest == progress.last_update(directory) < run.total_updates == 60
        played = [json.loads(line) for line in (directory / "evaluation.jsonl").read_text().splitlines()]
        assert {row["num_updates"] for row in played} == {newest}
        assert {row["task"] for row in played} == set(plan.evaluations()[run.id].tasks)
    again = subprocess.run(command(*flags), capture_output=True, text=True, check=False, timeout=300)
    assert (again.returncode, again.stderr.count("done: "), again.stderr.count("train: ")) == (0, 3, 0)
    report = [sys.executable, "-m", "gvz.cli", "report", str(results), "--out", str(tmp_path / "report")]
    subprocess.run(report, check=True, timeout=300)
    page = (tmp_path / "report" / "report.html").read_text()
    assert "percent of the upper bound on the gate tasks" in page
    assert "percent of the upper bound on the tasks of training" in page
    assert all(name in page for name in names)
    assert "Not trained to the end" not in page


@pytest.mark.slow
def test_ctrl_c_saves_what_is_being_trained_and_leaves_nothing_running(tmp_path):
    runner = begin(tmp_path)
    try:
        metrics = tmp_path / "runs" / DQN / "metrics.jsonl"
        wait_until(metrics.exists, "the first updates", TIMEOUT_S, process=runner)
        children = psutil.Process(runner.pid).children(recursive=True)
        os.killpg(runner.pid, signal.SIGINT)
        _, err = runner.communicate(timeout=300)
    finally:
        runner.kill()
    assert runner.returncode == 130, err
    assert "2 jobs save themselves" in err
    assert not alive(children)
    assert list((tmp_path / "runs" / DQN / "checkpoints").iterdir())
