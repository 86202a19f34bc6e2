"""Rollouts against a slow oracle: windows, stacks, ends, cuts, returns; lanes of different speeds; checkpoints."""

import dataclasses
from dataclasses import dataclass, field

import jax
import numpy as np
import pytest

from gvz.transport.messages import StepBlock, step_dtype
from learner import store
from learner.agents.base import AgentSpec, make_agent
from learner.agents.configs.ppo import PPOConfig
from learner.rollouts import Rollouts, RolloutSpec, array_shapes, memory_bytes, steps_of

LANES, T, STACK, PAST, GAMMA, LAMBDA = 3, 5, 3, 4, 0.9, 0.8
SCALES = (1.0, 0.25)
"""of the rewards of the two tasks"""
HISTORY = max(STACK, PAST + 1)
SPEC = RolloutSpec(
    num_lanes=LANES,
    capacity=LANES * (HISTORY + T),
    frame_shape=(2, 2, 1),
    num_tasks=2,
    stack_size=STACK,
    num_past_actions=PAST,
    num_variables=1,
    num_extras=2,
    reward_scales=SCALES,
)
DTYPE = step_dtype(1, 2)


@dataclass
class Stream:
    """A lane's records as the oracle keeps them: plain lists, nothing shared with the learner."""

    rng: np.random.Generator
    lane: int
    records: list[dict] = field(default_factory=list)

    def next(self) -> dict:
        """Episodes terminate, time out, or break off without a last record."""
        before = self.records[-1] if self.records else None
        first = before is None or before["last"] or self.rng.random() < 0.1
        if before is not None and first and not before["last"]:
            before["last"] = before["cut"] = True
        end = "" if first else self.rng.choice(["terminated", "truncated", ""], p=[0.15, 0.1, 0.75])
        record = {
            "frame": self.rng.integers(0, 256, (2, 2, 1), dtype=np.uint8),
            "action": int(self.rng.integers(0, 3)),
            "reward": 0.0 if first else float(np.float32(self.rng.normal())),
            "task": self.lane % 2,
            "first": first,
            "terminated": end == "terminated",
            "last": end != "",
            "cut": False,
            "variable": float(np.float32(self.rng.normal())),
            "value": float(np.float32(self.rng.normal())),
            "version": len(self.records) // 4,
        }
        self.records.append(record)
        return record


def block(*lanes_and_records: tuple[int, dict]) -> StepBlock:
    steps = np.zeros(len(lanes_and_records), DTYPE)
    for step, (lane, record) in zip(steps, lanes_and_records, strict=True):
        for name in ("action", "reward", "task", "first", "terminated"):
            step[name] = record[name]
        step["truncated"] = record["last"] and not record["terminated"] and not record["cut"]
        step["lane"], step["params_version"] = lane, record["version"]
        step["vector"], step["extras"] = record["variable"], (record["value"], -1.0)
    frames = np.stack([record["frame"] for _, record in lanes_and_records])
    return StepBlock(steps, frames)


def expected_observation(records: list[dict], t: int) -> tuple[np.ndarray, list[int]]:
    """Stack and past actions of record t, by walking back to the episode's first record."""
    begin = t
    while not records[begin]["first"]:
        begin -= 1
    stack = [records[max(begin, t - back)]["frame"] for back in reversed(range(STACK))]
    past = [records[t - back]["action"] if t - back >= begin else -1 for back in range(PAST, 0, -1)]
    return np.concatenate(stack, axis=-1), past


def expected_return(records: list[dict], t: int, end: int) -> float:
    """The lambda return of the step from record t, recursively, in float64; `end` is the window's last record."""
    after = records[t + 1]
    reward = after["reward"] * SCALES[after["task"]]
    if after["terminated"]:
        return reward
    if after["last"] or t + 1 == end:
        return reward + GAMMA * after["value"]
    rest = expected_return(records, t + 1, end)
    return reward + GAMMA * ((1 - LAMBDA) * after["value"] + LAMBDA * rest)


AGENT = make_agent(
    PPOConfig(conv_channels=(2,), conv_kernels=(1,), conv_strides=(1,), discount=GAMMA, td_lambda=LAMBDA),
    AgentSpec(obs_shape=(2, 2, STACK), num_actions=3, num_tasks=2, v_min=-1.0, v_max=1.0),
)


@jax.jit
def on_device(windows: store.Store):
    steps, slots = steps_of(SPEC, windows)
    return slots, AGENT.targets(steps), store.observations(SPEC, windows, slots.ravel())


def check_rollout(rollouts: Rollouts, streams: list[Stream], windows_done: dict[int, int]) -> list[int]:
    """Takes a rollout and compares every number of it; returns the lanes of its windows."""
    wanted, newest = [], 1000
    for row in rollouts.state()["complete"]:
        lane = int(rollouts._steps["lane"][row, -1])
        wanted.append((lane, windows_done[lane] * T))
        windows_done[lane] += 1
    rollout = rollouts.take(newest)
    slots, targets, obs = on_device(rollout.windows)
    frames, past = (np.asarray(x).reshape(T, LANES, *x.shape[1:]) for x in (obs.frames, obs.actions))
    ages = []
    for b, (lane, start) in enumerate(wanted):
        records = streams[lane].records
        for t in range(T):
            record, slot = records[start + t], int(slots[t, b])
            assert bool(rollout.windows.last[slot]) == record["last"]
            assert int(rollout.windows.action[slot]) == record["action"]
            stack, actions = expected_observation(records, start + t)
            np.testing.assert_array_equal(frames[t, b], stack)
            assert past[t, b].tolist() == actions
            if not record["last"]:
                ages.append(newest - record["version"])
                wanted_return = expected_return(records, start + t, start + T)
                np.testing.assert_allclose(targets.returns[t, b], wanted_return, rtol=1e-5, atol=1e-6)
                advantage = wanted_return - record["value"]
                np.testing.assert_allclose(targets.advantages[t, b], advantage, rtol=1e-5, atol=1e-6)
    assert sorted(rollout.ages.tolist()) == sorted(ages)
    return [lane for lane, _ in wanted]


