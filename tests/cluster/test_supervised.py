"""A host as the learner knows it: in which order its batches are taken, and which are lost. Without a cluster."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from fake_env import config

from actors.pool import lanes_to_begin_with
from gvz.cluster.config import ClusterConfig
from gvz.cluster.supervised import Incarnation, SupervisedHost
from gvz.cluster.wire import Batch, BatchHeader
from gvz.core.errors import TransportError
from gvz.transport.messages import EpisodeStats, Message, StepBlock

CREDITS = 4


@pytest.fixture
def host(tmp_path) -> SupervisedHost:
    """It plays, and CREDITS calls are under way."""
    pool = config(tmp_path, {})
    found = SupervisedHost(2, pool, lanes_to_begin_with(pool, None), ClusterConfig(credits=CREDITS))
    begin(found)
    return found


def begin(host: SupervisedHost, *, playing_s: float | None = 0.0) -> None:
    remote: Any = None
    first = list(host.lanes.next_episodes)
    host.incarnation = Incarnation(
        number=0, machine="m", name="", remote=remote, first_episodes=first, heard_s=0.0, playing_s=playing_s
    )
    host.incarnation.num_asked = CREDITS


def taken(
    host: SupervisedHost,
    number: int,
    /,
    lanes: Sequence[int] = (),
    fields: dict[str, Any] | None = None,
    messages: Sequence[Message] = (),
    **changes: Any,
) -> list[int]:
    """The numbers of the batches that are taken after an answer with this one, which has a record of each of `lanes`
    with these `fields`, by default the first of an episode; `changes` are of its header.
    """
    life = host.incarnation
    assert life is not None
    life.num_asked -= 1
    steps = np.zeros(len(lanes), host.pool.record_dtype)
    for name, values in {"lane": lanes, "first": 1, **(fields or {})}.items():
        steps[name] = values
    block = StepBlock(steps, np.zeros((len(lanes), *host.pool.frame_shape), np.uint8))
    header = BatchHeader(**{"run_id": "r", "host": 2, "incarnation": 0, "number": number, **changes})
    found = host.in_order(Batch(header, list(messages), block), "r")
    for one in found:
        host.take(one)
    return [one.header.number for one in found]


def test_a_batch_that_comes_early_waits_for_those_before_it_and_keeps_its_credit(host):
    assert taken(host, 2) == []
    assert taken(host, 1) == []
    assert host.free_credits == 0, "two calls are under way, and two batches wait"
    assert taken(host, 0) == [0, 1, 2]
    assert host.free_credits == CREDITS - 1
    assert taken(host, 3) == [3]


def test_a_batch_is_lost_when_no_call_is_left_that_could_bring_it(host):
    assert taken(host, 1) == taken(host, 2) == taken(host, 3) == []
    with pytest.raises(TransportError, match=r"got batch \('r', 2, 0, 4\) .*, want \('r', 2, 0, 0\); a batch was lost"):
        taken(host, 4)
    host.incarnation.early.clear()
    host.incarnation.num_asked += 1
    with pytest.raises(TransportError, match="a batch was lost"):
        taken(host, 1)


@pytest.mark.parametrize("changes", [{"run_id": "other"}, {"host": 1}, {"incarnation": 1}])
def test_a_batch_of_others_is_refused(host, changes):
    with pytest.raises(TransportError, match=r"want \('r', 2, 0, 0\)"):
        taken(host, 0, **changes)


def test_a_batch_that_was_taken_is_refused(host):
    assert taken(host, 0) == [0]
    with pytest.raises(TransportError, match=r"want \('r', 2, 0, 1\)"):
        taken(host, 0)


def episode_end(lane: int, task: int, episode: int) -> EpisodeStats:
    return EpisodeStats(
        lane=lane, task=task, episode=episode, seed=0, score=0.0, reward=0.0, reward_components={}, length_frames=4,
        length_steps=1, params_version=0, terminated=True, truncated=False,
    )  # fmt: skip


def test_the_next_life_of_a_host_plays_new_episodes_and_those_that_were_cut_are_counted(host):
    fields = {"episode": [4, 6, 6, 7, 2], "terminated": [0, 0, 1, 0, 0], "truncated": [0, 0, 0, 0, 1]}
    taken(host, 0, [0, 1, 1, 1, 2], fields, [episode_end(2, 0, 8)], restarts=3, waited_for_space_s=1.5)
    assert host.lanes.next_episodes == [5, 8, 9, 0]
    assert host.end(9.0) == 2, "lanes 0 and 1 were in the middle of an episode"
    assert host.lanes.next_episodes == [5, 8, 9, 1], "the seed of lane 3 may be what its engine cannot start with"
    begin(host)
    taken(host, 0, [2], {"episode": 9}, restarts=2, waited_for_space_s=0.5)
    assert host.end(9.0) == 1
    assert (host.actor_restarts, host.waited_for_space_s, host.avoid) == (5, 2.0, "m")
    begin(host, playing_s=None)
    host.end(9.0)
    assert host.lanes.next_episodes == [6, 9, 10, 2], "a host that never played has used no episode"


def test_a_host_that_does_not_stay_up_is_started_later_each_time(host):
    waits = []
    for playing_s in (0.0, 0.0, None, *[0.0] * 1100, -1.0):
        host.incarnation.playing_s = playing_s
        host.end(10.0)
        waits.append(host.start_at_s - 10.0)
        begin(host)
    assert waits[:7] == [1.0, 2.0, 4.0, 8.0, 16.0, 30.0, 30.0]
    assert waits[-2:] == [30.0, 0.5], "the last one has played for 11 s"


@pytest.mark.parametrize(
    ("lanes", "fields", "messages", "text"),
    [
        ([0], {"params_version": 6}, [], "got actions of parameters version 6, but it was given 5"),
        ([0, 4], {}, [], r"got records of lane 0\.\.4, want 0\.\.3"),
        ([0], {"task": 2}, [], r"got records of task 2\.\.2, want 0\.\.1"),
        ([0, 1], {"action": [-1, 5]}, [], r"got records of action -1\.\.5, want 0\.\.4"),
        ([0, 2], {"first": 0}, [], "of lane 2 that neither begins an episode nor continues one"),
        ([0, 0], {"first": 0, "terminated": 1}, [], "of lane 0 that neither begins"),
        ([3, 3], {"first": [0, 1]}, [], "of lane 3 that neither begins"),
        ([1, 0], {}, [], "not sorted by lane"),
        ([0], {"reward": np.nan}, [], "got a reward that is not finite"),
        ([], {}, [episode_end(4, 0, 0)], "got an episode of lane 4, task 0"),
        ([], {}, [episode_end(0, 2, 0)], "got an episode of lane 0, task 2"),
    ],
)
def test_a_batch_of_what_a_host_cannot_have_played_is_refused(host, lanes, fields, messages, text):
    host.incarnation.params_version = 5
    begun = {"params_version": 5, "task": 1, "terminated": [0, 1]}
    assert taken(host, 0, [0, 3], begun, [episode_end(3, 1, 0)]) == [0]
    with pytest.raises(TransportError, match=text):
        taken(host, 1, lanes, fields, messages)
