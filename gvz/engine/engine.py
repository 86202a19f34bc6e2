"""One ViZDoom engine: a process, its private directory, its shared memory. The only importer of vizdoom.

These facts about ViZDoom 1.3 explain this file:
- An engine that fails before its first frame takes the client process with it (the library reads a null
  pointer). So nothing here ends an engine that is still starting, and a file that was never loaded before is first
  loaded in a sub-process (gvz/engine/probe.py).
- When an engine is killed later, the call that waits for it raises, if no lock is lost with it (gvz/engine/
  queue_locks.py). So a hung engine is ended by a kill.
- After the player's death there is no state; single variables can still be read.
"""

import contextlib
import mmap
import os
import signal
import sys
import weakref
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gvz.core import janitor
from gvz.core.errors import ConfigError, EngineError
from gvz.core.stop import uninterrupted
from gvz.engine import process as engine_process
from gvz.engine import queue_locks
from gvz.wad.lumps import MAP_NAME

if TYPE_CHECKING:
    from vizdoom import DoomGame, GameState
    from vizdoom import Label as Label

_START_ATTEMPTS = 3
_LOG_BYTES = 2**20
"""a log larger than this is emptied; the engine prints a few lines per episode"""
_MAP_VARIABLE = "gvz_map"
"""the engine's console variable that names the map of the next episode"""
_MAP_FILE = "map.wad"
"""of a map that is not in the configured file; in the engine's private directory"""
_WEAPON_PICTURES = 15
"""in which a weapon still swings after a walk, beside an episode's first one: MAXBOB of ViZDoom's p_user.cpp is 16"""
_OVERRIDE = Path("_vizdoom.cfg")
"""ViZDoom loads a file of this name in the working directory over everything that was configured"""


@dataclass(frozen=True, kw_only=True, slots=True)
class EngineConfig:
    """What an engine loads, reads and renders. Sizes in pixels, times in seconds, tics of 1/35 s of game time."""

    wad: Path
    """scenario file"""
    buttons: tuple[str, ...]
    """names of vizdoom.Button, in the order in which `step` takes them"""
    variables: tuple[str, ...]
    """names of vizdoom.GameVariable, in the order of `state.game_variables`"""
    width: int = 256
    """width of the rendered screen"""
    height: int = 144
    """height of the rendered screen"""
    render_weapon: bool = True
    """draw the weapon"""
    depth: bool = False
    """fill state.depth_buffer, u8[H W]"""
    labels: bool = False
    """fill state.labels_buffer, u8[H W], and state.labels"""
    automap: bool = False
    """fill state.automap_buffer, u8[H W 3]"""
    start_tic: int = 1
    """the tic at which an episode starts; those before it pass without an action"""
    start_timeout_s: float = 60.0
    """after this time the start of an engine is given up"""
    step_timeout_s: float = 10.0
    """an engine that does not answer in this time is killed. Less than actors' heartbeat_timeout_s, so that a stuck
    engine ends its episode and not its actor"""
    log: Path | None = None
    """file for the engine's output; by default one in its private directory"""


