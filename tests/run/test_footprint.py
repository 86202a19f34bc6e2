"""The footprint: what a run takes, and a refusal with advice when the machine has not got it."""

import dataclasses

import pytest

from gvz.core.errors import ResourceError
from gvz.run.footprint import ENGINE_SHM_BYTES, Footprint, check, format_bytes

FOOTPRINT = Footprint(
    replay_bytes=2_000_000_000,
    replay_on_host=True,
    params_bytes=20_000_000,
    num_actors=2,
    num_games=8,
    transport_bytes=100_000_000,
    placement="actors and engines on any core",
)


def test_engines_alone_take_dev_shm_and_the_transport_is_memory_all_the_same():
    assert FOOTPRINT.shm_bytes == 8 * ENGINE_SHM_BYTES
    assert FOOTPRINT.memory_bytes - dataclasses.replace(FOOTPRINT, transport_bytes=0).memory_bytes == 100_000_000


def test_a_replay_on_a_gpu_is_not_charged_to_the_host_but_its_checkpoint_copy_is():
    on_device = dataclasses.replace(FOOTPRINT, replay_on_host=False)
    assert FOOTPRINT.memory_bytes - on_device.memory_bytes == FOOTPRINT.replay_bytes
    assert on_device.snapshot_bytes == FOOTPRINT.snapshot_bytes > FOOTPRINT.replay_bytes


def test_actors_that_ask_for_their_actions_have_neither_jax_nor_parameters():
    asking = dataclasses.replace(FOOTPRINT, actors_ask=True)
    assert FOOTPRINT.memory_bytes - asking.memory_bytes == 2 * (270_000_000 - 50_000_000 + 2 * 20_000_000)
    assert "rings and parameter queue 100 MB" in FOOTPRINT.lines()[1]
    assert "rings and requests 100 MB" in asking.lines()[1]


def test_the_lines_say_bytes_and_processes():
    text = "\n".join(FOOTPRINT.lines())
    assert "replay 2.00 GB (host)" in text
    assert "processes: 1 learner, 2 actors, 8 engines" in text


def test_several_devices_share_the_replay_and_each_has_all_parameters():
    several = dataclasses.replace(FOOTPRINT, num_devices=4)
    assert several.memory_bytes - FOOTPRINT.memory_bytes == 3 * 4 * FOOTPRINT.params_bytes
    assert several.snapshot_bytes == FOOTPRINT.snapshot_bytes
    assert "replay 2.00 GB (4 devices of the host)" in several.lines()[0]
    assert "processes: 1 learner on 4 devices, 2 actors" in several.lines()[2]
    on_device = dataclasses.replace(several, replay_on_host=False)
    assert "replay 2.00 GB (4 devices)" in on_device.lines()[0]
    assert on_device.memory_bytes == dataclasses.replace(FOOTPRINT, replay_on_host=False).memory_bytes


def test_what_fits_passes():
    check(FOOTPRINT, shm_free=FOOTPRINT.shm_bytes, memory_free=FOOTPRINT.memory_bytes)


def test_a_small_dev_shm_is_refused_with_advice():
    with pytest.raises(
        ResourceError, match=r"/dev/shm has 64 MB free, want 88 MB\. In Docker start with --shm-size=84m"
    ):
        check(FOOTPRINT, shm_free=64_000_000, memory_free=10**12)


def test_too_little_memory_is_refused_with_the_bill():
    with pytest.raises(ResourceError, match=r"memory: 1\.00 GB available, this run needs .*Lower --replay\.capacity"):
        check(FOOTPRINT, shm_free=10**12, memory_free=10**9)


def test_a_device_that_has_its_own_memory_must_hold_its_part_of_the_replay_and_the_learners_state():
    on_devices = dataclasses.replace(FOOTPRINT, replay_on_host=False, num_devices=2)
    assert on_devices.device_bytes == 1_000_000_000 + 4 * 20_000_000
    check(on_devices, shm_free=10**12, memory_free=10**12, device_free=1_080_000_000)
    with pytest.raises(
        ResourceError,
        match=r"^device memory: 1\.00 GB free, this run needs at least 1\.08 GB on each device \(replay 2\.00 GB "
        r"\(2 devices\), .*\)\. Lower --replay\.capacity, --actors\.num-actors or .*=0\.95\.$",
    ):
        check(on_devices, shm_free=10**12, memory_free=10**12, device_free=10**9)
    check(FOOTPRINT, shm_free=10**12, memory_free=10**12, device_free=0)  # its memory is the host's


def test_windows_of_rollouts_lie_on_the_host_and_are_what_a_checkpoint_keeps():
    on_policy = dataclasses.replace(FOOTPRINT, replay_bytes=1_000_000_000, rollouts_bytes=2_000_000_000)
    assert on_policy.memory_bytes - FOOTPRINT.memory_bytes == 1_000_000_000
    assert on_policy.snapshot_bytes == FOOTPRINT.snapshot_bytes
    on_device = dataclasses.replace(on_policy, replay_on_host=False)
    assert on_policy.memory_bytes - on_device.memory_bytes == 1_000_000_000
    assert on_device.device_bytes == 1_000_000_000 + 4 * 20_000_000
    assert on_device.lines()[0].startswith("rollouts 2.00 GB (host) and 1.00 GB (device), checkpoint copy 2.08 GB")
    with pytest.raises(ResourceError, match=r"Lower --learner\.rollout-steps, --actors\.num-actors or the frame size"):
        check(on_device, shm_free=10**12, memory_free=10**9)


def test_bytes_are_readable():
    assert [format_bytes(n) for n in (0, 999, 1500, 2_000_000, 3.25e9)] == ["0 B", "999 B", "2 kB", "2 MB", "3.25 GB"]
