"""Actors that ask for their actions: what they play, and what a fault of either side costs."""

import os
import signal
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from fake_env import config
from watched_pool import DEADLINE_S, Run, alive, segments

from actors import inference, supervisor
from actors.config import ActorsConfig
from actors.inline import InlinePool
from actors.pool import PoolConfig
from actors.process_pool import ProcessPool
from gvz.core.errors import WaitTimeoutError, WorkerError
from gvz.transport.messages import ParamsHeader, StepBlock
from gvz.transport.ring import WriterState


class FramePolicy:
    """Plays what it sees: seed of the episode + decisions since it began + last action + task, and notes that sum."""

    def __init__(self, seed: int = 0):
        self.seed = seed
        self.num_calls, self.params_version, self.version = 0, 0, 0
        self.sizes: list[int] = []
        self.may_go_on = threading.Event()
        self.may_go_on.set()

    def set_params(self, params: np.ndarray, header: ParamsHeader) -> None:
        assert (params == header.version).all()
        self.version = header.version

    def act(self, obs: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        assert self.may_go_on.wait(DEADLINE_S)
        self.sizes.append(len(obs["task"]))
        newest = np.ascontiguousarray(obs["frames"][..., -3:]).reshape(len(obs["task"]), -1)
        seed, steps = newest[:, :4].view(np.uint32)[:, 0], newest[:, 4:8].view(np.uint32)[:, 0]
        seen = seed.astype(np.int64) % 1000 + steps + obs["actions"][:, 0] + obs["task"]
        self.num_calls += 1
        self.params_version = self.version
        return (seen % 5).astype(np.int32), seen.astype(np.float32)[:, None]


def asking(work_dir: Path, options: dict[str, Any] | None = None, **changes: Any) -> PoolConfig:
    actors = ActorsConfig(inference="device", heartbeat_timeout_s=5.0)
    return config(work_dir, options or {}, **{"actors": actors, "past_actions": 1, "num_extras": 1, **changes})


class AskingRun(Run):
    """As `Run`; every record must have the action that `FramePolicy` chooses for its own frame."""

    def __init__(self, pool: ProcessPool, pool_config: PoolConfig):
        super().__init__(pool, pool_config)
        self.versions: set[int] = set()
        add, last = self.checker.add, dict[int, np.void]()

        def check(blocks: list[StepBlock]) -> None:
            add(blocks)
            for block in blocks:
                for step, frame in zip(block.steps, block.frames, strict=True):
                    seed, steps = frame.reshape(-1)[:8].view(np.uint32).tolist()
                    before = -1 if step["first"] else int(last[int(step["lane"])]["action"])
                    seen = seed % 1000 + steps + before + int(step["task"])
                    assert step["extras"] == [seen]
                    assert int(step["action"]) == (0 if step["terminated"] else seen % 5)
                    last[int(step["lane"])] = step
                    self.versions.add(int(step["params_version"]))

        self.checker.add = check


def publish(pool: ProcessPool, version: int = 1) -> None:
    pool.publish(np.full(3, version, np.float32), ParamsHeader(version=version, num_updates=0))


def test_every_game_gets_the_action_for_its_own_observation(tmp_path: Path):
    policy, pool_config = FramePolicy(), asking(tmp_path, num_actors=3)
    with ProcessPool(pool_config, None, lambda _: policy) as pool:
        run = AskingRun(pool, pool_config)
        assert sum(segments().values()) == pool_config.shared_memory_bytes() + 6 * 64
        run.until(lambda: pool.statistics().actors_ready == 3)
        assert run.checker.num_records == 0, "nobody acts before there are parameters"
        for version in (1, 2, 3):
            publish(pool, version)
            run.until(lambda version=version: version in run.versions)
        run.play(1000)
        assert pool.statistics().restarts == 0
    assert run.versions == {1, 2, 3}
    assert run.checker.num_cuts == 0
    assert policy.sizes[:3] == [2, 4, 6], "every size is compiled before the first answer"
    assert set(policy.sizes[3:]) <= {2, 4, 6}
    assert "inference" not in {thread.name for thread in threading.enumerate()}


def test_requests_that_come_while_the_policy_is_busy_are_answered_together(tmp_path: Path):
    policy, pool_config = FramePolicy(), asking(tmp_path, num_actors=3)
    with ProcessPool(pool_config, None, lambda _: policy) as pool:
        run = AskingRun(pool, pool_config)
        publish(pool)
        run.until(lambda: pool.statistics().actors_ready == 3)
        run.play(100)
        requests = [actor.requests for actor in pool._actors if actor.requests is not None]
        policy.may_go_on.clear()
        run.until(lambda: [one.pending() is not None for one in requests] == [True] * 3)
        answered = len(policy.sizes)
        policy.may_go_on.set()
        run.play(100)
        assert max(policy.sizes[answered : answered + 2]) >= 4, "two of the three in one batch: under way, or the next"


def test_killed_actors_are_replaced_also_while_they_wait(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(supervisor, "_STABLE_S", 0.0)  # no waiting: this actor is not to blame
    policy, pool_config = FramePolicy(), asking(tmp_path)
    with ProcessPool(pool_config, None, lambda _: policy) as pool:
        run = AskingRun(pool, pool_config)
        publish(pool)
        run.until_all_ready()
        me = psutil.Process()
        before = (me.num_fds(), len(segments()))
        for kill in range(3):
            if kill == 1:  # it waits for an answer, which comes when its successor is there
                policy.may_go_on.clear()
                run.until(lambda: {s.state for s in pool.writer_statuses()} == {WriterState.WAITING_FOR_ACTIONS})
            os.kill(pool.writer_statuses()[kill % 2].pid, signal.SIGKILL)
            run.until(lambda wanted=kill + 1: pool.statistics().restarts == wanted)
            run.until_all_ready()
            policy.may_go_on.set()
            run.play(200)
        assert (me.num_fds(), len(segments())) == before
    assert {fault.kind for fault in run.faults()} == {"died"}


def test_an_actor_that_waits_for_its_actions_hears_of_the_end(tmp_path: Path):
    pool_config = asking(tmp_path)
    with ProcessPool(pool_config, None, FramePolicy) as pool:
        pids = Run(pool, pool_config).until_all_ready()
        assert pool.drain(100) == [], "no parameters were published"
        start = time.monotonic()
        pool.close(grace_s=60.0)
        assert time.monotonic() - start < 50, "nobody was ended by a signal"
    assert not any(alive(pid) for pid in pids)
    assert not segments()


def test_what_goes_wrong_in_choosing_actions_ends_the_learners_loop(tmp_path: Path):
    class Broken(FramePolicy):
        def act(self, obs: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
            raise RuntimeError("out of memory on the device")

    with ProcessPool(asking(tmp_path), None, Broken) as pool:
        publish(pool)
        said = "choosing the actors' actions failed: RuntimeError: out of memory on the device"
        with pytest.raises(WorkerError, match=said) as raised:  # at which a run saves itself
            Run(pool, asking(tmp_path)).until(lambda: False)
        assert isinstance(raised.value.__cause__, RuntimeError)


def test_a_pool_that_was_closed_at_once_never_waits_for_the_device(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """As after a second Ctrl-C, where a run closes its pool at once, and then once more in order."""
    monkeypatch.setattr(inference, "_STOP_TIMEOUT_S", 0.0)
    policy = FramePolicy()
    policy.may_go_on.clear()
    try:
        pool = ProcessPool(asking(tmp_path, num_actors=1), None, lambda _: policy)
        publish(pool)
        pool.close(grace_s=0.0)
        pool.close()
        pool = ProcessPool(asking(tmp_path, num_actors=1), None, lambda _: policy)
        publish(pool)
        with pytest.raises(WaitTimeoutError, match="for its device to choose"):
            pool.close()
    finally:
        policy.may_go_on.set()


def test_choices_of_a_resumed_pool_have_another_seed(tmp_path: Path):
    seeds = []
    for episodes in ([0, 0, 0, 0], [3, 0, 0, 0], [3, 0, 0, 0]):
        state = {"next_episodes": episodes, "tasks": [0, 1, 0, 1]}
        ProcessPool(asking(tmp_path), state, lambda seed: FramePolicy(seeds.append(seed) or 0)).close(grace_s=0.0)
    assert seeds[0] != seeds[1] == seeds[2]


def test_a_pool_needs_a_policy_exactly_if_its_actors_ask(tmp_path: Path):
    with pytest.raises(ValueError, match=r"make_policy: got None for actors\.inference 'device'"):
        ProcessPool(asking(tmp_path))
    with pytest.raises(ValueError, match=r"for actors\.inference 'actors'"):
        ProcessPool(config(tmp_path, {}), None, FramePolicy)
    with pytest.raises(ValueError, match=r"actors\.inference: got 'device', want 'actors'"):
        InlinePool(asking(tmp_path, num_actors=1))