class Engine:
    """A running engine. `close` (or garbage collection, or the interpreter's exit) leaves nothing of it behind.

    Attributes:
        pid: process id of the engine.
        owner_pid: that of the process that started it. A fork of this process has the object, but not the engine.
        instance_id: ViZDoom's name for it, part of the names of its shared memory.
        screen: u8[H W 3], RGB, read-only: the engine's own buffer in shared memory, no copy. It changes with
            every call; after the player's death it shows the moment of it, where `state` has nothing.
        log: the file with the engine's output.
    """

    def __init__(self, config: EngineConfig):
        """Starts the engine.

        Raises:
            ConfigError: no such button, variable or screen resolution.
            ResourceError: not enough shared memory.
            EngineError: it did not start within the time-out, or ViZDoom refused.
        """
        if _OVERRIDE.exists():
            raise EngineError(f"{_OVERRIDE.resolve()}: ViZDoom would load it over our settings; remove or rename it")
        _clean_once()
        self.config = config
        self.deadline: float | None = None
        self._game, self._directory, self.log = _start(config)
        self.owner_pid = os.getpid()
        self._end = weakref.finalize(self, engine_process.end_if_ours, self._game, self._directory, self.owner_pid)
        instance = janitor.read_instance(self._directory)
        assert instance is not None, "an engine that answered has written its instance file"
        self.pid, self._process_start, self.instance_id = instance
        self._queues = queue_locks.mapped(self.instance_id)
        self._overdue = self._loads_maps = False
        swings = config.render_weapon and any(button.startswith("MOVE_") for button in config.buttons)
        self._paused_pictures = _WEAPON_PICTURES if swings else int(config.automap)
        self._variables = self._game.get_available_game_variables()
        self.screen = _map_screen(self._game, self.instance_id)
        engine_process.watch(self)

    def new_episode(self, seed: int, map_wad: bytes | None = None) -> "GameState":
        """Starts an episode that depends on nothing but the map, `seed` in [0, 2^32) and the actions.

        `map_wad` is a WAD whose first lumps are a map; by default the map of the episode before is played. Classes of
        its things are those of the configured file.

        Raises:
            EngineError: the engine died or did not answer, its files cannot be written, or the player is dead at once.
        """
        with self._answering("new_episode"):
            if self.log.stat().st_size > _LOG_BYTES:
                os.truncate(self.log, 0)
            if self._paused_pictures:
                self._game.advance_action()  # else the end of the pause, if no tic has come since, would begin one
            if map_wad is not None:
                self._load_map(map_wad)
            self._game.set_seed(seed)  # last: it holds for one load of a map
            self._game.new_episode()
            if self._paused_pictures:
                self._forget_pictures()
            state = _state(self._game)
        if state is None:
            raise EngineError(f"engine {self._name}: the episode of seed {seed} ended before it began")
        return state

    def _load_map(self, map_wad: bytes) -> None:
        """Has the next episodes play another map: the engine reads a map `file:<path>` when an episode begins.

        ViZDoom's own way is `set_doom_map`. It holds Python's interpreter lock while the map loads, so the watchdog
        could not end an engine that hangs there. So the engine is told once that its map is what a console variable
        says; new episodes, which do not hold the lock, go there.
        """
        (self._directory / _MAP_FILE).write_bytes(map_wad)
        if not self._loads_maps:
            self._loads_maps = True
            self._game.send_game_command(f"set {_MAP_VARIABLE} {MAP_NAME}")
            self._game.set_doom_map(f"${_MAP_VARIABLE}")  # the map that it is on
            self._game.send_game_command(f"set {_MAP_VARIABLE} file:{_MAP_FILE}")  # in its working directory

    @uninterrupted()  # in pause no other episode can begin
    def _forget_pictures(self) -> None:
        """Draws in pause what depends on the episode before: how a weapon swings, and the automap's palette."""
        self._game.send_game_command("pause")
        for _ in range(self._paused_pictures):
            self._game.advance_action()
        self._game.send_game_command("pause")  # ends with the next tic

    def step(self, buttons: Sequence[float], tics: int) -> "GameState | None":
        """`advance`, then `state`."""
        self.advance(buttons, tics)
        return self.state()

    def advance(self, buttons: Sequence[float], tics: int) -> bool:
        """Holds the buttons, one number each, for `tics` game tics or until the player dies.

        Returns: whether the episode goes on.

        Raises:
            EngineError: the engine died or did not answer.
        """
        # the code of `_answering`: this is the hot path, and a context manager takes 1.5 microseconds
        self.deadline = engine_process.deadline(self.config.step_timeout_s)
        try:
            self._game.make_action(buttons, tics)
            return not self._game.is_episode_finished()
        except _vizdoom_errors() as error:
            raise self._dead("advance", error) from error
        finally:
            self.deadline = None

    def state(self) -> "GameState | None":
        """A copy of the game's state, or None once the player is dead."""
        return _state(self._game)

    def variables(self) -> list[float]:
        """Values of the configured variables, in their order, now; after the player's death too.

        Raises:
            EngineError: the engine is not running.
        """
        read = self._game.get_game_variable
        try:
            return [read(variable) for variable in self._variables]
        except _vizdoom_errors() as error:
            raise self._dead("variables", error) from error

    def variable(self, name: str) -> float:
        """Value of any game variable; like `variables`."""
        import vizdoom

        with self._answering(f"variable {name}"):
            return self._game.get_game_variable(_member(vizdoom.GameVariable, name))

    def tic(self) -> int:
        """Tics of the map so far, those before the episode's start included. Stands still once the player is dead.

        Raises:
            EngineError: the engine is not running.
        """
        self._require_running("tic")
        return self._game.get_episode_time()

    def command(self, text: str) -> None:
        """Sends a console command; it takes effect with the next step."""
        with self._answering("command"):
            self._game.send_game_command(text)

    def kill(self) -> None:
        """Ends the engine's process at once, as a crash would. The object stays, to be closed."""
        with contextlib.suppress(ProcessLookupError):
            if janitor.process_start(self.pid) == self._process_start:  # else it is dead, and its number another's
                os.kill(self.pid, signal.SIGKILL)

    def kill_overdue(self) -> None:
        """For the watchdog: kills the engine because it has not answered in time; the waiting call raises."""
        self._overdue = True
        self.kill()

    def free_waiting_call(self) -> None:
        """For the watchdog: a call that waits for a lock of the dead engine gets it, and raises."""
        if janitor.process_start(self.pid) != self._process_start:
            queue_locks.free(self._queues)

    def close(self) -> None:
        """Ends process, shared memory and private directory; `screen` is a private copy then. May be called again."""
        self._end()
        self.screen = self.screen.copy()  # the mapping would keep 10 MiB of shared memory, although it is unlinked

    @contextlib.contextmanager
    def _answering(self, what: str) -> Generator[None, None, None]:
        self._require_running(what)
        self.deadline = engine_process.deadline(self.config.step_timeout_s)
        try:
            yield
        except (*_vizdoom_errors(), OSError) as error:  # its files: somebody removed them
            raise self._dead(what, error) from error
        finally:
            self.deadline = None

    def _require_running(self, what: str) -> None:
        if not self._game.is_running():  # some calls of the library would read a null pointer
            raise EngineError(f"engine {self._name}: {what}: it was closed, or died before")

    def _dead(self, what: str, error: Exception) -> EngineError:
        why = f"no answer within {self.config.step_timeout_s:g} s, killed" if self._overdue else f"{error!r}"
        return EngineError(f"engine {self._name}: {what}: {why}{engine_process.log_tail(self.log)}")

    @property
    def _name(self) -> str:
        return f"{self.instance_id} (pid {self.pid}, {self.config.wad.name})"


