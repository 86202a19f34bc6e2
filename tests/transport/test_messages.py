"""Control messages: what was said is what is heard, and nothing else is let in."""

import typing
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gvz.core.errors import TransportError
from gvz.transport.messages import (
    SCHEMA_VERSION,
    Message,
    decode,
    encode,
    step_dtype,
)

KINDS = {
    int: st.integers(0, 2**63 - 1),
    float: st.floats(allow_nan=False, allow_infinity=False),
    str: st.text(max_size=20),
    bool: st.booleans(),
    bytes: st.binary(max_size=20),
    Any: st.none() | st.integers(-5, 5) | st.text(max_size=5),
}


def values(kind: Any) -> st.SearchStrategy[Any]:
    origin, args = typing.get_origin(kind), typing.get_args(kind)
    if origin is typing.Literal:
        return st.sampled_from(args)
    if origin is list:
        return st.lists(values(args[0]), max_size=4)
    if origin is dict:
        return st.dictionaries(values(args[0]), values(args[1]), max_size=4)
    if origin is tuple and args[-1] is ...:
        return st.lists(values(args[0]), max_size=4).map(tuple)
    if origin is tuple:
        return st.tuples(*map(values, args))
    if type(None) in args:
        return st.none() | values(args[0])
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        return messages_of(kind)
    return KINDS[kind]


def messages_of(cls: type[Any]) -> st.SearchStrategy[Any]:
    hints = typing.get_type_hints(cls)
    return st.builds(cls, **{field.name: values(hints[field.name]) for field in msgspec.structs.fields(cls)})


ANY_MESSAGE = st.one_of([messages_of(cls) for cls in typing.get_args(Message)])
SCHEMA = bytes([SCHEMA_VERSION])


def packed(value: Any) -> bytes:
    return SCHEMA + msgspec.msgpack.encode(value)


def raw(**changes: Any) -> bytes:
    good: dict[str, Any] = {"type": "ready", "actor": 3, "pid": 4}
    return packed({k: v for k, v in {**good, **changes}.items() if v != "DROP"})


def episode(**changes: Any) -> bytes:
    numbers = ("lane", "task", "episode", "seed", "length_frames", "length_steps", "params_version", "score", "reward")
    good = {**dict.fromkeys(numbers, 1), "reward_components": {}, "terminated": True, "truncated": False}
    return raw(**{"actor": "DROP", "pid": "DROP", "type": "episode", **good, **changes})


@settings(max_examples=300)
@given(message=ANY_MESSAGE)
def test_what_was_said_is_heard(message: Message):
    assert decode(encode(message)) == message


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"", f"control message of 0 bytes: want schema {SCHEMA_VERSION} in its first byte"),
        (bytes([SCHEMA_VERSION + 1]) + raw()[1:], f"want schema {SCHEMA_VERSION} in its first byte"),
        (SCHEMA + b"\xc1", "control message of 2 bytes: MessagePack data is malformed"),
        (SCHEMA, "control message of 1 bytes: Input data was truncated"),
        (packed([1]), "Expected `object`, got `array`"),
        (packed({"type": 7}), r"Expected `str`"),
        (packed({"actor": 3, "pid": 4}), "missing required field `type`"),
        (raw(type="exec"), "Invalid value 'exec'"),
        (raw(type="stop"), "unknown field `actor`"),
        (raw(code="rm"), "unknown field `code`"),
        (raw(pid="DROP"), "missing required field `pid`"),
        (raw(pid="4"), r"Expected `int`, got `str` - at `\$.pid`"),
        (raw(pid=True), "Expected `int`, got `bool`"),
        (raw(pid=None), "Expected `int`, got `None`"),
        (raw(pid=4.5), "Expected `int`, got `float`"),
        (raw(pid=-4), r"Expected `int` >= 0 - at `\$.pid`"),
        (episode(score=float("nan")), "score, reward and its components: want finite numbers"),
        (episode(reward=float("-inf")), "want finite numbers"),
        (episode(reward_components={"kill": float("inf")}), "want finite numbers"),
    ],
)
def test_anything_else_is_refused_by_name(data: bytes, text: str):
    with pytest.raises(TransportError, match=text):
        decode(data)


@pytest.mark.parametrize(
    ("numbers", "size"),
    [((0, 0, 0), 48), ((1, 0, 0), 56), ((2, 0, 0), 56), ((3, 2, 0), 72), ((0, 0, 60), 112), ((3, 0, 60), 120)],
)
def test_a_step_record_is_aligned_and_has_no_more_than_it_needs(numbers: tuple[int, int, int], size: int):
    dtype = step_dtype(*numbers)
    assert dtype.itemsize == size
    assert dtype.fields is not None
    assert sum(field.itemsize for field, *_ in dtype.fields.values()) == size
    assert all(offset % np.dtype(field.base).itemsize == 0 for field, offset, *_ in dtype.fields.values()), "unaligned"
