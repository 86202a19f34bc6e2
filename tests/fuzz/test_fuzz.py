"""Every parser under some hundred damaged inputs each, the same ones every time. `make fuzz` is the long form."""

import itertools
import random
from pathlib import Path

import pytest

from tests.fuzz.mutate import inputs
from tests.fuzz.target import attempt
from tests.fuzz.targets import TARGETS, make_target

ALWAYS_TAKEN = {"decorate"}
"""text without classes is DECORATE text, too"""


@pytest.mark.parametrize("name", TARGETS)
def test_every_input_gives_a_named_error_or_a_right_answer(name: str, tmp_path: Path):
    target = make_target(name, tmp_path)
    outcomes = set()
    try:
        assert attempt(target, target.seeds[0]), "the parser refuses a good example"
        for data in itertools.islice(inputs(target, random.Random(name)), target.num_inputs):
            try:
                outcomes.add(attempt(target, data))
            except Exception as error:
                raise AssertionError(f"{name} broke its promise on {len(data)} bytes: {data[:1000]!r}") from error
    finally:
        target.close()
    assert outcomes == ({True} if name in ALWAYS_TAKEN else {True, False})