def check_config(config: EngineConfig) -> None:
    """Raises ConfigError for a button, variable or screen resolution that ViZDoom does not have."""
    _make_game(config)


def _require_working_directory() -> None:
    """ViZDoom aborts the process that imports it where there is none. Later it does without."""
    try:
        if "vizdoom" not in sys.modules:
            Path.cwd()
    except FileNotFoundError as error:
        raise EngineError("the working directory was removed; change to another, or ViZDoom would abort") from error


def screen_resolutions() -> tuple[tuple[int, int], ...]:
    """Every (width, height) the engine can render, smallest first."""
    import vizdoom

    names = [name for name in vizdoom.ScreenResolution.__members__ if name.startswith("RES_")]
    sizes = [tuple(map(int, name.removeprefix("RES_").split("X"))) for name in names]
    return tuple(sorted((width, height) for width, height in sizes))


def _make_game(config: EngineConfig) -> "DoomGame":
    """A game that is configured but not started. Nothing of it depends on the working directory or the user."""
    _require_working_directory()
    import vizdoom

    if (config.width, config.height) not in screen_resolutions():
        sizes = ", ".join(f"{width}x{height}" for width, height in screen_resolutions())
        raise ConfigError(f"env.render_width, render_height: got {config.width}x{config.height}, want one of {sizes}")
    game = vizdoom.DoomGame()
    # explicit: by default ViZDoom would load a doom2.wad from the working directory
    game.set_doom_game_path(str(Path(vizdoom.root_path, "freedoom2.wad")))
    game.set_doom_scenario_path(str(config.wad.resolve()))
    game.set_doom_map(MAP_NAME)
    game.set_doom_skill(3)
    game.set_available_buttons([_member(vizdoom.Button, name) for name in config.buttons])
    game.set_available_game_variables([_member(vizdoom.GameVariable, name) for name in config.variables])
    game.set_screen_resolution(getattr(vizdoom.ScreenResolution, f"RES_{config.width}X{config.height}"))
    game.set_screen_format(vizdoom.ScreenFormat.RGB24)  # already [H W C]
    game.set_depth_buffer_enabled(config.depth)
    game.set_labels_buffer_enabled(config.labels)
    game.set_automap_buffer_enabled(config.automap)
    if config.automap:  # the whole map, north up, as large as fits; by default it is cut off round the agent
        game.set_automap_mode(vizdoom.AutomapMode.WHOLE)
        game.add_game_args("+viz_am_center 1 +am_followplayer 0")
    game.set_objects_info_enabled(False)
    game.set_window_visible(False)
    game.set_render_hud(True)
    game.set_render_weapon(config.render_weapon)
    game.set_render_crosshair(False)
    game.set_render_decals(False)
    game.set_render_particles(False)
    game.set_console_enabled(True)  # the engine prints to its log; nothing of it is on the screen
    game.set_sound_enabled(False)
    game.set_mode(vizdoom.Mode.PLAYER)
    game.set_seed(0)  # an engine starts with an episode of its own, which is not played
    game.set_episode_start_time(config.start_tic)
    game.set_episode_timeout(0)  # the environment's, not the engine's: at its time-out the engine has no state
    return game


