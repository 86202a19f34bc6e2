"""The checks of `gvz doctor`: what a machine must have for a run.

The engine and jax are tried in sub-processes, because a broken one can end its process.
"""

import dataclasses
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Any, Literal

from gvz.core import janitor
from gvz.core.cache import cache_directory
from gvz.core.control_groups import num_cores
from gvz.core.errors import GvzError, exit_text
from gvz.engine.tuned import TUNED, describe_engine
from gvz.engine.tuned.build_vizdoom import TUNED_VERSION
from gvz.run.footprint import ACTOR_MEMORY_BYTES, ENGINE_SHM_BYTES, LEARNER_MEMORY_BYTES, format_bytes
from gvz.run.machine import available_memory, instruction_set, versions

State = Literal["ok", "note", "bad"]
"""bad: runs will fail; note: runs work, but not as well as they could"""

TESTED_PYTHONS = ((3, 11), (3, 12), (3, 13))
_TRY_TIMEOUT_S = 280
_ENGINE = """
import time, gvz
begin = time.monotonic()
env = gvz.make("defend_the_center/default")
frame, info = env.reset(seed=1)
for _ in range(10):
    frame = env.step(0)[0]
env.close()
assert frame.any(), "the screen is black"
print(f"10 decisions of defend_the_center/default, started and ended in {time.monotonic() - begin:.1f} s")
"""
_DEVICES = """
import jax, jax.numpy as jnp
from learner.sharding import devices
devices(1)
assert float(jnp.ones(8).sum()) == 8.0
print(jax.default_backend(), "|", ", ".join(d.device_kind for d in jax.devices()))
"""
_LEARNER = """
import os
os.environ["JAX_PLATFORMS"] = "cpu"
from learner import selfcheck
selfcheck.main([])
"""


@dataclass(frozen=True, slots=True)
class Finding:
    """One check's outcome."""

    name: str
    state: State
    found: str
    remedy: str = ""
    """what to do about it, if anything"""


def check_python() -> Finding:
    """The interpreter."""
    found = f"{platform.python_version()} at {sys.executable}"
    if sys.version_info[:2] not in TESTED_PYTHONS:
        return Finding("python", "note", found, "tests run on 3.11 to 3.13; if something fails, try one of these")
    return Finding("python", "ok", found)


def check_system() -> Finding:
    """The operating system: /dev/shm, /proc and parent-death signals are Linux's."""
    found = f"{platform.system()} {platform.release()} {platform.machine()}"
    if platform.system() != "Linux":
        return Finding("system", "bad", found, "the trainer needs Linux (/dev/shm, prctl); use a container or WSL 2")
    return Finding("system", "ok", found)


def check_packages() -> Finding:
    """Every required package is installed."""
    try:
        wanted = [re.split(r"[ ;<>=!~\[]", line)[0] for line in requires("gvizdoom") or () if "extra ==" not in line]
    except PackageNotFoundError:
        remedy = "run `make install`, or `pip install .` in the checkout"
        return Finding("packages", "bad", "gvizdoom is not installed", remedy)
    if missing := sorted(set(wanted) - versions(wanted).keys()):
        remedy = f"pip install {' '.join(missing)}"
        return Finding("packages", "bad", f"missing: {', '.join(missing)}", remedy)
    shown = ", ".join(f"{name} {version(name)}" for name in ("gvizdoom", "vizdoom", "gymnasium", "jax"))
    return Finding("packages", "ok", f"{shown} and {len(wanted) - 3} more")


def check_cores() -> Finding:
    """Cores that this process can keep busy."""
    cores = num_cores()
    load = os.getloadavg()[0]
    found = f"{cores} of {os.cpu_count()}, load {load:.1f}"
    if cores < 2:
        return Finding("cores", "note", found, "learner and actors will share one core; give the process more")
    if load > len(os.sched_getaffinity(0)):
        return Finding("cores", "note", found, "other work is running; rates will be lower")
    return Finding("cores", "ok", found)


def check_memory() -> Finding:
    """Free memory, against the smallest run with one actor a core."""
    free = available_memory()
    need = LEARNER_MEMORY_BYTES + num_cores() * ACTOR_MEMORY_BYTES
    found = f"{format_bytes(free)} available; a small run takes {format_bytes(need)}"
    if free < need:
        remedy = "end other programs, or train with --actors.num-actors 1 and a smaller --replay.capacity"
        return Finding("memory", "bad", found, remedy)
    return Finding("memory", "ok", found)


def check_shared_memory() -> Finding:
    """Free space in /dev/shm, against four games a core."""
    free = shutil.disk_usage(janitor.SHM_DIR).free
    games = 4 * num_cores()
    taken = games * ENGINE_SHM_BYTES
    need = taken + 64 * 2**20
    found = f"{format_bytes(free)} free, want {format_bytes(need)}: {games} games take {format_bytes(taken)}"
    if free < need:
        size = -(-need // 2**20)
        remedy = f"docker run --shm-size={size}m ..., or as root: mount -o remount,size={size}m /dev/shm"
        return Finding("/dev/shm", "bad", found, remedy)
    return Finding("/dev/shm", "ok", found)


def check_temporary_directory() -> Finding:
    """Engines are launched from a script in the temporary directory."""
    directory = Path(tempfile.gettempdir())
    with tempfile.TemporaryDirectory(prefix="gvz-doctor-") as inside:
        script = Path(inside) / "run"
        script.write_text("#!/bin/sh\nexit 0\n")
        script.chmod(0o700)
        try:
            subprocess.run([script], check=True, timeout=10)
        except (OSError, subprocess.SubprocessError) as error:
            remedy = "it may be mounted noexec: set TMPDIR to a directory that may hold programs"
            return Finding("tmp", "bad", f"{directory}: {error}", remedy)
    return Finding("tmp", "ok", f"{directory}, {format_bytes(shutil.disk_usage(directory).free)} free")


def check_cache() -> Finding:
    """Compiled maps and XLA programs are kept between starts."""
    directory = cache_directory()
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=directory):
            pass
    except OSError as error:
        remedy = "set GVZ_CACHE_DIR to a directory you can write to"
        return Finding("cache", "bad", f"{directory}: {error.strerror}", remedy)
    return Finding("cache", "ok", str(directory))


