"""Configuration of the actor pool."""

from dataclasses import dataclass
from typing import Annotated, Literal

from actors.placement import PlacementKind
from gvz.core.errors import ConfigError
from gvz.core.ranges import Range, check_ranges

MAX_LANES = 2**16
"""games of a run: a step record numbers them with 16 bits"""


@dataclass(frozen=True, kw_only=True, slots=True)
class ActorsConfig:
    """How many processes play, and how patiently they are watched. Times in seconds, sizes in step records."""

    num_actors: Annotated[int | None, Range(1, MAX_LANES)] = None
    """actor processes, of each host if there are some (cluster.hosts); default one per CPU core of this machine, or
    fewer if the replay or the warm-up has no room for their games"""
    games_per_actor: Annotated[int | None, Range(1, MAX_LANES)] = None
    """games each actor plays and acts on in one batch; default the smallest number >= 4 that gives every actor
    every task, with more than 16 tasks that gives every task a game in the run"""
    placement: PlacementKind = "auto"
    """pinned: an actor and its engines share one core, and the learner keeps off these cores if there are others; free:
    any core; auto: pinned if at the start as many cores are idle as there are actors, and one more"""
    inference: Literal["actors", "device"] = "actors"
    """who chooses actions: actors, each for its own games on its core; device, the learner's device (a GPU) for the
    games of all actors in one batch. An actor waits for its actions then: more actors than cores may be faster"""
    ring_capacity: Annotated[int, Range(8, 2**20)] = 64
    """step records a ring holds; a full ring makes its actor wait"""
    start_timeout_s: float = 120.0
    """an actor that has not started all its games by then is restarted"""
    heartbeat_timeout_s: float = 30.0
    """an actor without a heartbeat for this many seconds is killed and replaced"""
    max_restarts: int = 20
    """restarts of one actor within restart_window_s before the run stops with an error; starts that fail in a row count
    however long they take"""
    restart_window_s: float = 600.0
    """length of the window in which restarts are counted"""
    recycle_episodes: int = 1000
    """a game's engine is restarted after at most this many episodes (ViZDoom has leaked memory over hours); 0: only
    where the task needs it, as with fuzzy enemies: a fresh engine for every episode lets each be replayed alone"""

    def __post_init__(self) -> None:
        check_ranges("actors", self)
        for name in ("start_timeout_s", "heartbeat_timeout_s", "restart_window_s"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"actors.{name}: got {getattr(self, name)}, want more than 0 seconds")
        for name in ("max_restarts", "recycle_episodes"):
            if getattr(self, name) < 0:
                raise ConfigError(f"actors.{name}: got {getattr(self, name)}, want 0 or more")
