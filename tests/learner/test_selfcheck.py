"""The self-check passes where the learner is right, on every instruction set (`make test-isa`), and only there."""

import json
from dataclasses import replace

import pytest

from learner import selfcheck

pytestmark = pytest.mark.isa
RECORDED = json.loads(selfcheck.RECORD.read_text())


@pytest.fixture(scope="module")
def found() -> dict[str, list[float]]:
    return selfcheck.run()


def test_this_learner_computes_what_is_recorded(found, record_property):
    largest = selfcheck.check(found, RECORDED)
    record_property("largest difference", largest)
    assert largest < selfcheck.TOLERANCE


def test_a_learner_whose_target_is_another_one_fails():
    """Without double Q-learning only the action in the target changes: the smallest of Rainbow's parts."""
    with pytest.raises(ValueError, match=r"self-check: \w+ .*of update \d+ is .*, want .*, the recorded number"):
        selfcheck.check(selfcheck.run(replace(selfcheck.AGENT, double=False)), RECORDED)


@pytest.mark.parametrize("name", sorted(RECORDED))
@pytest.mark.parametrize("wrong", [1 + 3 * selfcheck.TOLERANCE, 1 - 3 * selfcheck.TOLERANCE, float("nan")])
def test_every_number_of_every_update_is_compared(found, name: str, wrong: float):
    for update in range(selfcheck.NUM_UPDATES):
        numbers = list(found[name])
        numbers[update] *= wrong
        with pytest.raises(ValueError, match=f"self-check: {name} of update {update + 1} is"):
            selfcheck.check(found | {name: numbers}, RECORDED)