def check_engine() -> Finding:
    """ViZDoom, as released or tuned (docs/ENGINE.md), starts and plays one of our maps."""
    remedy = "the line above is the engine's own; it often lacks a system library: see ViZDoom's installation page"
    try:
        installed = version("vizdoom")
    except PackageNotFoundError:
        return Finding("vizdoom", "bad", "not installed", "run `make install`")
    if TUNED in installed:
        remedy += "; or go back to the released engine (docs/ENGINE.md)"
    finding = _try("vizdoom", _ENGINE, remedy)
    finding = dataclasses.replace(finding, found=f"{describe_engine(installed)}: {finding.found}")
    if finding.state == "ok" and TUNED in installed and installed != TUNED_VERSION:
        remedy = f"the patches here make {TUNED_VERSION}: run `make engine` again"
        return dataclasses.replace(finding, state="note", remedy=remedy)
    return finding


def check_devices() -> Finding:
    """JAX computes, and on what."""
    finding = _try("jax", _DEVICES, "reinstall jax; for a GPU: `make install-cuda` and a driver that CUDA 12 accepts")
    if finding.state == "ok" and finding.found.startswith("cpu") and shutil.which("nvidia-smi"):
        remedy = "there is an NVIDIA driver but JAX does not use it: `make install-cuda`"
        return Finding("jax", "note", finding.found, remedy)
    return finding


def check_learner() -> Finding:
    """The learner computes what it should on this processor (learner/selfcheck.py), by its instruction set."""
    remedy = "send this line and those of system and packages with your question: scores of this machine may be wrong"
    finding = _try("learner", _LEARNER, remedy)
    return dataclasses.replace(finding, found=f"{instruction_set()}: {finding.found}")


def check_video() -> Finding:
    """`gvz record` writes mp4 by FFmpeg's libraries, which PyAV brings along; GIF and WebP need nothing."""
    remedy = "pip install 'gvizdoom[video]', or record to .gif or .webp"
    finding = _try("video", "import av; av.Codec('libx264', 'w'); print(f'PyAV {av.__version__}')", remedy)
    return dataclasses.replace(finding, state="note") if finding.state == "bad" else finding


def check_leftovers() -> Finding:
    """What dead runs left behind."""
    dead = janitor.dead_instances()
    if dead:
        shown = ", ".join(dead[:3]) + (f" and {len(dead) - 3} more" if len(dead) > 3 else "")
        return Finding("leftovers", "note", f"{len(dead)}: {shown}", "gvz doctor --clean (the next run does it, too)")
    return Finding("leftovers", "ok", "none")


CHECKS: tuple[Callable[[], Finding], ...] = (
    *(check_system, check_python, check_packages, check_cores, check_memory, check_shared_memory),
    *(check_temporary_directory, check_cache, check_leftovers, check_engine, check_devices, check_learner),
    check_video,
)
"""each after those that it depends on"""


def findings(checks: Iterable[Callable[..., Finding]], *arguments: Any) -> Generator[Finding]:
    """What checks find, one after the other. One that cannot be made is bad, and the next ones are made."""
    for check in checks:
        try:
            yield check(*arguments)
        except (GvzError, OSError) as error:
            yield Finding(check.__name__.removeprefix("check_"), "bad", str(error))


def show(findings: Iterable[Finding], *, json_lines: bool) -> int:
    """Prints findings as they come; returns the exit code: 1 if one is bad."""
    bad = False
    for finding in findings:
        bad |= finding.state == "bad"
        if json_lines:
            print(json.dumps(dataclasses.asdict(finding)), flush=True)
            continue
        print(f"{finding.state:5} {finding.name:10} {finding.found}", flush=True)
        if finding.remedy:
            print(f"{'':16} -> {finding.remedy}")
    return int(bad)


def _try(name: str, code: str, remedy: str) -> Finding:
    """Runs code in a process of its own, whose last line is the finding."""
    command = [sys.executable, "-c", code]
    environment = {**os.environ, "JAX_TRACEBACK_FILTERING": "off"}  # else its last line is about the traceback
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=_TRY_TIMEOUT_S, env=environment, check=False
        )
    except subprocess.TimeoutExpired:
        return Finding(name, "bad", f"no answer within {_TRY_TIMEOUT_S} s", remedy)
    finally:
        janitor.clean_dead_instances()  # a crashed process cleans up nothing
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        return Finding(name, "bad", f"{exit_text(done.returncode)}: {last}", remedy)
    return Finding(name, "ok", done.stdout.strip().splitlines()[-1])
