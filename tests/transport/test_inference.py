"""Requests for actions: an answer is that of the request, whoever asked before."""

from collections.abc import Iterator

import numpy as np
import pytest

from gvz.core.errors import TransportError, WaitTimeoutError
from gvz.transport.inference import Answer, RequestReader, RequestWriter, request_bytes
from tests.waiting import make_pause

OBSERVATION = {
    "frames": np.empty((2, 4, 5, 6), np.uint8),
    "vector": np.empty((2, 0), np.float32),
    "task": np.empty(2, np.int32),
    "mask": np.empty((2, 3), bool),
}


@pytest.fixture
def learner() -> Iterator[RequestReader]:
    requests = RequestReader.create("gvz-test", OBSERVATION, 1)
    yield requests
    requests.close()


def attach(learner: RequestReader) -> RequestWriter:
    return RequestWriter.attach(learner.descriptor, OBSERVATION, 1)


def answer(value: int) -> Answer:
    return Answer(np.full(2, value, np.int32), np.full((2, 1), value / 2, np.float32), value * 3)


def wait(actor: RequestWriter, timeout_s: float = 10.0, *, cancelled: bool = False) -> bool:
    return actor.wait(timeout_s, beat=lambda: None, cancelled=lambda: cancelled)


def test_what_one_side_writes_the_other_reads(learner: RequestReader):
    actor, answers = attach(learner), []
    assert learner.pending() is None
    for value in (1, 2, 3):
        for part in actor.observation.values():
            part[...] = value
        actor.ask()
        number = learner.pending()
        assert number is not None
        for name, part in OBSERVATION.items():
            got = learner.observation[name]
            assert (got.dtype, got.shape) == (part.dtype, part.shape)
            assert (got == np.full_like(part, value)).all()
        learner.answer(number, answer(value))
        assert learner.pending() is None
        assert wait(actor)
        answers.append(actor.answer())
    for value, (action, extras, version) in zip((1, 2, 3), answers, strict=True):
        assert (action.tolist(), extras.tolist(), version) == ([value] * 2, [[value / 2]] * 2, value * 3)


def test_an_answer_is_whole_when_the_actor_sees_it(learner: RequestReader, monkeypatch: pytest.MonkeyPatch):
    actor, answered = attach(learner), []
    actor.ask()
    number = learner.pending()
    assert number is not None

    def look() -> None:
        answered.append((wait(actor, cancelled=True), actor.answer().action.tolist()))

    monkeypatch.setattr(learner, "_fence", look)
    learner.answer(number, answer(7))
    assert answered == [(False, [7, 7])], "what it says, and then its number"


@pytest.mark.parametrize("answered_late", [False, True])
def test_an_answer_to_a_dead_actor_is_none_to_its_successor(learner: RequestReader, answered_late: bool):
    attach(learner).ask()
    old = learner.pending()
    assert old is not None
    if not answered_late:
        learner.answer(old, answer(1))
    successor = attach(learner)
    successor.ask()
    if answered_late:
        learner.answer(old, answer(1))
    assert not wait(successor, cancelled=True)
    number = learner.pending()
    assert number not in (None, old)
    learner.answer(number, answer(2))
    assert wait(successor)
    assert successor.answer().action.tolist() == [2, 2]


def test_numbers_of_requests_go_round(learner: RequestReader):
    actor = attach(learner)
    actor._words[0] = actor._words[8] = 2**64 - 1
    actor.ask()
    assert learner.pending() == 0
    assert not wait(actor, cancelled=True)
    learner.answer(0, answer(3))
    assert wait(actor)


def test_waiting_has_an_end_and_a_heartbeat(learner: RequestReader):
    actor, beats = attach(learner), []
    actor.ask()
    with pytest.raises(WaitTimeoutError, match="gvz-test: the actor waited 0 s for the learner to choose its actions"):
        actor.wait(0.02, beat=lambda: beats.append(1), cancelled=lambda: False)
    assert len(beats) > 2


def test_time_in_which_the_actor_was_stopped_is_no_time_of_waiting(
    learner: RequestReader, monkeypatch: pytest.MonkeyPatch
):
    actor, pause, beats = attach(learner), make_pause(monkeypatch), []
    actor.ask()
    number = learner.pending()
    assert number is not None

    def stopped_once() -> None:
        beats.append(1)
        if len(beats) == 2:
            pause(7200)
        elif len(beats) == 4:
            learner.answer(number, answer(1))

    assert actor.wait(3600, beat=stopped_once, cancelled=lambda: False)


def test_observations_of_another_shape_are_refused(learner: RequestReader):
    with pytest.raises(TransportError, match="got layout hash"):
        RequestWriter.attach(learner.descriptor, {**OBSERVATION, "task": np.empty(2, np.uint32)}, 1)


def test_every_array_begins_at_a_cache_line():
    """Words 128 bytes; frames 240, vector 0, task 8, mask 6, action 8, extras 8, each rounded up to 64."""
    assert request_bytes(OBSERVATION, 1) == 128 + 256 + 0 + 64 + 64 + 64 + 64
