"""Control messages: what was said is what is heard, and nothing else is let in."""

import dataclasses
import types
import typing
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gvz.core.errors import TransportError
from gvz.transport.messages import (
    SCHEMA_VERSION,
    STEP_DTYPE,
    ActorSpec,
    EpisodeStats,
    Fault,
    Message,
    Ready,
    Stop,
    decode,
    encode,
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
    if origin is list:
        return st.lists(values(args[0]), max_size=4)
    if origin is dict:
        return st.dictionaries(values(args[0]), values(args[1]), max_size=4)
    if origin is types.UnionType:
        return st.none() | values(args[0])
    return KINDS[kind]


def messages_of(cls: type[Message]) -> st.SearchStrategy[Message]:
    hints = typing.get_type_hints(cls)
    return st.builds(cls, **{field.name: values(hints[field.name]) for field in dataclasses.fields(cls)})


ANY_MESSAGE = st.one_of([messages_of(cls) for cls in (EpisodeStats, Ready, Fault, Stop, ActorSpec)])


def raw(**changes: Any) -> bytes:
    good: dict[str, Any] = {"type": "ready", "schema": SCHEMA_VERSION, "actor": 3, "pid": 4}
    return msgpack.packb({k: v for k, v in {**good, **changes}.items() if v != "DROP"})  # pyright: ignore


def episode(**changes: Any) -> bytes:
    numbers = ("lane", "task", "episode", "seed", "length_frames", "length_steps", "params_version", "score", "reward")
    good = {**dict.fromkeys(numbers, 1), "reward_components": {}, "terminated": True, "truncated": False}
    return raw(**{"actor": "DROP", "pid": "DROP", "type": "episode", **good, **changes})


@settings(max_examples=300, deadline=None)
@given(message=ANY_MESSAGE)
def test_what_was_said_is_heard(message: Message):
    assert decode(encode(message)) == message


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"\xc1", "control message of 1 bytes is not msgpack"),
        (b"", "control message of 0 bytes is not msgpack"),
        (msgpack.packb([1]), "got list, want a map with a text 'type'"),
        (msgpack.packb({"type": 7}), "got dict, want a map with a text 'type'"),
        (raw(schema=SCHEMA_VERSION + 1), f"'ready': another schema, want {SCHEMA_VERSION}"),
        (raw(type="exec"), "unknown type 'exec', want one of"),
        (raw(type="stop"), "'stop': unknown field 'actor'"),
        (raw(code="rm"), "'ready': unknown field 'code'"),
        (raw(pid="DROP"), "'ready': .* missing 1 required keyword-only argument: 'pid'"),
        (raw(pid="4"), "'ready': got '4' for pid, want <class 'int'>"),
        (raw(pid=True), "'ready': got True for pid"),
        (raw(pid=None), "'ready': got None for pid"),
        (raw(pid=4.0), "'ready': got 4.0 for pid"),
        (raw(pid=-4), "'ready': got -4 for pid"),
        (episode(score=float("nan")), "'episode': got nan for score, want <class 'float'>"),
        (episode(reward=float("-inf")), "'episode': got -inf for reward"),
        (episode(reward_components={"kill": float("inf")}), "'episode': got {'kill': inf} for reward_components"),
    ],
)
def test_anything_else_is_refused_by_name(data: bytes, text: str):
    with pytest.raises(TransportError, match=text):
        decode(data)


@settings(max_examples=300, deadline=None)
@given(message=ANY_MESSAGE, position=st.floats(0, 1, exclude_max=True), byte=st.integers(0, 255))
def test_a_changed_byte_gives_a_message_or_a_named_error(message: Message, position: float, byte: int):
    data = bytearray(encode(message))
    data[int(position * len(data))] = byte
    try:
        heard = decode(bytes(data))
    except TransportError:
        return
    hints = typing.get_type_hints(type(heard))
    for field in dataclasses.fields(heard):
        if hints[field.name] in (int, str, bool, bytes):
            assert type(getattr(heard, field.name)) is hints[field.name]


@settings(max_examples=300, deadline=None)
@given(data=st.binary(max_size=100))
def test_random_bytes_are_refused(data: bytes):
    with pytest.raises(TransportError):
        decode(data)


def test_a_step_record_is_48_bytes_without_gaps():
    assert STEP_DTYPE.itemsize == 48
    fields = STEP_DTYPE.fields
    assert fields is not None
    assert sum(dtype.itemsize for dtype, *_ in fields.values()) == 48
    assert all(offset % np.dtype(dtype.base).itemsize == 0 for dtype, offset, *_ in fields.values()), "unaligned"
