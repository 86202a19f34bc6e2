"""The real command on real Doom: trains, is interrupted, killed and resumed, and leaves nothing behind."""

import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from command import (
    ENV_STEPS_PER_UPDATE,
    TIMEOUT_S,
    alive,
    arrays_of,
    descendants,
    faults,
    finish,
    launch,
    num_updates,
    rows,
)
from scipy import stats

from gvz.core.durable import saved_steps
from learner.checkpoint import verify
from tests.processes import arguments
from tests.waiting import wait_until

pytestmark = [pytest.mark.e2e, pytest.mark.engine, pytest.mark.timeout(1800), pytest.mark.usefixtures("nothing_left")]


def test_a_run_trains_to_its_end_and_goes_on_when_asked_for_more(tmp_path):
    run = tmp_path / "run"
    weights = "--env.reward-weights death -3 kill 0".split()
    code, err = finish(launch(run, "--learner.total-updates", "200", *weights))
    assert code == 0, err
    assert "replay" in err
    assert "processes: 1 learner, 2 actors, 4 engines" in err
    assert saved_steps(run / "checkpoints") == [100, 200]
    assert saved_steps(run / "policies") == [100, 200]
    for step in (100, 200):
        verify(run / "checkpoints" / str(step))
    metrics = rows(run, "metrics.jsonl")
    assert [row["num_updates"] for row in metrics] == list(range(20, 201, 20))
    for name in ("learner/loss", "actors/decisions_per_s", "actors/staleness_mean_versions", "replay/fill_share"):
        assert all(name in row for row in metrics), name
    episodes = rows(run, "episodes.jsonl")
    assert {row["task"] for row in episodes} <= {
        f"defend_the_center/{name}" for name in ("default", "gore", "stone_wall", "fast_enemies")
    }
    for row in episodes:
        assert row["reward"] == pytest.approx(sum(row["reward_components"].values()), abs=1e-3)
        assert row["normalized_score"] == pytest.approx(row["score"] / 11)
        assert row["terminated"] != row["truncated"]
    assert {row["reward_components"]["kill"] for row in episodes} == {0.0}
    assert {row["reward_components"]["death"] for row in episodes if row["terminated"]} == {-3.0}
    assert list((run / "tensorboard").glob("events*"))

    code, err = finish(launch(run, "--learner.total-updates", "240", *weights))
    assert code == 0, err
    assert "goes on from update 200" in err
    assert rows(run, "metrics.jsonl")[-1]["num_updates"] == 240


def test_a_run_by_the_thesis_recipe_acts_at_random_in_warm_up_and_by_its_agent_from_then_on(tmp_path):
    """Without noise and learning, all values stay equal, so that by its agent each game presses one button only."""
    flags = (
        "--mode sync --seed 2222 --agent.noisy-sigma 0 --learner.learning-rate 1e-12 --learner.warmup-steps 1200 "
        "--learner.step-tolerance 8 --learner.env-steps-per-update 16 --learner.total-updates 20 "
        "--learner.publish-period-updates 1000"
    ).split()
    code, err = finish(launch(tmp_path / "run", *flags, config="rainbow_4task_thesis"))
    assert code == 0, err
    assert np.isfinite(rows(tmp_path / "run", "metrics.jsonl")[-1]["learner/loss"])
    arrays = arrays_of(tmp_path / "run" / "checkpoints" / "20")
    assert len(arrays["['replay'].newest"]) == 3
    warm_up = np.zeros(3, int)
    for i, head in enumerate(arrays["['replay'].store.heads"]):
        action, last = (arrays[f"['replay'].store.{name}"].reshape(4, -1)[i, :head] for name in ("action", "last"))
        decisions = action[~last]
        # 300 of warm-up a game, give or take what the tolerance and the last records of episodes move between games
        warm_up += np.bincount(decisions[:290], minlength=3)
        assert len(decisions) > 350
        assert len(set(decisions[310:])) == 1
    assert stats.chisquare(warm_up).pvalue > 0.001  # 0.13, the same on every machine: the keys draw integers


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_a_signal_saves_and_ends_everything(tmp_path, number, code):
    run = tmp_path / "run"
    process = launch(run, "--learner.total-updates", "1000000")
    wait_until(lambda: num_updates(run) >= 40, "40 updates", TIMEOUT_S)
    children = descendants(process)
    assert len([p for p in children if "vizdoom" in p.name()]) == 4
    os.killpg(process.pid, number)
    got, err = finish(process)
    assert got == code, err
    assert not alive(children)
    (saved,) = saved_steps(run / "checkpoints")[-1:]
    assert saved >= 40
    verify(run / "checkpoints" / str(saved))
    assert num_updates(run) == saved, "the last row has what came after the last log period"


