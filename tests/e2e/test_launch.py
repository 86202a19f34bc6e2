"""The real command on real Doom: trains, is interrupted, killed and resumed, and leaves nothing behind."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import orbax.checkpoint as ocp
import psutil
import pytest

from gvz.rundir import read_records
from learner.checkpoint import checkpoint_steps, verify

pytestmark = [pytest.mark.e2e, pytest.mark.engine, pytest.mark.timeout(600)]

SMALL = (
    "--config rainbow_4task.py --actors.num-actors 2 --actors.games-per-actor 2 --env.frame-height 36 "
    "--env.frame-width 44 --env.grayscale --agent.conv-channels 8 8 --agent.conv-kernels 8 4 --agent.conv-strides 4 2 "
    "--agent.hidden-units 32 --replay.capacity 4000 --learner.warmup-steps 300 --learner.batch-size 8 "
    "--log.period-updates 20 --checkpoint.period-updates 100 --learner.target-period-updates 50"
).split()


def launch(run: Path, *extra: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "gvz.launch", *SMALL, "--run-dir", str(run), *extra],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def finish(process: subprocess.Popen[str], timeout_s: float = 240) -> tuple[int, str]:
    _, err = process.communicate(timeout=timeout_s)
    return process.returncode, err


def rows(run: Path, name: str) -> list[dict]:
    found, problems = read_records(run / name)
    assert problems == []
    return found


def wait_until(condition: Callable[[], bool], what: str, timeout_s: float = 180) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, f"waited {timeout_s} s for {what}"
        time.sleep(0.05)


def num_updates(run: Path) -> int:
    file = run / "metrics.jsonl"
    lines = file.read_text().splitlines() if file.exists() else []
    return json.loads(lines[-1])["num_updates"] if lines else 0


def descendants(process: subprocess.Popen[str]) -> list[psutil.Process]:
    return psutil.Process(process.pid).children(recursive=True)


def alive(processes: list[psutil.Process]) -> list[psutil.Process]:
    return [p for p in processes if p.is_running() and p.status() != psutil.STATUS_ZOMBIE]


def orphans() -> set[str]:
    """Segments and queues of ours, or of engines, that no living process has mapped."""
    mapped = ""
    for process in psutil.process_iter():
        with contextlib.suppress(OSError):
            mapped += Path(f"/proc/{process.pid}/maps").read_text()
    names = (p.name for p in Path("/dev/shm").iterdir() if p.name.startswith(("ViZDoom", "gvz-")))
    return {name for name in names if f"/dev/shm/{name}" not in mapped}


def arrays_of(checkpoint: Path) -> dict[str, np.ndarray]:
    with ocp.StandardCheckpointer() as checkpointer:
        return checkpointer.restore((checkpoint / "arrays").absolute())


@pytest.fixture(autouse=True)
def nothing_left():
    """No segment and no stray engine file of ours remains after the test."""
    before, files = orphans(), set(Path.cwd().glob("_vizdoom*"))
    yield
    wait_until(lambda: orphans() <= before, "shared memory to be removed", 15)
    assert set(Path.cwd().glob("_vizdoom*")) <= files


def test_a_run_trains_to_its_end_and_goes_on_when_asked_for_more(tmp_path):
    run = tmp_path / "run"
    code, err = finish(launch(run, "--learner.total-updates", "200"))
    assert code == 0, err
    assert "replay" in err
    assert "processes: 1 learner, 2 actors, 4 engines" in err
    assert checkpoint_steps(run / "checkpoints") == [100, 200]
    assert checkpoint_steps(run / "policies") == [100, 200]
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
    assert list((run / "tensorboard").glob("events*"))

    code, err = finish(launch(run, "--learner.total-updates", "240"))
    assert code == 0, err
    assert "goes on from update 200" in err
    assert rows(run, "metrics.jsonl")[-1]["num_updates"] == 240

    code, err = finish(launch(run, "--learner.total-updates", "240", "--seed", "7"))
    assert code == 2
    assert "seed: 1111 -> 7" in err
    code, err = finish(launch(run, "--learner.total-updates", "20", "--fresh"))
    assert code == 0, err
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_saves_and_ends_everything(tmp_path, number, code):
    run = tmp_path / "run"
    process = launch(run, "--learner.total-updates", "1000000")
    wait_until(lambda: num_updates(run) >= 40, "40 updates")
    children = descendants(process)
    assert len([p for p in children if "vizdoom" in p.name()]) == 4
    os.killpg(process.pid, number)
    got, err = finish(process, 60)
    assert got == code, err
    assert not alive(children)
    (saved,) = checkpoint_steps(run / "checkpoints")[-1:]
    assert saved >= 40
    verify(run / "checkpoints" / str(saved))


def test_a_second_signal_ends_at_once_and_clean(tmp_path):
    run = tmp_path / "run"
    process = launch(run, "--learner.total-updates", "1000000")
    wait_until(lambda: num_updates(run) >= 20, "20 updates")
    children = descendants(process)
    process.send_signal(signal.SIGINT)
    process.send_signal(signal.SIGINT)
    code, err = finish(process, 30)
    assert code == 130, err
    assert not alive(children)


def test_a_killed_run_goes_on_from_its_checkpoint_without_a_burst(tmp_path):
    run = tmp_path / "run"
    process = launch(run, "--learner.total-updates", "400")
    wait_until(lambda: (run / "checkpoints" / "100").exists() and num_updates(run) >= 140, "update 140")
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
        assert abs(row["actors/env_steps"] - 300 - 4 * row["num_updates"]) <= 256 + 64


def test_a_synchronous_run_cut_three_times_equals_one_that_was_not(tmp_path):
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    flags = ("--mode", "sync", "--learner.total-updates", "120")
    code, err = finish(launch(whole, *flags))
    assert code == 0, err
    for at in (20, 60, 100):
        process = launch(cut, *flags)
        wait_until(lambda at=at: num_updates(cut) >= at, f"update {at}")
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