@pytest.mark.parametrize("seed", range(3))
def test_every_number_of_a_rollout_is_the_slow_oracles(seed: int):
    """Lanes are fed in step, then at random; the records after a window may end or cut its last episode."""
    rng = np.random.default_rng(seed)
    streams, rollouts = [Stream(rng, lane) for lane in range(LANES)], Rollouts(SPEC)
    done, uneven = dict.fromkeys(range(LANES), 0), False
    for taken in range(12):
        while rollouts.num_missing:
            number = int(rng.integers(1, rollouts.num_records_allowed() + 1))
            lanes = rng.choice(LANES, number, p=[0.1, 0.3, 0.6]) if taken > 3 else np.arange(number) % LANES
            rollouts.add([block((int(lane), streams[lane].next())) for lane in lanes])
        assert rollouts.num_records_allowed() == 0
        uneven |= len(set(check_rollout(rollouts, streams, done))) < LANES
    assert uneven, "a fast lane has more than one window of some rollout"


def in_step(rollouts: Rollouts, streams: list[Stream], num_rounds: int) -> None:
    for _ in range(num_rounds):
        rollouts.add([block(*((stream.lane, stream.next()) for stream in streams))])


def test_lanes_in_step_give_one_window_each_and_no_record_more():
    streams, rollouts = [Stream(np.random.default_rng(0), lane) for lane in range(LANES)], Rollouts(SPEC)
    done = dict.fromkeys(range(LANES), 0)
    in_step(rollouts, streams, T)
    assert rollouts.num_records_allowed() == LANES, "one record more ends the step of the first window"
    for _ in range(3):
        in_step(rollouts, streams, 1)
        assert check_rollout(rollouts, streams, done) == list(range(LANES))
        assert rollouts.num_records_allowed() == LANES * T
        in_step(rollouts, streams, T - 1)


def test_one_lane_alone_makes_a_rollout():
    """The actors of all other lanes are dead."""
    streams, rollouts = [Stream(np.random.default_rng(0), lane) for lane in range(LANES)], Rollouts(SPEC)
    while rollouts.num_missing:
        for _ in range(rollouts.num_records_allowed()):
            rollouts.add([block((1, streams[1].next()))])
    assert check_rollout(rollouts, streams, dict.fromkeys(range(LANES), 0)) == [1] * LANES
    assert len(streams[1].records) == LANES * T + 1


def test_an_incomplete_rollout_is_refused():
    with pytest.raises(ValueError, match=r"Rollouts\.take: 3 of 3 windows are not complete"):
        Rollouts(SPEC).take(0)


def test_a_restored_rollout_goes_on_where_it_was():
    streams, rollouts = [Stream(np.random.default_rng(0), lane) for lane in range(LANES)], Rollouts(SPEC)
    in_step(rollouts, streams, T + 1)
    rollouts.take(9)
    in_step(rollouts, streams, 2)
    rollouts.add([block((0, streams[0].next()))])
    arrays = {name: array.copy() for name, array in rollouts.arrays().items()}
    other = Rollouts(SPEC)
    other.restore(arrays, rollouts.state())
    while rollouts.num_missing:
        records = block(*((stream.lane, stream.next()) for stream in streams[: rollouts.num_records_allowed()]))
        for one in (rollouts, other):
            one.add([records])
    for mine, theirs in zip(jax.tree.leaves(rollouts.take(9)), jax.tree.leaves(other.take(9)), strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_sizes_are_known_before_there_are_windows():
    arrays = Rollouts(SPEC).arrays()
    assert {name: (array.shape, array.dtype) for name, array in arrays.items()} == {
        name: (array.shape, array.dtype) for name, array in array_shapes(SPEC).items()
    }
    assert memory_bytes(SPEC) == sum(array.nbytes for array in arrays.values())
    huge = dataclasses.replace(SPEC, capacity=2**50)
    assert memory_bytes(huge) > 2**50


def test_the_fill_falls_when_a_rollout_is_taken():
    streams, rollouts = [Stream(np.random.default_rng(0), lane) for lane in range(LANES)], Rollouts(SPEC)
    windows, slots = SPEC.num_windows, SPEC.lane_capacity
    assert rollouts.fill_share() == LANES * (HISTORY - 1) / (windows * slots)
    in_step(rollouts, streams, T + 1)
    assert rollouts.fill_share() == (LANES * slots + LANES * HISTORY) / (windows * slots)
    rollouts.take(9)
    assert rollouts.fill_share() == LANES * HISTORY / (windows * slots)
