"""`gvz experiment`: list, plan by known rates, status; what is bad input. Running is tests/e2e's."""

import json
import os
import tempfile

import pytest

from gvz.cli import main
from gvz.experiments import inventory as progress
from gvz.experiments.base import experiments
from gvz.experiments.jobs import Slot
from gvz.experiments.plan import Plan, write_plan
from gvz.experiments.rates import measure, rates_file, read_rates

CORES = tuple(sorted(os.sched_getaffinity(0)))


@pytest.fixture
def known_rates(tmp_path, monkeypatch):
    """Of one job on all cores: 10 updates/s, 1000 evaluation decisions/s."""
    monkeypatch.setenv("GVZ_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    file = rates_file("rainbow_4task", 1, Slot(cores=CORES, environment={}))
    file.parent.mkdir(parents=True)
    file.write_text(json.dumps({"updates_per_s": 10, "evaluation_steps_per_s": 1000, "measured": "2026-11-21 12:00"}))


def test_list_names_every_experiment_with_its_question(capsys):
    assert main(["experiment", "list"]) == 0
    out = capsys.readouterr().out
    for experiment in experiments().values():
        assert f"{experiment.name}: {experiment.question}" in out
        assert f"{len(experiment.runs())} runs of {experiment.total_updates:,} gradient steps" in out
    assert main(["experiment", "list", "--json"]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert {row["name"]: row["runs"] for row in rows} == {e.name: len(e.runs()) for e in experiments().values()}


@pytest.mark.usefixtures("known_rates")
def test_plan_prints_runs_steps_episodes_and_hours_and_counts_shared_runs_once(capsys):
    arguments = ["experiment", "plan", "rainbow_evaluation", "training_set_size", "--jobs", "1", "--shard", "1/2"]
    assert main([*arguments, "--scenario", "defend_the_center"]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    # 18 tasks x 100 episodes x 20 checkpoints; (200,000 + 10,000 / 4) / 10 s and 36,000 x 1100 / 4 / 1000 s
    run = ["rainbow_4task/defend_the_center/train4/seed_1111", "200,000", "810,000", "36,000", "8.38"]
    assert run in lines
    assert ["rainbow_evaluation:", "3", "runs", "600,000", "2,430,000", "108,000", "25.12"] in lines
    assert lines[-4][:6] == ["together,", "shared", "runs", "once:", "9", "runs"]
    assert lines[-4][6:9] == ["1,800,000", "7,290,000", "192,000"]  # 3 x 36,000 + 6 x 7 x 100 x 20
    seeds = [cells[0] for cells in lines if cells and cells[0].startswith("rainbow_4task/")]
    assert len(seeds) == 5  # of nine runs, every other one
    assert lines[-1][:3] == ["rainbow_4task:", "10.00", "updates/s,"]
    assert main([*arguments, "--scenario", "defend_the_center", "--json"]) == 0
    rows = {row["run"]: row for row in map(json.loads, capsys.readouterr().out.splitlines())}
    assert len(rows) == 5
    row = rows["rainbow_4task/defend_the_center/train4/seed_1111"]
    assert row["experiments"] == ["rainbow_evaluation", "training_set_size"]
    assert (row["updates"], row["episodes"], round(row["hours"], 2)) == (200_000, 36_000, 8.38)


def test_status_tells_done_failed_and_waiting_apart(tmp_path, capsys):
    plan = write_plan(tmp_path, Plan(names=("algorithm_comparison",), scale=0.001))
    (dqn, rainbow), evaluations = plan.runs(), plan.evaluations()
    directory = progress.run_directory(tmp_path, dqn)
    for step in dqn.checkpoints:
        (directory / "policies" / str(step)).mkdir(parents=True)
    rows = [
        json.dumps({"schema": 1, "task": task, "episode": n, "num_updates": step})
        for step in dqn.checkpoints
        for task in evaluations[dqn.id].tasks
        for n in range(2)
    ]
    (directory / "evaluation.jsonl").write_text("\n".join(rows) + "\n")
    (directory / "metrics.jsonl").write_text('{"num_updates": 200}\n')
    log = progress.log_file(tmp_path, rainbow.id)
    log.parent.mkdir(parents=True)
    log.write_text("error: memory: 1 GB available\n# ended with exit code 2 after 3 s\n")
    assert main(["experiment", "status", "--results", str(tmp_path)]) == 1
    out = capsys.readouterr().out
    assert f"done     {dqn.id}: 200/200 updates, 12/12 episodes" in out
    assert f"failed   {rainbow.id}: 0/200 updates, 0/12 episodes" in out
    assert str(log) in out
    assert "error: memory: 1 GB available" in out
    assert "waiting  players/random: 0/6 episodes" in out
    assert "algorithm_comparison, scale 0.001: 1 done, 1 failed, 1 waiting" in out
    assert main(["experiment", "status", "--results", str(tmp_path), "--shard", "1/2"]) == 0
    capsys.readouterr()
    assert main(["experiment", "status", "--results", str(tmp_path), "--json"]) == 1
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [(row["job"], row["state"]) for row in rows] == [
        *((dqn.id, "done"), (rainbow.id, "failed"), ("players/random", "waiting"))
    ]
    assert rows[1]["log"] == str(log)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("status --results {}/none", "none has no plan.json; gvz experiment run writes one"),
        ("run nope --results {}/r", "unknown experiment 'nope'"),
        ("run --results {}/r", "experiments: got none, want at least one name"),
        ("run quick_comparison --scale 2 --results {}/r", "--scale: got 2, want more than 0"),
        ("run quick_comparison --shard 3/2 --results {}/r", "--shard: got '3/2'"),
        ("run quick_comparison --jobs 0 --results {}/r", "--jobs: got 0"),
        ("plan quick_comparison --scenario seek_and_kill", "but quick_comparison has defend_the_center"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(tmp_path, capsys, arguments, message):
    assert main(["experiment", *arguments.format(tmp_path).split()]) == 2
    err = capsys.readouterr().err
    assert message in err
    assert err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_damaged_rates_are_no_rates(tmp_path):
    file = tmp_path / "rates.json"
    assert read_rates(file) is None
    for text in ("{", '{"updates": 3}', "[]"):
        file.write_text(text)
        assert read_rates(file) is None


@pytest.mark.slow
@pytest.mark.engine
def test_rates_are_measured_by_training_and_playing(tmp_path, monkeypatch):
    monkeypatch.setenv("GVZ_CACHE_DIR", str(tmp_path / "cache"))
    work = tmp_path / "work"
    work.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(work))
    run = Plan(names=("algorithm_comparison",), scale=0.001).runs()[0]
    shown: list[str] = []
    slot = Slot(cores=CORES, environment={})
    rates = measure(run, 0.001, slot, lambda text, _: shown.append(text))
    assert rates.updates_per_s > 0
    assert rates.evaluation_steps_per_s > 0
    assert {"dqn_4task: train", "dqn_4task: evaluate"} == set(shown)
    assert read_rates(rates_file("dqn_4task", 0.001, slot)) == rates
    assert list(work.iterdir()) == []
