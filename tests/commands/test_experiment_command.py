"""`gvz experiment`: list, plan by earlier records, status; what is bad input. Running is tests/e2e's."""

import dataclasses
import json
import os

import pytest

from gvz.cli import main
from gvz.commands.experiment import _side_by_side
from gvz.core.control_groups import num_cores
from gvz.experiments import inventory
from gvz.experiments.base import experiments
from gvz.experiments.costs import Rates, read_rates, run_cost
from gvz.experiments.plan import Evaluation, Plan, write_plan
from gvz.experiments.scale import scaled
from gvz.run.machine import cpu_model
from tests.reports.conftest import write_rows

RUN = "rainbow_4task/defend_the_center/train4/seed_1111"
CORES = num_cores()


@pytest.fixture
def results(tmp_path, monkeypatch):
    """Of one run on all cores: 10 updates/s, 1000 evaluation decisions/s."""
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    monkeypatch.chdir(tmp_path)
    run = tmp_path / "results" / "runs" / RUN
    write_rows(run / "starts.jsonl", [{"cpu": cpu_model(), "cores": CORES}])
    rates = [0.0, 9.0, 10.0, 11.0]
    write_rows(
        run / "metrics.jsonl", [{"num_updates": n, "learner/updates_per_s": rate} for n, rate in enumerate(rates)]
    )
    write_rows(run / "evaluation.jsonl", [{"length_steps": 1500} for _ in range(8)])
    log = inventory.log_file(tmp_path / "results", RUN)
    log.parent.mkdir(parents=True)
    log.write_text(
        f"# 2026-11-22 12:00:00 python -m gvz.launch --config rainbow_4task\n{inventory.END_MARK}0 after 600 s\n"
        f"# 2026-11-22 12:10:00 python -m gvz.cli evaluate {run}\nplaying\n{inventory.END_MARK}130 after 4 s\n"
        f"# 2026-11-22 12:11:00 python -m gvz.cli evaluate {run}\n{inventory.END_MARK}0 after 8 s\n"
    )
    return tmp_path / "results"


