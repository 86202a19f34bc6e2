"""What travels between actors and learner: the step record (shared memory) and control messages (msgpack).

The step record is aligned on arrival, as in dm_env and in the papers' subscripts: record t holds the frame o_t,
the reward and the end flags that *came with* o_t, and the action a_t taken *at* o_t. An episode of T decisions is
T + 1 records; the last one has `terminated` or `truncated` set and an action that means nothing. Stacks,
n-step returns and discounts are the replay's work.

Control messages are msgpack maps with a `type`, never pickles: nothing that comes from a peer is ever executed.
"""

import math
import types
import typing
from dataclasses import asdict, dataclass, field
from typing import Any, ClassVar

import msgpack
import numpy as np

from gvz.core.errors import TransportError

SCHEMA_VERSION = 2
"""Raised by one whenever the meaning or layout of anything in this file changes."""

STEP_DTYPE = np.dtype(
    [
        ("sequence", "<u8"),  # 0, 1, 2, ... per ring, never reused: loss, duplication and tearing show
        ("episode", "<u8"),  # number of the episode within its lane
        ("params_version", "<u8"),  # version of the parameters that chose `action`
        ("action", "<i4"),  # a_t; 0 and meaningless in an episode's last record
        ("reward", "<f4"),  # r_t, received on arriving at o_t; 0 in an episode's first record
        ("lane", "<u2"),  # which game of the run: actor * games_per_actor + game
        ("task", "<u2"),  # index into the run's tuple of tasks
        ("first", "u1"),  # o_t is the first of its episode
        ("terminated", "u1"),  # o_t is the last: the episode ended by the rules (discount 0)
        ("truncated", "u1"),  # o_t is the last: the episode was cut (time-out, crash); the discount stays
        ("pad", "u1", (9,)),  # to 48: every number stands aligned, so that a store is whole or not at all
    ]
)
"""Everything of a step record but its frame, 48 bytes. Frames stand beside, uint8[H W C] each."""


@dataclass(frozen=True, slots=True)
class StepBlock:
    """N step records of one ring in the order they were written. Owned copies, never views of shared memory.

    Attributes:
        steps: STEP_DTYPE[N].
        frames: uint8[N, H, W, C].
    """

    steps: np.ndarray
    frames: np.ndarray

    def __len__(self) -> int:
        return len(self.steps)


@dataclass(frozen=True, kw_only=True, slots=True)
class EpisodeStats:
    """One finished episode, actor -> learner."""

    type: ClassVar[str] = "episode"
    lane: int
    task: int
    """index into the run's tuple of tasks"""
    episode: int
    """number of the episode within its lane"""
    seed: int
    """engine seed; with the task it replays the episode's start alone"""
    score: float
    """the scenario's metric: frames alive or kills"""
    reward: float
    """undiscounted sum"""
    reward_components: dict[str, float]
    """sum of each named component, weights applied"""
    length_frames: int
    length_steps: int
    params_version: int
    """version of the parameters that chose the last action"""
    terminated: bool
    truncated: bool
    cut: bool = False
    """the episode did not end by itself: engine or actor failed"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Ready:
    """The worker has started all its games, actor -> learner."""

    type: ClassVar[str] = "ready"
    actor: int
    pid: int


@dataclass(frozen=True, kw_only=True, slots=True)
class Fault:
    """Something failed at a process boundary, actor -> learner. `fatal` means the sender is about to exit."""

    type: ClassVar[str] = "fault"
    actor: int
    lane: int | None
    kind: str
    """short name: engine_start, engine_crash, exception, ..."""
    message: str
    traceback: str = ""
    fatal: bool = False


@dataclass(frozen=True, kw_only=True, slots=True)
class Stop:
    """Finish the current step, close every game, exit 0; learner -> actor."""

    type: ClassVar[str] = "stop"


@dataclass(frozen=True, kw_only=True, slots=True)
class ActorSpec:
    """All that a worker needs to know, learner -> actor, once, as its first message."""

    type: ClassVar[str] = "actor_spec"
    actor: int
    lanes: list[int]
    """global lane of each of its games"""
    lane_tasks: list[int]
    """task index of each of its games"""
    tasks: list[str]
    """ids of the run's tasks"""
    first_episodes: list[int]
    """number the first episode of each game gets (larger than 0 after a restart or resume)"""
    seed: int
    env_entry_point: str
    """`module:callable`, called as f(task_id, env_config_dict) -> gymnasium.Env"""
    env_config: dict[str, Any]
    frame_shape: list[int]
    stack_size: int
    num_actions: int
    policy: bytes
    """serialized jax.export of the acting function; empty for a uniformly random policy"""
    ring_capacity: int
    num_params: int
    """length of the flat parameter vector; 0 for a random policy, which has no queue"""
    layout_hash: int
    """hash of the parameter tree, as in ParamsHeader"""
    work_dir: str
    """private directory for the engines' files and the worker's logs"""


