"""Two builds of ViZDoom beside each other: are their games the same, and how fast are they?

    python -m benchmarks.engines equal [--decisions N] [--out FILE]
    python -m benchmarks.engines speed [--rounds N] [--out FILE]

Both processes have our interpreter and our modules; only the package of vizdoom differs. `--stock` and `--tuned` are
directories that hold one (`pip install --target DIR --no-deps ...`). By default stock is the released version of the
installed package, which pip puts into the cache, and tuned is the installed one.
"""

import itertools
import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import tyro

from benchmarks import record
from benchmarks.remote import Remote, RemoteError
from benchmarks.rounds import alternate, ratios, spread
from gvz.core.cache import cache_directory
from gvz.core.errors import ConfigError, GvzError
from gvz.tasks import named_tasks

FRAME_SKIPS = (1, 4, 7, 33)
BUFFERS = ("depth", "labels", "automap")
OTHER_FORMATS = (*("CRCGCB", "RGBA32", "ARGB32", "CBCGCR", "BGR24", "BGRA32", "ABGR32", "GRAY8", "DOOM_256_COLORS8"),)
"""beside RGB24, which our environments use"""
_TASK = "defend_the_center/default"
_BODY_DECISIONS = 2000


@dataclass(frozen=True, kw_only=True)
class Engines:
    """The two builds."""

    stock: Path | None = None
    """directory that holds the released package; by default pip puts it into the cache"""
    tuned: Path | None = None
    """directory that holds the other package; by default the installed one is taken"""


@dataclass(frozen=True, kw_only=True)
class Equal(Engines):
    """Play the same decisions with both and compare all that a player can read. Exit code 1: not equal."""

    decisions: int = 200_000
    """at least this many, over all tasks, frame skips, screen formats and buffers"""
    seed: int = 0
    """of actions, episodes and time-outs"""
    out: Path = record.ROOT / "results" / "engine" / "equality.json"
    """the record"""


@dataclass(frozen=True, kw_only=True)
class Speed(Engines):
    """Measure both in turns on one core: bare engines, and whole environments."""

    rounds: int = 9
    """alternating rounds of 2,000 decisions each"""
    core: int = field(default_factory=lambda: max(os.sched_getaffinity(0)))
    """that engine and Python run on"""
    out: Path = record.ROOT / "results" / "engine" / "speed.json"
    """the record"""


