"""A supervised actor whose process is made up: what its budget, its patience and its waits are counted from."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from fake_env import config

from actors import supervisor
from actors.config import ActorsConfig
from actors.pool import lanes_to_begin_with
from actors.supervisor import SupervisedActor
from gvz.core.errors import WaitTimeoutError
from gvz.transport import child
from gvz.transport.messages import EpisodeStats, Fault, Message, Ready
from gvz.transport.ring import WriterState, WriterStatus


class Process:
    """What `start_actor` gives, and its channel."""

    def __init__(self):
        self.said: list[Message] = []
        self.exit: str | None = None
        self.dumped = False
        self.channel = self

    def receive(self) -> list[Message]:
        said, self.said = self.said, []
        return said

    def exit_text(self) -> str | None:
        return self.exit

    def dump_stacks(self) -> None:
        self.dumped = True

    def end(self, *, grace_s: float) -> None:
        del grace_s


@pytest.fixture
def actor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[SupervisedActor]:
    monkeypatch.setattr(supervisor, "start_actor", lambda *_: Process())
    limits = ActorsConfig(max_restarts=1, restart_window_s=100.0, heartbeat_timeout_s=30.0, start_timeout_s=120.0)
    pool = config(tmp_path, {}, num_actors=1, actors=limits)
    (spec,) = pool.actor_specs(lanes_to_begin_with(pool, None))
    supervised = SupervisedActor(spec, limits, None)
    supervised.start()
    yield supervised
    supervised.free()


def get_ready(actor: SupervisedActor, now: float) -> None:
    actor.process.said.append(Ready(actor=0, pid=1))
    actor.watch(now, 0.0)


def end(actor: SupervisedActor, now: float) -> Fault:
    actor.process.exit = "exited with code 1"
    (fault,) = actor.watch(now, 0.0)
    return fault


def test_what_an_actor_says_just_before_its_end_is_heard(actor: SupervisedActor):
    get_ready(actor, 0.0)
    process, hear = actor.process, actor.process.receive

    def hear_and_end() -> list[Message]:
        heard = hear()
        if process.exit is None:
            process.said.append(Fault(actor=0, lane=None, kind="exception", message="its last words"))
            process.exit = "exited with code 1"
        return heard

    process.receive = hear_and_end
    messages = [message for now in (1.0, 2.0) for message in actor.watch(now, 0.0)]
    assert [message.kind for message in messages if isinstance(message, Fault)] == ["exception", "died"]


def test_an_end_counts_only_within_the_window(actor: SupervisedActor):
    for now in (0.0, 150.0, 300.0):
        get_ready(actor, now)
        assert end(actor, now + 50.0).kind == "died"
        actor.start()
    get_ready(actor, 350.0)
    assert "that was end 2 within 100 s" in end(actor, 400.0).message


def test_starts_that_fail_count_however_long_they_take(actor: SupervisedActor):
    assert end(actor, 0.0).kind == "died"
    actor.start()
    fault = end(actor, 135.0)
    assert fault.kind == "gave_up"
    assert "that was end 2 within 135 s, and actors.max_restarts allows 1 restarts" in fault.message


def test_an_actor_that_starts_an_engine_in_mid_run_is_given_the_time_of_a_start(actor: SupervisedActor):
    get_ready(actor, 0.0)
    process, writer = actor.process, actor.ring.writer()
    for state, silence_s, is_stuck in ((WriterState.RESETTING, 99.0, False), (WriterState.ACTING, 31.0, True)):
        writer.beat(state)
        actor.watch(0.0, 1.0)
        actor.watch(0.0, silence_s)
        assert process.dumped == is_stuck


def test_after_a_stable_life_the_next_start_comes_soon(actor: SupervisedActor):
    assert end(actor, 0.0).message.endswith("in 0.50 s")
    for begin, lived_s, wait in ((200.0, 5.0, "1.00 s"), (400.0, 15.0, "0.25 s")):
        actor.start()
        get_ready(actor, begin)
        assert end(actor, begin + lived_s).message.endswith(f"in {wait}")


def test_an_actor_that_soon_dies_each_time_is_started_again_for_days(
    actor: SupervisedActor, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(supervisor.janitor, "clean_dead_instances", list)  # it takes milliseconds
    for number in range(1100):
        get_ready(actor, 1000.0 * number)
        fault = end(actor, 1000.0 * number)
        actor.start()
    assert fault.message.endswith("restart 1 of 1 in 15.00 s")


def test_a_new_process_is_given_the_time_of_a_start_whatever_its_predecessor_did(actor: SupervisedActor):
    get_ready(actor, 0.0)
    actor.watch(0.0, 31.0)
    (fault,) = actor.watch(1.0, 0.0)
    assert fault.kind == "stuck"
    actor.start()
    assert not actor.ready
    assert actor.watch(2.0, 119.0) == []
    assert not actor.process.dumped
    actor.watch(3.0, 2.0)
    assert actor.process.dumped


def test_an_episode_of_no_task_of_the_run_is_a_fault(actor: SupervisedActor):
    stats = EpisodeStats(
        lane=0, task=2, episode=0, seed=0, score=0.0, reward=0.0, reward_components={}, length_frames=4, length_steps=1,
        params_version=0, terminated=True, truncated=False,
    )  # fmt: skip
    actor.process.said.append(stats)
    (fault,) = actor.watch(0.0, 0.0)
    assert "got an episode of lane 0, task 2, want one of lanes [0, 1] and a task below 2" in fault.message


def test_a_process_that_hangs_in_the_kernel_leaves_no_other_running():
    class Stopped(Process):
        closed, ended = True, False

        def wait(self, timeout_s: float) -> bool:
            return timeout_s > 0

        def end(self, *, grace_s: float) -> None:
            self.ended = True
            if self.exit is not None:
                raise WaitTimeoutError(self.exit)

    first, hanging, last = (Stopped() for _ in range(3))
    hanging.exit = "it hangs in the kernel"
    with pytest.raises(WaitTimeoutError, match="it hangs in the kernel"):
        child.end_all([first, hanging, last], 0.0)
    assert first.ended
    assert last.ended


def test_an_actor_that_ends_a_long_reset_while_it_is_looked_at_is_not_stuck(
    actor: SupervisedActor, monkeypatch: pytest.MonkeyPatch
):
    get_ready(actor, 0.0)
    writer, look = actor.ring.writer(), actor.ring.writer_status
    writer.beat(WriterState.RESETTING)
    actor.watch(0.0, 1.0)

    def look_and_act() -> WriterStatus:
        status = look()
        writer.beat(WriterState.ACTING)
        return status

    monkeypatch.setattr(actor.ring, "writer_status", look_and_act)
    actor.watch(0.0, 99.0)
    actor.watch(0.0, 29.0)
    assert not actor.process.dumped