def test_a_second_signal_ends_at_once_and_clean(tmp_path):
    run = tmp_path / "run"
    stuck = "gvz.run.saver.Saver.save_last = lambda *_: __import__('time').sleep(600)"
    process = launch(run, "--learner.total-updates", "1000000", patch=stuck)
    wait_until(lambda: num_updates(run) >= 20, "20 updates", TIMEOUT_S)
    children = descendants(process)
    process.send_signal(signal.SIGINT)
    assert process.stderr is not None
    while "stopping: " not in (line := process.stderr.readline()):
        assert line, "it has ended"
    process.send_signal(signal.SIGINT)  # only now, since two signals at once are one
    code, err = finish(process, 120)
    assert (code, err.splitlines()[-1]) == (130, "stopped at once")
    assert not alive(children)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_while_jax_is_imported_ends_at_once(tmp_path, number, code):
    process = launch(tmp_path / "run")
    maps = Path(f"/proc/{process.pid}/maps")
    wait_until(lambda: "jaxlib" in maps.read_text(), "the import of jax", TIMEOUT_S)
    start = time.monotonic()
    process.send_signal(number)
    got, err = finish(process)
    assert got == code, err
    assert err.splitlines()[-1] == "stopped at once"
    assert "Traceback" not in err
    assert time.monotonic() - start < 30  # on a loaded machine; it takes a quarter of a second


def test_a_killed_run_goes_on_from_its_checkpoint_without_a_burst(tmp_path):
    run = tmp_path / "run"
    process = launch(run, "--learner.total-updates", "400")
    wait_until(lambda: (run / "checkpoints" / "100").exists() and num_updates(run) >= 140, "update 140", TIMEOUT_S)
    children = descendants(process)
    process.kill()
    finish(process)
    wait_until(lambda: not alive(children), "actors and engines to end", 10)
    code, err = finish(launch(run, "--learner.total-updates", "400"))
    assert code == 0, err
    assert "goes on from update 100" in err
    metrics = rows(run, "metrics.jsonl")
    updates = [row["num_updates"] for row in metrics]
    assert updates == list(range(20, 401, 20))  # what the killed run wrote after its checkpoint is set aside
    assert (run / "discarded" / "metrics.jsonl").exists()
    for row in metrics:  # 300 warm-up decisions, then 4 an update: no second warm-up, no burst
        assert abs(row["actors/env_steps"] - 300 - ENV_STEPS_PER_UPDATE * row["num_updates"]) <= 256 + 64


def test_a_run_that_acts_on_the_learners_device_goes_on_after_a_kill_and_after_a_stop(tmp_path):
    run = tmp_path / "run"
    endless = "--learner.total-updates 1000000 --learner.env-steps-per-update 16".split()
    process = launch(run, "--actors.inference", "device", *endless)
    wait_until(lambda: num_updates(run) >= 20, "20 updates", TIMEOUT_S)
    children = descendants(process)
    actors = [child for child in children if "actors.worker" in arguments(child)]
    assert len(actors) == 2
    assert not [
        line for actor in actors for line in Path(f"/proc/{actor.pid}/maps").read_text().split() if "jax" in line
    ]
    actors[0].kill()
    wait_until(lambda: any(fault["kind"] == "died" for fault in faults(run)), "the fault to be recorded", TIMEOUT_S)
    after = num_updates(run)
    wait_until(lambda: num_updates(run) >= after + 60, "60 updates more", TIMEOUT_S)
    children = descendants(process)
    process.send_signal(signal.SIGINT)
    code, err = finish(process)
    assert code == 130, err
    assert not alive(children)
    assert "rings and requests" in err
    (saved,) = saved_steps(run / "checkpoints")[-1:]
    for row in rows(run, "metrics.jsonl"):  # 300 warm-up decisions, then 16 an update
        assert abs(row["actors/env_steps"] - 300 - 16 * row["num_updates"]) <= 256 + 64
        assert row["actors/staleness_mean_versions"] < 20
    process = launch(run, *endless)  # now actors act by themselves
    wait_until(lambda: num_updates(run) >= saved + 20, "20 updates more", TIMEOUT_S)
    process.send_signal(signal.SIGINT)
    code, err = finish(process)
    assert code == 130, err
    assert f"goes on from update {saved}" in err
    assert "rings and parameter queue" in err


@pytest.mark.slow
def test_a_synchronous_run_cut_twice_equals_one_that_was_not(tmp_path):
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    flags = ("--mode", "sync", "--learner.total-updates", "120")
    code, err = finish(launch(whole, *flags))
    assert code == 0, err
    for at in (20, 80):
        process = launch(cut, *flags)
        wait_until(lambda at=at: num_updates(cut) >= at, f"update {at}", TIMEOUT_S)
        process.send_signal(signal.SIGINT)
        code, err = finish(process)
        assert code == 130, err
    code, err = finish(launch(cut, *flags))
    assert code == 0, err
    arrays, others = (arrays_of(run / "checkpoints" / "120") for run in (whole, cut))
    assert arrays.keys() == others.keys()
    different = [name for name in arrays if not np.array_equal(arrays[name], others[name])]
    assert different == []  # parameters, optimizer, replay, tree, keys
    assert (whole / "episodes.jsonl").read_bytes() == (cut / "episodes.jsonl").read_bytes()
    assert len((whole / "episodes.jsonl").read_bytes()) > 0
    for run in (whole, cut):  # the rows that an interruption has written are set aside
        assert [row["num_updates"] for row in rows(run, "metrics.jsonl")] == [20, 40, 60, 80, 100, 120]