def jobs(decisions: int, seed: int) -> list[dict[str, Any]]:
    """What is played, as arguments of `engine_player.play`: every named task with every frame skip, in RGB24 without
    buffers, in RGB24 with all of them, and in one of the other screen formats with no buffer or one.
    """
    other = zip(itertools.cycle(OTHER_FORMATS), itertools.cycle(((), *((name,) for name in BUFFERS))), strict=False)
    chosen = [
        (task.id, screen_format, buffers)
        for task in named_tasks()
        for screen_format, buffers in (("RGB24", ()), ("RGB24", BUFFERS), next(other))
    ]
    fixed = {"frame_skips": FRAME_SKIPS, "decisions": -(-decisions // len(chosen))}
    return [
        {"task": task, "screen_format": screen_format, "buffers": buffers, "seed": seed + number, **fixed}
        for number, (task, screen_format, buffers) in enumerate(chosen)
    ]


def equal(options: Equal) -> int:
    """Compares and writes the record; returns the exit code."""
    start, planned = time.monotonic(), jobs(options.decisions, options.seed)
    played, differing = 0, list[dict[str, Any]]()
    ends = {"deaths": 0, "timeouts": 0, "inside": 0}
    with ExitStack() as stack:
        players = [stack.enter_context(player) for player in _start(options, "engine_player")]
        packages = [player.about["versions"]["vizdoom"] for player in players]
        for number, job in enumerate(planned):
            for player in players:
                player.ask(**job)
            stock, tuned = [player.answer() for player in players]
            played += len(stock["digests"])
            ends = {name: count + stock[name] for name, count in ends.items()}
            pairs = zip(stock["digests"], tuned["digests"], strict=True)
            if different := [place for place, (a, b) in enumerate(pairs) if a != b]:
                differing.append({**job, "first": different[0], "different": len(different)})
                print(f"different: {differing[-1]}", flush=True)
            if (number + 1) % 20 == 0 or number + 1 == len(planned):
                print(f"{played:,} decisions, {len(differing)} of {number + 1} sequences differ", flush=True)
    found = {
        "decisions": played,
        "sequences": len(planned),
        "differing": differing,
        "episode_ends": ends,
        "frame_skips": FRAME_SKIPS,
        "screen_formats": ("RGB24", *OTHER_FORMATS),
        "buffers": BUFFERS,
    }
    _write(options.out, "engine equality", packages, time.monotonic() - start, found)
    return 1 if differing else 0


def speed(options: Speed) -> int:
    """Measures and writes the record; returns the exit code."""
    start = time.monotonic()
    found: dict[str, Any] = {"task": _TASK, "frame_skip": 4, "render": "256x144 RGB24", "rounds": options.rounds}
    packages: list[str] = []
    for body in ("bare", "environment"):
        with ExitStack() as stack:
            players = [stack.enter_context(p) for p in _start(options, "engine_speed", body, _TASK, str(options.core))]
            packages = [player.about["versions"]["vizdoom"] for player in players]
            named = zip(("stock", "tuned"), players, strict=True)
            bodies = {name: partial(player, decisions=_BODY_DECISIONS) for name, player in named}
            rows = alternate(options.rounds, bodies)
        units = ("decisions_per_s", "engine_us", "python_us", "decisions_per_core_s")
        values = {name: {unit: [row[unit] for row in rows[name]] for unit in units} for name in rows}
        found[body] = {name: {unit: spread(v) for unit, v in units.items()} for name, units in values.items()}
        for unit in ("decisions_per_s", "decisions_per_core_s"):
            gain = spread(ratios(values["tuned"][unit], values["stock"][unit]))
            found[body][f"gain_{unit}"] = gain
            print(f"{body}, {unit}: {gain['median']} [{gain['min']}, {gain['max']}] times", flush=True)
    _write(options.out, "engine speed", packages, time.monotonic() - start, found)
    return 0


def _start(options: Engines, script: str, *arguments: str) -> list[Remote]:
    """Stock's process and tuned's."""
    places = [options.stock or released(), options.tuned]
    remotes: list[Remote] = []
    for place in places:
        if place is not None and not (place / "vizdoom").is_dir():
            raise ConfigError(f"{place}: holds no package vizdoom; pip install --target {place} --no-deps vizdoom")
        path = os.pathsep.join(str(part) for part in (place, record.ROOT) if part is not None)
        remotes.append(Remote(script, *arguments, environment={"PYTHONPATH": path}))
    return remotes


def released() -> Path:
    """A directory in the cache with the released version of the installed vizdoom; pip fills it once."""
    wanted = version("vizdoom").partition("+")[0]
    place = cache_directory() / f"vizdoom-{wanted}-released"
    if not (place / "vizdoom").is_dir():
        pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps"]
        done = subprocess.run(
            [*pip, "--only-binary", ":all:", "--target", str(place), f"vizdoom=={wanted}"], check=False
        )
        if done.returncode:
            raise ConfigError(
                f"pip could not put vizdoom {wanted} into {place}; give the directory of one with --stock"
            )
    return place


def _write(out: Path, name: str, packages: list[str], seconds: float, found: Mapping[str, Any]) -> None:
    from gvz.run import machine

    stock, tuned = packages
    head = {
        "benchmark": name,
        "stock": stock,
        "tuned": tuned,
        "commit": record.describe_commit(),
        "date": time.strftime("%Y-%m-%d %H:%M", time.gmtime()),
        "seconds": round(seconds, 1),
        "machine": {"cpu": machine.cpu_model(), "cores": os.cpu_count(), "load_at_end": list(os.getloadavg())},
    }
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(json.dumps({**head, **found}, indent=2) + "\n")
    print(f"-> {out}")


def main() -> int:
    """Runs the command; returns the exit code: 0 done, 1 not equal, 2 bad input."""
    commands = Annotated[Equal, tyro.conf.subcommand("equal")] | Annotated[Speed, tyro.conf.subcommand("speed")]
    options: Equal | Speed = tyro.cli(commands, prog="python -m benchmarks.engines")
    try:
        return equal(options) if isinstance(options, Equal) else speed(options)
    except (GvzError, RemoteError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
