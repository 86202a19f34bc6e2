"""The real command with a learner over several devices: trains, and goes on with another number of them."""

import pytest
from command import finish, launch, rows

from gvz.core.durable import saved_steps

pytestmark = [pytest.mark.e2e, pytest.mark.engine, pytest.mark.timeout(900), pytest.mark.usefixtures("nothing_left")]

TWO_DEVICES = {"XLA_FLAGS": "--xla_force_host_platform_device_count=2"}


@pytest.mark.slow
def test_a_run_on_two_devices_trains_and_goes_on_with_one(tmp_path):
    run = tmp_path / "run"
    flags = "--learner.total-updates 40 --learner.devices 2 --actors.inference device".split()
    code, err = finish(launch(run, *flags, environment=TWO_DEVICES))
    assert code == 0, err
    assert "2 devices of the host)" in err
    assert "processes: 1 learner on 2 devices, 2 actors, 4 engines" in err
    code, err = finish(launch(run, "--learner.total-updates", "60"))
    assert code == 0, err
    assert "goes on from update 40" in err
    assert saved_steps(run / "checkpoints") == [40, 60]
    assert [row["num_updates"] for row in rows(run, "metrics.jsonl")] == [20, 40, 60]
    assert all(row["learner/loss"] > 0 for row in rows(run, "metrics.jsonl"))
    code, err = finish(launch(run, "--learner.total-updates", "80", "--learner.devices", "4"))
    assert (code, len(err.strip().splitlines())) == (2, 1), err
    assert err.startswith("error: learner.devices: got 4, but JAX sees 1 (cpu); lower it, or make more devices visible")