def _start(config: EngineConfig) -> "tuple[DoomGame, Path, Path]":
    """(a running game, its private directory, its log), after at most _START_ATTEMPTS."""
    import vizdoom

    attempt = 0
    while True:
        attempt += 1
        game = _make_game(config)
        directory = janitor.make_directory()
        log = config.log or directory / "engine.log"
        game.set_doom_config_path(str(directory / "vizdoom.ini"))
        try:
            engine_process.start(game, directory, Path(vizdoom.exe_path), log, config.start_timeout_s)
        except EngineError:
            if attempt == _START_ATTEMPTS:
                raise
        else:
            return game, directory, log


def _state(game: "DoomGame") -> "GameState | None":
    """None where no episode runs, which ViZDoom's annotation leaves out."""
    return game.get_state()


def _map_screen(game: "DoomGame", instance_id: str) -> np.ndarray:
    """The screen buffer within the engine's shared memory. Its place is not documented, so it is found by content.

    Raises:
        EngineError: it is not there, so this version of ViZDoom works otherwise.
    """
    state = _state(game)
    screen = None if state is None else state.screen_buffer
    with (janitor.SHM_DIR / f"ViZDoomSM{instance_id}").open("rb") as file:
        memory = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    offset = -1 if screen is None or screen.min() == screen.max() else memory.find(screen.tobytes())
    if screen is None or offset < 0:
        raise EngineError(f"engine {instance_id}: no screen in its shared memory; this ViZDoom is not supported")
    return np.frombuffer(memory, np.uint8, screen.size, offset).reshape(screen.shape)


@cache
def _clean_once() -> None:
    """What an earlier process of ours left is removed before this one starts its first engine."""
    janitor.clean_dead_instances()


def _member(names: Any, name: str) -> Any:
    if name not in names.__members__:
        raise ConfigError(f"engine: unknown {names.__name__} {name!r}, want a name of vizdoom.{names.__name__}")
    return names.__members__[name]


def _vizdoom_errors() -> tuple[type[Exception], ...]:
    import vizdoom

    return (
        vizdoom.ViZDoomErrorException,
        vizdoom.ViZDoomIsNotRunningException,
        vizdoom.ViZDoomUnexpectedExitException,
        vizdoom.MessageQueueException,
        vizdoom.SharedMemoryException,
        vizdoom.FileDoesNotExistException,
    )
