"""Loads a scenario file in a sub-process, because an engine that cannot start crashes its client.

A file is loaded here once before any other process loads it. `python -m gvz.engine.probe` is the sub-process.
"""

import contextlib
import os
import re
import resource
import subprocess
import sys
import time
import zlib
from importlib.metadata import version
from pathlib import Path
from typing import NoReturn

from gvz.core import janitor
from gvz.core.errors import EngineError, WadError, exit_text
from gvz.core.libraries import import_path
from gvz.engine.engine import Engine, EngineConfig
from gvz.engine.process import log_tail, one_of
from gvz.wad.lumps import MAP_NAME, read_wad
from gvz.wad.stock import engine_directory

_FAULTS = re.compile(
    r"unknown|tried to register|script error|runaway script|no map|not found|execution could not continue", re.I
)
"""ZDoom prints such a line, and goes on"""
_DIRECTORY = re.compile(r"(?<![^\s\"'(])/.*/")
"""of a file that a line names: a directory may have any name"""
_SCRIPT_ERROR = "Script error"
_ALONE_S = 20.0
_TIMEOUT_S = 60.0
_MEMORY_BYTES = 4 * 2**30
_TICS = 70
_NUM_PLACES = 8


def probe_wad(wad: Path, timeout_s: float = _TIMEOUT_S) -> str:
    """Starts an engine on a scenario file, plays two seconds of its map and returns the engine's log.

    Raises:
        EngineError: it crashed, did not finish in time, or its log shows a fault; the message has the log's lines.
    """
    try:
        lumps = [lump.name for lump in read_wad(wad.read_bytes())]
    except (OSError, WadError) as error:
        raise EngineError(f"{wad}: not a scenario file: {error}") from error
    if MAP_NAME not in lumps:
        raise EngineError(f"{wad}: no map {MAP_NAME}, only {', '.join(lumps[:8])}; the engine would play another one")
    with janitor.temporary_directory() as directory:
        log = directory / "engine.log"
        arguments = (os.getpid(), wad, log, timeout_s)
        command = [sys.executable, "-P", "-m", "gvz.engine.probe", *map(str, arguments)]
        environment = {**os.environ, "PYTHONPATH": import_path()}
        try:
            done = subprocess.run(
                command, env=environment, capture_output=True, text=True, timeout=timeout_s, check=False
            )
        except subprocess.TimeoutExpired as error:
            raise EngineError(f"{wad}: not loaded within {timeout_s:g} s{log_tail(log)}") from error
        finally:
            janitor.clean_dead_instances()  # a crashed client removes nothing
        text = log.read_text(errors="replace") if log.exists() else ""
        faults = _faults(text)
        if done.returncode < 0 and not faults:
            faults = _faults(_output_of_engine_alone(command, environment))
        if done.returncode != 0 or faults:
            what = (
                f"the engine crashed with {exit_text(done.returncode)}" if done.returncode < 0 else "cannot be played"
            )
            lines = faults[:8] or done.stderr.strip().splitlines()[-1:] or ["it does not say why"]
            raise EngineError(f"{wad}: {what}: {'; '.join(lines)}{log_tail(log)}")
        return text


def _faults(text: str) -> list[str]:
    """The lines of an engine's output that tell of a fault; the cause of a script error is in the next line."""
    lines = [line for line in text.splitlines() if line.strip()]
    pairs = zip(["", *lines], lines, strict=False)
    return [line for last, line in pairs if _FAULTS.search(_DIRECTORY.sub("", line)) or _SCRIPT_ERROR in last]


def _output_of_engine_alone(command: list[str], environment: dict[str, str]) -> str:
    """What the engine prints when no client starts it: one that ends while it starts is killed with its client, which
    crashes, often before it has printed the cause.
    """
    with contextlib.suppress(subprocess.TimeoutExpired):
        done = subprocess.run(
            [*command, "alone"],
            env=environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=_ALONE_S,
            check=False,
        )
        return (done.stdout + done.stderr).decode(errors="replace")
    return ""


def ensure_loads(wad: Path) -> None:
    """`probe_wad`, once for each content-addressed file and version of ViZDoom: success leaves a marker beside it.

    Raises:
        EngineError: as probe_wad.
    """
    marker = wad.with_suffix(f".loads-{version('vizdoom')}")
    if marker.exists():
        return
    place = zlib.crc32(wad.stem.encode()) % _NUM_PLACES  # one file is probed by one process at a time
    with one_of([f"probe-{place}"], time.monotonic() + _TIMEOUT_S):
        if not marker.exists():
            probe_wad(wad)
            with contextlib.suppress(OSError):  # a directory we cannot write: probed again the next time
                marker.touch()


def _main(parent_pid: int, wad: str, log: str, timeout_s: float, alone: bool) -> None:
    janitor.die_with_parent(parent_pid)
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY_BYTES, _MEMORY_BYTES))
    resource.setrlimit(resource.RLIMIT_CPU, (int(timeout_s) + 1, int(timeout_s) + 1))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    if alone:
        _become_engine(Path(wad).resolve(), Path(log).parent)
    config = EngineConfig(wad=Path(wad), buttons=(), variables=(), log=Path(log), step_timeout_s=timeout_s / 4)
    engine = Engine(config)
    try:
        engine.new_episode(seed=0)
        engine.step([], _TICS)
    except EngineError as error:
        sys.exit(str(error).splitlines()[0])
    finally:
        engine.close()


def _become_engine(wad: Path, directory: Path) -> NoReturn:
    """Replaces this process by an engine that loads everything there is in a file, plays nothing and ends."""
    os.chdir(directory)
    os.environ["HOME"] = str(directory)
    engine, resources = engine_directory() / "vizdoom", engine_directory() / "freedoom2.wad"
    hidden = ("+viz_window_hidden", "1", "+viz_noxserver", "1", "-nosound", "-nojoy")
    os.execv(engine, [str(engine), "-iwad", str(resources), "-file", str(wad), "-norun", *hidden])


if __name__ == "__main__":
    parent, file, output, limit, *rest = sys.argv[1:]
    _main(int(parent), file, output, float(limit), alone=rest == ["alone"])
