"""Every benchmark's body runs, its record says what it measured, and docs/PERFORMANCE.md says what the records give."""

import dataclasses
import itertools
import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from actors import placement
from benchmarks import plots, record, remote, report, rounds, runner, whole
from gvz.core.control_groups import num_cores
from gvz.core.errors import ConfigError
from gvz.core.registry import discover
from learner.augment import AUGMENTATIONS
from tests.processes import arguments
from tests.waiting import wait_until

ROOT = Path(__file__).parent.parent
NO_PEERS = Path("no-peers/bin/python")
QUICK = dataclasses.replace(rounds.QUICK, body_s=0.05, peers=NO_PEERS)
NAMES = sorted(runner.benchmarks())


def made(rows: list[rounds.Row], **fields) -> record.Record:
    """A record of the goal-keeping kind, not measured."""
    values = {
        "schema": record.SCHEMA,
        "benchmark": "sum_tree",
        "device": "cpu",
        "commit": "abc",
        "date": "2026-01-01 00:00",
        "command": "python -m benchmarks sum_tree",
        "quick": False,
        "seconds": 1.0,
        "machine": {"cpu": "a CPU", "cores": 2, "memory_bytes": 2**30, "load": [0.5, 0, 0], "devices": ["cpu: cpu"]},
        "versions": dict.fromkeys(("jax", "vizdoom", "numpy", "python"), "1"),
        "rows": rows,
    }
    return record.Record(**{**values, **fields})


# --------------------------------------------------------------------------------------------- bodies


def test_the_page_has_a_section_for_every_benchmark():
    assert sorted(name for name, _ in report.GOALS.values()) == NAMES
    assert all(module.__doc__ for module in runner.benchmarks().values())


@pytest.mark.engine
@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", NAMES)
def test_a_body_runs_and_measures_its_goals(name):
    rows = runner.benchmarks()[name].measure(QUICK)
    goals = {number: benchmark for number, (benchmark, _) in report.GOALS.items()}
    without_a_goal_here = {
        "sum_tree",
        "learner_update",
        "encoders",
        "augmentations",
        "placement",
        "gpu",
    }  # the first two need a peer
    assert {goals[row["number"]] for row in rows if row["kind"] == "goal"} == ({name} - without_a_goal_here)
    for row in rows:
        if row["kind"] == "absent":
            assert "no interpreter" in row["why"] or "JAX has none" in row["why"]
            continue
        spreads = [row[f"{unit}_per_s"] for unit in report.RATES] if row["kind"] == "rates" else [row]
        for spread in spreads:
            assert spread is None or len(spread["values"]) == 1, row
            assert spread is None or spread["median"] >= 0 or "exponent" in row["name"], row
    assert json.loads(json.dumps(rows)) == rows


def test_a_run_that_is_measured_may_have_the_cores_of_the_benchmarks_own_parts(tmp_path, monkeypatch):
    def start(*_, **__):
        assert lock.closed
        raise FileNotFoundError

    lock = (tmp_path / "lock").open("w")
    monkeypatch.setattr(placement, "_locks", [lock])
    monkeypatch.setattr(subprocess, "Popen", start)
    with pytest.raises(FileNotFoundError):
        whole.run_command(tmp_path / "run", QUICK, 1, 1, 1.0, print)


def test_the_command_writes_a_record_that_the_page_refuses(tmp_path):
    arguments = ["sum_tree", "--quick", "--out", str(tmp_path), "--peers", str(NO_PEERS)]
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks", *arguments], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "sum tree, batch 32" in done.stdout
    written = json.loads((tmp_path / "sum_tree.json").read_text())  # whatever the engine: it plays no game
    assert written["command"] == "python -m benchmarks sum_tree --quick"
    assert written["machine"]["cores"] == num_cores()
    assert written["commit"] != "unknown"
    with pytest.raises(ConfigError, match="made by --quick, its figures mean nothing"):
        record.read_all(tmp_path)


