"""A host as the learner knows it: in which order its batches are taken, and which are lost. Without a cluster."""

from typing import Any

import pytest
from fake_env import config

from actors.pool import lanes_to_begin_with
from gvz.cluster.config import ClusterConfig
from gvz.cluster.supervised import Incarnation, SupervisedHost
from gvz.cluster.wire import Batch, BatchHeader, pack, unpack
from gvz.core.errors import TransportError

CREDITS = 4


@pytest.fixture
def host(tmp_path) -> SupervisedHost:
    """It plays, and CREDITS calls are under way."""
    pool = config(tmp_path, {})
    found = SupervisedHost(2, pool, lanes_to_begin_with(pool, None), ClusterConfig(credits=CREDITS))
    remote: Any = None
    found.incarnation = Incarnation(
        number=0, machine="", name="", remote=remote, first_episodes=[0] * 4, heard_s=0.0, playing_s=0.0
    )
    found.incarnation.asked.extend(range(CREDITS))
    return found


def taken(host: SupervisedHost, number: int, /, **changes: Any) -> list[int]:
    """The numbers of the batches that are taken after an answer with this one."""
    life = host.incarnation
    assert life is not None
    life.asked.popleft()
    header = BatchHeader(**{"run_id": "r", "host": 2, "incarnation": 0, "number": number, **changes})
    batch: Batch = unpack(pack(header, [], [], compress=False), host.pool.record_dtype, host.pool.frame_shape, 100)
    found = host.in_order(batch, "r")
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
    host.incarnation.asked.append(0)
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
