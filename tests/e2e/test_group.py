"""Two learner processes of two devices each: the real command trains, one is killed, the same commands resume."""

import signal
from pathlib import Path

import numpy as np
import pytest
from command import TIMEOUT_S, alive, arrays_of, descendants, finish, launch, num_updates, rows

from gvz.core.durable import saved_steps
from gvz.run.relay import free_port
from tests.waiting import wait_until

pytestmark = [pytest.mark.e2e, pytest.mark.engine, pytest.mark.timeout(1800), pytest.mark.usefixtures("nothing_left")]

TWO_DEVICES = {"XLA_FLAGS": "--xla_force_host_platform_device_count=2"}
FLAGS = (
    "--training-set 1 --actors.num-actors 1 --actors.games-per-actor 2 --learner.devices 2 --learner.warmup-steps 120 "
    "--checkpoint.period-updates 20 --log.period-updates 10 --group.num-processes 2 --learner.total-updates 100 "
    "--learner.env-steps-per-update 16"
).split()


def start(run: Path):
    """Both processes, with a port that is free now."""
    address = f"127.0.0.1:{free_port('127.0.0.1')}"
    flags = [*FLAGS, "--group.coordinator", address, "--group.process-id"]
    return [launch(run, *flags, str(process), environment=TWO_DEVICES) for process in range(2)]


def saved(run: Path) -> list[list[int]]:
    return [saved_steps(path / "checkpoints") for path in (run, run / "process_1")]


def same_parameters(run: Path, step: int) -> bool:
    one, other = (arrays_of(path / "policies" / str(step)) for path in (run, run / "process_1"))
    assert one.keys() == other.keys()
    return all(np.array_equal(one[name], other[name]) for name in one)


@pytest.mark.slow
def test_a_group_trains_ends_when_one_is_killed_and_the_same_commands_resume_it(tmp_path):
    run = tmp_path / "run"
    first, second = start(run)
    wait_until(lambda: all(saved(run)), "a checkpoint of both", TIMEOUT_S)
    actors = descendants(first) + descendants(second)
    second.kill()
    code, err = finish(first)
    finish(second)
    assert code == 1, err
    last = err.strip().splitlines()[-1]
    assert last.startswith(
        "error: learner process 1 of 2 is gone, so the group ends; look at what it said last, and give"
    )
    assert err.count("error") == 1
    assert "Traceback" not in err
    wait_until(lambda: not alive(actors), "the end of all actors and engines", TIMEOUT_S)

    common = max(set(saved(run)[0]) & set(saved(run)[1]))
    first, second = start(run)
    wait_until(lambda: num_updates(run) > common, "further updates", TIMEOUT_S)
    second.send_signal(signal.SIGTERM)
    ended = [finish(process) for process in (first, second)]
    assert [code for code, _ in ended] == [143, 143], ended
    assert all(f"goes on from update {common}" in err for _, err in ended)
    newest = {max(steps) for steps in saved(run)}
    assert len(newest) == 1, saved(run)
    assert same_parameters(run, *newest)

    ended = [finish(process) for process in start(run)]
    assert [code for code, _ in ended] == [0, 0], ended
    assert all(f"goes on from update {max(newest)}" in err for _, err in ended)
    assert same_parameters(run, 100)
    losses = [[row["learner/loss"] for row in rows(path, "metrics.jsonl")] for path in (run, run / "process_1")]
    assert losses[0] == losses[1]
    seeds = [{row["seed"] for row in rows(path, "episodes.jsonl")} for path in (run, run / "process_1")]
    assert all(seeds)
    assert not seeds[0] & seeds[1]