def test_list_names_every_experiment_with_its_question(capsys):
    assert main(["experiment", "list"]) == 0
    out = capsys.readouterr().out
    for experiment in experiments().values():
        assert f"{experiment.name}: {experiment.question}" in out
        assert f"{len(experiment.runs())} runs of {experiment.budget}" in out
    assert "12 runs of 1,200 seconds of processor time, at most 60,000 gradient steps" in out
    assert "4 runs of 14,400 seconds of processor time, at most 500,000 gradient steps" in out
    assert "rainbow_4task+decisions_4, rainbow_4task+decisions_16" in out
    assert main(["experiment", "list", "--json"]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert {row["name"]: row["runs"] for row in rows} == {e.name: len(e.runs()) for e in experiments().values()}


def test_plan_prints_runs_steps_episodes_and_hours_and_counts_shared_runs_once(results, capsys):
    arguments = ["experiment", "plan", "rainbow_evaluation", "training_set_size", "--jobs", "1", "--shard", "1/2"]
    arguments += ["--results", str(results)]
    assert main([*arguments, "--scenario", "defend_the_center"]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    # 18 tasks x 100 episodes x 20 checkpoints; (200,000 + 10,000 / 16) / 10 s and 36,000 x 1100 / 4 / 1000 s
    run = ["rainbow_4task/defend_the_center/train4/seed_1111", "200,000", "3,210,000", "36,000", "5.57", "2.75"]
    assert run in lines
    assert ["rainbow_evaluation:", "3", "runs", "600,000", "9,630,000", "108,000", "16.72", "8.25"] in lines
    assert lines[-4][:6] == ["together,", "shared", "runs", "once:", "9", "runs"]
    assert lines[-4][6:9] == ["1,800,000", "28,890,000", "192,000"]  # 3 x 36,000 + 6 x 7 x 100 x 20
    seeds = [cells[0] for cells in lines if cells and cells[0].startswith("rainbow_4task/")]
    assert len(seeds) == 5  # of nine runs, every other one
    assert lines[-1][:4] == ["rainbow_4task:", "10.00", "updates/s,", "1000.00"]
    assert main([*arguments, "--scenario", "defend_the_center", "--json"]) == 0
    rows = {row["run"]: row for row in map(json.loads, capsys.readouterr().out.splitlines())}
    assert len(rows) == 5
    row = rows["rainbow_4task/defend_the_center/train4/seed_1111"]
    assert row["experiments"] == ["rainbow_evaluation", "training_set_size"]
    assert (row["updates"], row["episodes"]) == (200_000, 36_000)
    assert (row["training_hours"], row["evaluation_hours"]) == pytest.approx((200_625 / 36_000, 2.75))


def test_jobs_side_by_side_take_as_long_as_the_slot_that_ends_last(results, capsys):
    arguments = ["experiment", "plan", "rainbow_evaluation", "--scenario", "defend_the_center", "--jobs", "1"]
    assert main([*arguments, "--results", str(results)]) == 0
    assert "1 job at once on this machine: at most 24.97 hours" in capsys.readouterr().out
    for hours, slots, want in (([3.0], 2, 3.0), ([3.0, 3.0, 3.0], 2, 6.0), ([4.0, 1.0, 2.0, 1.0], 2, 4.0)):
        assert _side_by_side(hours, slots) == want


def test_a_gate_s_hours_follow_from_its_processor_time_and_its_variants_have_rates_of_their_own(results, capsys):
    fast = results / "runs" / "rainbow_4task+decisions_16" / "dodge_projectiles" / "train4" / "seed_1111"
    write_rows(fast / "starts.jsonl", [{"cpu": cpu_model(), "cores": CORES}])
    write_rows(fast / "metrics.jsonl", [{"num_updates": 1, "learner/updates_per_s": 7.0}])
    assert main(["experiment", "plan", "gate_reuse", "--jobs", "1", "--results", str(results)]) == 0
    out = capsys.readouterr().out
    assert "rainbow_4task+decisions_16: 7.00 updates/s" in out
    assert "rainbow_4task+decisions_4: - updates/s" in out
    assert main(["experiment", "plan", "gate_reuse", "--jobs", "1", "--results", str(results), "--json"]) == 0
    rows = {row["run"]: row for row in map(json.loads, capsys.readouterr().out.splitlines())}
    assert len(rows) == 12
    row = rows["rainbow_4task+decisions_64/defend_the_center/train4/seed_2222"]
    assert row["training_hours"] == pytest.approx(1_200 / CORES / 3600)
    assert (row["updates"], row["env_steps"], row["episodes"]) == (60_000, 10_000 + 64 * 60_000, (3 + 4) * 20)


def test_status_tells_done_failed_and_waiting_apart(tmp_path, capsys):
    plan = write_plan(tmp_path, Plan.of("algorithm_comparison", scale=0.001))
    (dqn, rainbow), evaluations = plan.runs(), plan.evaluations()
    directory = inventory.run_directory(tmp_path, dqn)
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
    log = inventory.log_file(tmp_path, rainbow.id)
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
    assert main(["experiment", "status", "--results", str(tmp_path), "--shard", "2/2"]) == 1
    assert "players/" not in capsys.readouterr().out, "the first shard plays them"
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
def test_bad_input_is_one_line_and_leaves_nothing(tmp_path, refusal, arguments, message):
    assert message in refusal("experiment", *(word.format(tmp_path) for word in arguments.split()))
    assert list(tmp_path.iterdir()) == []


def test_a_run_of_the_trainer_counts_and_one_of_another_machine_or_with_other_cores_does_not(results, tmp_path):
    assert read_rates(results, "rainbow_4task", 1, CORES) == Rates(updates_per_s=10.0, evaluation_steps_per_s=1000.0)
    unknown = Rates(updates_per_s=None, evaluation_steps_per_s=None)
    assert read_rates(results, "rainbow_4task", 1, CORES + 1) == unknown
    write_rows(results / "runs" / RUN / "starts.jsonl", [{"cpu": "another", "cores": CORES}])
    assert read_rates(results, "rainbow_4task", 1, CORES) == unknown
    own = tmp_path / "runs" / "rainbow_4task" / "seed_7"
    write_rows(own / "starts.jsonl", [{"cpu": cpu_model(), "cores": CORES}])
    write_rows(
        own / "metrics.jsonl", [{"num_updates": 1, "learner/updates_per_s": 7.0}, {"learner/updates_per_s": "x"}]
    )
    assert read_rates(results, "rainbow_4task", 1, CORES) == Rates(updates_per_s=7.0, evaluation_steps_per_s=None)
    assert read_rates(results, "rainbow_4task", 0.001, CORES) == unknown, "its networks are other ones"


def test_rates_are_of_the_newest_runs_by_their_last_start_and_of_what_their_own_command_evaluated(results):
    for age, (cpu, rate) in enumerate([*[(cpu_model(), 8.0)] * 2, ("another", 90.0), (cpu_model(), 1.0)]):
        run = results / "runs" / "rainbow_4task" / "seek_and_kill" / "train4" / f"seed_{age}"
        write_rows(run / "starts.jsonl", [{"cpu": "first", "cores": CORES}, {"cpu": cpu, "cores": CORES}])
        write_rows(run / "metrics.jsonl", [{"num_updates": 1, "learner/updates_per_s": rate}] * 9)
        write_rows(run / "evaluation.jsonl", [{"length_steps": 9000}])  # by hand: no log says how long it took
        os.utime(run, (0, 100 - age))
    assert read_rates(results, "rainbow_4task", 1, CORES) == Rates(updates_per_s=8.0, evaluation_steps_per_s=1000.0)


def test_a_cost_counts_the_scaled_warm_up_and_the_time_outs_of_the_run_s_profile():
    full = experiments()["rainbow_evaluation"]
    experiment = dataclasses.replace(full, scenarios=("seek_and_kill",), variants={"dense": {"env.profile": "levdoom"}})
    unknown, evaluation = Rates(updates_per_s=None, evaluation_steps_per_s=1.0), Evaluation(tasks=("t",), episodes=1)
    (run, *_) = scaled(experiment, 0.5).runs()
    cost = run_cost(run, evaluation, 0.5, unknown, CORES)
    assert (cost.env_steps, cost.training_hours) == (5_000 + 16 * 100_000, None)
    assert cost.evaluation_hours == pytest.approx(20 * (1_250 // 4) / 3600)


def test_plan_without_records_says_how_to_get_some(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["experiment", "plan", "quick_comparison"]) == 0
    out = capsys.readouterr().out
    assert "hours are not known yet; begin with gvz experiment run" in out
    assert "dqn_quick: - updates/s, - evaluation decisions/s" in out
