"""The data between actors and learner: the step record (shared memory) and control messages (msgpack). Control messages
between a vector environment and its workers are here, too.

The step record is aligned on arrival, as in dm_env and in the papers' subscripts: record t holds the frame o_t,
the reward and the end flags that *came with* o_t, and the action a_t taken *at* o_t. An episode of T decisions is
T + 1 records; the last one has `terminated` or `truncated` set and an action without meaning. The replay makes stacks,
n-step returns and discounts.

A control message is one byte, SCHEMA_VERSION, and a msgpack map with a `type`. It is never a pickle: data from a peer
is never executed.
"""

import math
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from gvz.core.errors import TransportError

SCHEMA_VERSION = 8
"""Increased by one when the meaning or layout of anything in this file changes."""


def step_dtype(num_variables: int = 0, num_extras: int = 0, num_sights: int = 0) -> np.dtype:
    """A step record without its frame: 48 bytes, 4 for each number and 1 for each flag. Frames are beside it.

    Args:
        num_variables: game variables that the agent observes, V.
        num_extras: numbers that the policy records with an action, E.
        num_sights: flags of what is in sight.
    """
    numbers = num_variables + num_extras
    return np.dtype(
        [
            ("sequence", "<u8"),  # 0, 1, 2, ... per ring, never reused: detects lost, repeated and torn records
            ("episode", "<u8"),  # number of the episode within its lane
            ("params_version", "<u8"),  # version of the parameters that chose `action`
            ("action", "<i4"),  # a_t; 0 and meaningless in an episode's last record
            ("reward", "<f4"),  # r_t, received on arriving at o_t; 0 in an episode's first record
            ("lane", "<u2"),  # which game of the run: actor * games_per_actor + game
            ("task", "<u2"),  # index into the run's tuple of tasks
            ("first", "u1"),  # o_t is the first of its episode
            ("terminated", "u1"),  # o_t is the last: the episode ended by the rules (discount 0)
            ("truncated", "u1"),  # o_t is the last: time-out or crash; the discount stays
            ("pad", "u1", (9 + (-4 * numbers - num_sights) % 8,)),  # numbers are aligned, so that a store is atomic
            ("vector", "<f4", (num_variables,)),  # game variables that came with o_t
            ("extras", "<f4", (num_extras,)),  # what the policy says of a_t
            ("sight", "u1", (num_sights,)),  # what is in sight in o_t, by class and column
        ]
    )


STEP_DTYPE = step_dtype()
"""of agents that observe no game variables and record nothing with their actions"""


@dataclass(frozen=True, slots=True)
class StepBlock:
    """N step records of one ring in the order they were written. Owned copies, never views of shared memory.

    Attributes:
        steps: of `step_dtype`, [N].
        frames: uint8[N, H, W, C].
    """

    steps: np.ndarray
    frames: np.ndarray

    def __len__(self) -> int:
        return len(self.steps)


Count = Annotated[int, msgspec.Meta(ge=0)]
"""Every integer of a message is a count or an index."""


class _Message(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="type"):
    """A control message."""


class EpisodeStats(_Message, frozen=True, tag="episode"):
    """One finished episode, actor -> learner."""

    lane: Count
    task: Count
    """index into the run's tuple of tasks"""
    episode: Count
    """number of the episode within its lane"""
    seed: Count
    """engine seed; with the task it replays the episode alone"""
    score: float
    """the scenario's metric: frames alive or kills"""
    reward: float
    """undiscounted sum"""
    reward_components: dict[str, float]
    """sum of each named component, weights applied"""
    length_frames: Count
    length_steps: Count
    params_version: Count
    """version of the parameters that chose the last action"""
    terminated: bool
    truncated: bool
    cut: bool = False
    """the episode ended because the engine or actor failed"""

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, (self.score, self.reward, *self.reward_components.values()))):
            raise ValueError("score, reward and its components: want finite numbers")


class Ready(_Message, frozen=True, tag="ready"):
    """The worker has started all its games, actor -> learner."""

    actor: Count
    pid: Count


class Fault(_Message, frozen=True, tag="fault"):
    """Something failed at a process boundary, actor -> learner."""

    actor: int
    lane: Count | None
    kind: str
    """short name: engine_start, engine_crash, exception, ..."""
    message: str
    traceback: str = ""


class Stop(_Message, frozen=True, tag="stop"):
    """Finish the current step, close every game, exit 0; learner -> actor."""


class Assign(_Message, frozen=True, tag="assign"):
    """A lane's next episodes are of this task, learner -> actor. The episode that is being played ends first."""

    lane: Count
    task: Count
    """index into the run's tuple of tasks"""