def test_a_failing_benchmark_does_not_sink_the_others(tmp_path):
    (tmp_path / "out").write_text("a file where a directory should be")
    failure = runner.run("startup_", QUICK, "none", tmp_path / "out")
    assert failure == "startup_: its process ended with code 1"


def test_a_benchmark_that_hangs_is_ended(tmp_path):
    start = time.monotonic()
    assert runner.run("sum_tree", QUICK, "none", tmp_path, timeout_s=0.5) == "sum_tree: it had not ended after 0 s"
    assert time.monotonic() - start < 60


@pytest.mark.engine
def test_ctrl_c_ends_all_processes(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-m", "benchmarks", "transport", "--out", str(tmp_path)],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None

    def children() -> list[psutil.Process]:
        return psutil.Process(process.pid).children(recursive=True)

    def measures() -> bool:
        return any("ring_writer.py" in " ".join(arguments(child)) for child in children())

    wait_until(measures, "the writer of the ring", 240, process=process)
    started = children()
    process.send_signal(signal.SIGINT)
    assert process.wait(90) == 130
    assert "what was started is ended" in process.stderr.read()
    process.stderr.close()
    assert psutil.wait_procs(started, timeout=10)[1] == []


def test_an_unknown_name_names_the_known_ones(capsys):
    from benchmarks.__main__ import main

    assert main(["no_such"]) == 2
    assert "there is no no_such; there are all, acting, actors" in capsys.readouterr().err
    assert main([]) == 2
    assert "got no name" in capsys.readouterr().err
    assert main(["--list"]) == 0
    assert capsys.readouterr().out.count("\n") == len(NAMES)


# --------------------------------------------------------------------------------------------- rounds and rows


def test_rounds_alternate_and_the_warm_up_is_thrown_away():
    calls: list[str] = []

    def body(name: str) -> float:
        calls.append(name)
        return float(len(calls))

    values = rounds.alternate(2, {"a": lambda: body("a"), "b": lambda: body("b")})
    assert calls == ["a", "b"] * 3
    assert values == {"a": [3.0, 5.0], "b": [4.0, 6.0]}


def test_a_ratio_is_made_within_a_round():
    assert rounds.ratios([1.0, 9.0], [2.0, 3.0]) == [0.5, 3.0]
    row = rounds.goal(4, "x", [0.5, 3.0, 2.0], at_least=2.0)
    assert (row["median"], row["min"], row["max"]) == (2.0, 0.5, 3.0)
    assert rounds.met(row)
    assert not rounds.met(rounds.goal(8, "x", [0.6], at_most=0.5))


def test_rates_give_frames_and_samples_with_decisions_and_updates():
    row = rounds.rates("x", decisions_per_s=[10.0])
    assert row["frames_per_s"]["median"] == 40.0
    assert row["updates_per_s"] is None
    row = rounds.rates("x", updates_per_s=[2.0], batch_size=32)
    assert row["samples_per_s"]["median"] == 64.0


def test_seconds_per_call_are_those_of_a_call():
    calls: list[float] = []
    found = rounds.seconds_per_call(lambda: calls.append(time.sleep(0.01) or 0.0), 0.05)
    assert found >= 0.01
    assert len(calls) >= 1


def test_an_exponent_is_the_slope_between_the_ends():
    from benchmarks.growth import exponent

    assert exponent({10: [2.0], 100: [5.0], 1000: [2.0]}) == pytest.approx([0.0])
    assert exponent({10: [2.0, 1.0], 1000: [200.0, 10.0]}) == pytest.approx([1.0, 0.5])


def test_the_arithmetic_of_a_decision_is_that_of_its_layers():
    import jax
    import jax.numpy as jnp

    from benchmarks import workload
    from gvz.run.assemble import run_agent
    from learner.agents.rainbow import Rainbow

    agent = run_agent(workload.run_config(dataclasses.replace(QUICK, quick=False)))
    params = jax.eval_shape(agent.init, jax.random.key(0))
    found = workload.flops(workload.direct(agent).act, params, jax.random.key(0), agent.spec.zeros(), jnp.float32(0))
    convolutions = 20 * 20 * 8 * 8 * 12 * 32 + 9 * 9 * 4 * 4 * 32 * 64 + 7 * 7 * 3 * 3 * 64 * 64
    dense = 2 * (2 * 3136 * 512 + 512 * 51 + 512 * 3 * 51)  # each layer has noisy weights too
    assert found == pytest.approx(2 * (convolutions + dense), rel=0.05)  # the rest draws the noise
    assert isinstance(agent, Rainbow)
    folded = jax.eval_shape(agent.fold, params, jax.random.key(0))
    found = workload.flops(workload.direct(agent).act, folded, jax.random.key(0), agent.spec.zeros(), jnp.float32(0))
    assert found == pytest.approx(2 * (convolutions + dense / 2), rel=0.02)


# --------------------------------------------------------------------------------------------- peers


def test_a_peer_that_does_not_start_says_why():
    assert "there is no interpreter" in str(remote.start_peer("flashbax_tree", NO_PEERS))
    found = remote.start_peer("envpool_doom", Path(sys.executable), "1", "1")
    assert "ModuleNotFoundError: No module named 'envpool'" in str(found)


def test_a_peer_in_an_environment_of_its_own_is_found(tmp_path):
    own = tmp_path / "peers-dopamine" / "bin"
    own.mkdir(parents=True)
    (own / "python").symlink_to(sys.executable)
    found = remote.start_peer("dopamine_rainbow", tmp_path / "peers" / "bin" / "python", "1", "1")
    assert "ModuleNotFoundError: No module named 'gin'" in str(found)


def test_a_remote_body_answers_and_one_that_dies_is_an_error():
    with remote.Remote("cpu_matmul", environment={"JAX_PLATFORMS": "cpu"}) as body:
        assert body.about["versions"]["jax"]
        answer = body(seconds=0.01)
        assert answer["count"] / answer["seconds"] > 0
        with pytest.raises(remote.RemoteError, match="unexpected keyword argument 'nonsense'"):
            body(nonsense=1)
        with pytest.raises(remote.RemoteError, match="cpu_matmul: "):
            body(seconds=0.01)


# --------------------------------------------------------------------------------------------- the page


def test_the_page_is_what_the_records_give():
    page = report.PAGE.read_text()
    assert report.write_page(page, record.read_all()) == page


def test_the_page_has_the_cost_of_every_encoder_and_augmentation():
    parts = {"encoders": discover("learner.encoders", "ENCODER").keys(), "augmentations": AUGMENTATIONS.keys()}
    for benchmark, names in parts.items():
        (found,) = [made for made in record.read_all() if made.benchmark == benchmark]
        assert names <= {row["name"].partition(",")[0] for row in found.rows}, benchmark


def test_a_record_is_read_as_it_was_written(tmp_path):
    rows = [rounds.goal(4, "against flashbax", [2.5], at_least=2.0), rounds.absent("EnvPool", "not installed")]
    file = record.write(made(rows), tmp_path)
    assert file.name == "sum_tree.json"
    assert record.write(made(rows, device="gpu"), tmp_path).name == "sum_tree_gpu.json"
    assert record.read_all(tmp_path) == [made(rows), made(rows, device="gpu")]


def test_what_is_no_record_is_refused(tmp_path):
    file = record.write(made([], schema=0), tmp_path)
    with pytest.raises(ConfigError, match="schema 0, want 1; measure again"):
        record.read_all(tmp_path)
    file.write_text("{}")
    with pytest.raises(ConfigError, match="not a record of benchmarks"):
        record.read_all(tmp_path)


def test_the_goals_say_met_missed_and_not_measured():
    rows = [rounds.goal(4, "batch 32", [2.5], at_least=2.0, unit="x"), rounds.goal(4, "batch 512", [1.5], at_least=2.0)]
    table = report.goals_table([made(rows)])
    assert "| [4. Sum tree](#4-sum-tree) | batch 32 | >= 2 x | 2.5 x | met |" in table
    assert "|  | batch 512 | >= 2 | 1.5 | **missed** |" in table
    assert "| [8. Start-up](#8-start-up) | | | not measured | |" in table


def test_a_section_holds_the_machine_the_rates_the_curves_and_what_is_missing():
    rows = [
        rounds.rates("pool", decisions_per_s=[1000.0, 1100.0, 900.0]),
        rounds.measured("draw", "ms", [1.0], x=100, x_unit="records"),
        rounds.measured("draw", "ms", [0.5], x=10, x_unit="records"),
        rounds.measured("products", "GFLOP/s", [123.4]),
        rounds.absent("EnvPool", "not installed"),
    ]
    text = report.section([made(rows)], "sum_tree")
    assert "commit abc, `python -m benchmarks sum_tree`, 1 s; a CPU, 2 cores, 1 GiB; load at the start 0.5" in text
    assert "| pool | 1,000 [900, 1,100] | 4,000 [3,600, 4,400] | - | - |" in text
    assert "| draw, records | 10 | 100 |\n|---|---|---|\n| ms | 0.5 | 1 |" in text
    assert "| products | 123 | GFLOP/s |" in text
    assert "- EnvPool: not installed." in text
    assert "There is no record of this benchmark" in report.section([], "sum_tree")


def test_a_page_without_its_markers_is_an_error():
    with pytest.raises(ConfigError, match=r"goals: written by .* are missing; what is measured goes between them"):
        report.write_page("# Performance", [])


def test_the_plots_are_drawn_from_records(tmp_path):
    bars = [rounds.rates("actor pool", decisions_per_s=[2.0, 3.0]), rounds.rates("EnvPool", decisions_per_s=[1.0])]
    curve = [rounds.measured("draw", "ms", [1.0, 2.0], x=x, x_unit="records") for x in (10, 100)]
    records = [made(bars, benchmark="actors"), made(curve, benchmark="growth")]
    files = plots.draw(records, tmp_path)
    assert [file.name for file in files] == ["performance_actors.png", "performance_growth.png"]
    assert all(file.stat().st_size > 1000 for file in files)
    assert "![" in report.section(records, "growth")


def test_the_plot_of_a_benchmark_is_of_the_released_engine_whatever_else_was_measured(tmp_path):
    rows, faster = ([rounds.rates("actor pool", decisions_per_s=[rate])] for rate in (2.0, 4.0))
    alone, both = [made(rows, benchmark="actors")], []
    both += [*alone, made(faster, benchmark="actors", versions={**alone[0].versions, "vizdoom": "1.3.2+gvz.1"})]
    drawn = []
    for records in (alone, both):
        [file] = plots.draw(records, tmp_path)
        drawn.append(file.read_bytes())
    assert drawn[0] == drawn[1]
    assert "![actors: the first of the records above as a plot]" in report.section(both, "actors")


@pytest.mark.parametrize("sizes", [(6_728_248, 18_855_064, 53_162_552), (1, 2, 3, 4)])
def test_the_sizes_below_a_plot_of_growth_do_not_lie_on_each_other(sizes):
    figure = plots.growth([rounds.measured("step", "ms", [1.0, 2.0], x=x, x_unit="parameters") for x in sizes])
    figure.draw_without_rendering()
    axis = figure.axes[0].xaxis
    labels = [label for minor in (False, True) for label in axis.get_ticklabels(minor=minor) if label.get_text()]
    boxes = sorted((label.get_window_extent() for label in labels), key=lambda box: box.x0)
    assert len(boxes) == len(sizes)
    assert all(left.x1 < right.x0 for left, right in itertools.pairwise(boxes))


def test_a_plot_of_growth_can_be_read_on_a_page():
    """Its legends hide no point, and it is less than 10 inches wide."""
    sizes = [rounds.measured(f"step {n}", "ms", [1.0, 2.0], x=x, x_unit=f"{n}") for n in range(5) for x in (1, 2, 4)]
    figure = plots.growth(sizes)
    figure.draw_without_rendering()
    assert figure.get_figwidth() < 10
    assert len(figure.axes) == 5
    for axes in figure.axes:
        legend = axes.get_legend()
        assert legend is not None
        assert not legend.get_window_extent().overlaps(axes.bbox)