Message = EpisodeStats | Ready | Fault | Stop | ActorSpec
_TYPES: dict[str, type[Any]] = {cls.type: cls for cls in (EpisodeStats, Ready, Fault, Stop, ActorSpec)}
_FIELDS = {
    cls: {key: kind for key, kind in typing.get_type_hints(cls).items() if key != "type"} for cls in _TYPES.values()
}


def encode(message: Message) -> bytes:
    """Packs a message as msgpack."""
    packed = msgpack.packb({"type": message.type, "schema": SCHEMA_VERSION, **asdict(message)}, use_bin_type=True)
    assert packed is not None  # only a Packer that does not reset itself returns nothing
    return packed


def decode(data: bytes) -> Message:
    """Unpacks a message.

    Raises:
        TransportError: not msgpack, another schema, an unknown type, or fields missing, unknown or of a wrong type.
    """
    try:
        raw = msgpack.unpackb(data, raw=False, strict_map_key=True)
    except Exception as error:  # msgpack raises half a dozen unrelated classes
        raise TransportError(f"control message of {len(data)} bytes is not msgpack: {error}") from error
    if not isinstance(raw, dict) or not isinstance(raw.get("type"), str):
        raise TransportError(f"control message: got {type(raw).__name__}, want a map with a text 'type'")
    if raw.pop("schema", None) != SCHEMA_VERSION:
        raise TransportError(f"control message {raw['type']!r}: another schema, want {SCHEMA_VERSION}")
    name = raw.pop("type")
    cls = _TYPES.get(name)
    if cls is None:
        raise TransportError(f"control message: unknown type {name!r}, want one of {sorted(_TYPES)}")
    for key, value in raw.items():
        if key not in _FIELDS[cls]:
            raise TransportError(f"control message {name!r}: unknown field {key!r}")
        if not _fits(value, _FIELDS[cls][key]):
            raise TransportError(f"control message {name!r}: got {value!r:.80} for {key}, want {_FIELDS[cls][key]}")
    try:
        return cls(**raw)
    except TypeError as error:
        raise TransportError(f"control message {name!r}: {error}") from error


def _fits(value: Any, kind: Any) -> bool:
    """Whether an unpacked value is of an annotated type; an int passes for a float, a bool never for a number.

    A float must be finite, an int must not be negative.
    """
    origin, args = typing.get_origin(kind), typing.get_args(kind)
    if kind is Any:
        return True
    if origin is types.UnionType:
        return any(_fits(value, arg) for arg in args)
    if origin is list:
        return type(value) is list and all(_fits(item, args[0]) for item in value)
    if origin is dict:
        return type(value) is dict and all(_fits(k, args[0]) and _fits(v, args[1]) for k, v in value.items())
    if kind is float:
        return type(value) in (int, float) and math.isfinite(value)
    # numbers of a message count something, or are the number of something
    return type(value) is kind and (kind is not int or value >= 0)


@dataclass(frozen=True, kw_only=True, slots=True)
class ParamsHeader:
    """What a version of the parameters says of itself in the parameter queue."""

    version: int
    """0 is the initial parameters; rises by one with every publication"""
    num_updates: int
    """gradient steps that these parameters have seen"""
    epsilon: float = 0.0
    """probability of a uniformly random action (1 during warm-up; then 0 for agents that explore by noise)"""
    layout_hash: int = field(default=0)
    """hash of the parameter tree's paths, shapes and dtypes: writer and reader must agree"""