class Play(_Message, frozen=True, kw_only=True):
    """What every actor of a pool plays, and what it records."""

    tasks: tuple[str, ...]
    """ids of the run's tasks"""
    seed: Count
    """the run's seed"""
    env_entry_point: str
    """`module:callable`, called as f(task_id, env_config) -> gymnasium.Env"""
    env_config: dict[str, Any]
    """of plain types"""
    frame_shape: tuple[Count, Count, Count]
    """(H, W, C)"""
    stack_size: Count
    past_actions: Count = 0
    """actions of an observation"""
    variables: tuple[str, ...] = ()
    """game variables of an observation"""
    num_extras: Count = 0
    """numbers that the policy records with an action"""
    num_sights: Count = 0
    """flags of what is in sight; 0 if the environment gives none"""
    action_masks: tuple[tuple[bool, ...], ...] | None = None
    """[task][action]: the actions that each task allows; None for all"""
    num_actions: Count
    policy: bytes
    """serialized jax.export of the acting function; empty for a uniformly random policy, and for actors
    that ask for their actions"""
    fold: bytes = b""
    """serialized jax.export of what makes the acting function's parameters; empty: it takes them as they come"""
    fold_period_steps: Count = 1
    """calls of the acting function before they are made again"""
    num_params: Count
    """length of the flat float32 parameter vector; 0 for a random policy, which has no queue"""
    layout_hash: Count
    """hash of the parameter tree, as in ParamsHeader; 0 for a random policy"""

    @property
    def record_dtype(self) -> np.dtype:
        """The dtype of a step record."""
        return step_dtype(len(self.variables), self.num_extras, self.num_sights)


class ActorSpec(Play, frozen=True, kw_only=True, tag="actor_spec"):
    """The configuration of a worker, learner -> actor, sent once as the first message."""

    actor: Count
    lanes: list[Count]
    """global lane of each of its games"""
    lane_tasks: list[Count]
    """task index of each of its games"""
    first_episodes: list[Count]
    """number of each game's first episode (larger than 0 after a restart or resume)"""
    ring_capacity: Count
    core: Count | None
    """the only one that it and its engines may use; None: any"""
    inference: Literal["actors", "device"] = "actors"
    """who chooses its actions: itself, or the learner's process"""
    work_dir: str
    """private directory for the engines' files and the worker's logs"""


class VectorSpec(_Message, frozen=True, tag="vector_spec"):
    """What a worker of a vector environment plays, environment -> worker, sent once as the first message."""

    worker: Count
    games: list[Count]
    """their rows in the shared arrays"""
    tasks: list[str]
    """id of each game's task"""
    num_envs: Count
    """rows of the shared arrays"""
    num_workers: Count
    env_config: dict[str, Any]
    """of plain types"""
    options: dict[str, Any]
    """other arguments of DoomEnv"""
    same_step: bool
    """a game that ends begins its next episode within the same decision"""
    answer_after: Count
    """outcomes that are sent together; fewer only if no decision is left"""


class Decision(msgspec.Struct, frozen=True, array_like=True):
    """What one game does next."""

    game: Count
    half: Count
    """which half of the shared arrays the observation goes into, 0 or 1"""
    action: Count | list[Count] | None
    """a list if the actions are MultiDiscrete; None begins an episode"""
    episode_seed: Count
    """of the episode that begins, if one does"""


class Decisions(_Message, frozen=True, tag="decisions"):
    """The next decisions of some games, environment -> worker."""

    decisions: list[Decision]


class Outcome(msgspec.Struct, frozen=True, array_like=True):
    """What a decision came to. The observation is in shared memory."""

    game: Count
    reward: float
    terminated: bool
    truncated: bool
    info: dict[str, Any]
    final_info: dict[str, Any] | None = None
    """of the step that ended the episode, if the next one has begun within the same decision"""


class Outcomes(_Message, frozen=True, tag="outcomes"):
    """The outcomes of some decisions, worker -> environment."""

    outcomes: list[Outcome]


class Render(_Message, frozen=True, tag="render"):
    """Asks for the last rendered screen of every game, environment -> worker."""


class Screen(_Message, frozen=True, tag="screen"):
    """An answer, worker -> environment, one for each game in their order: u8[render_height render_width 3], or nothing
    if the game has rendered nothing yet.
    """

    screen: bytes


Message = EpisodeStats | Ready | Fault | Stop | Assign | ActorSpec | VectorSpec | Decisions | Outcomes | Render | Screen
_DECODER = msgspec.msgpack.Decoder(Message)


def encode(message: Message) -> bytes:
    """Packs a message."""
    return bytes([SCHEMA_VERSION]) + msgspec.msgpack.encode(message)


def decode(data: bytes) -> Message:
    """Unpacks a message.

    Raises:
        TransportError: another schema, not msgpack, an unknown type, or fields missing, unknown or of a wrong type.
    """
    if data[:1] != bytes([SCHEMA_VERSION]):
        raise TransportError(f"control message of {len(data)} bytes: want schema {SCHEMA_VERSION} in its first byte")
    try:
        return _DECODER.decode(data[1:])
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise TransportError(f"control message of {len(data)} bytes: {error}") from error


@dataclass(frozen=True, kw_only=True, slots=True)
class ParamsHeader:
    """Describes a version of the parameters in the parameter queue."""

    version: int
    """0 is the initial parameters; each publication adds one"""
    num_updates: int
    """gradient steps that made these parameters"""
    epsilon: float = 0.0
    """probability of a uniformly random action (1 during warm-up; then 0 for agents that explore by noise)"""
    layout_hash: int = 0
    """hash of the parameter tree's paths, shapes and dtypes: writer and reader must agree"""
