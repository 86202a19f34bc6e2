"""What something was computed on and with, for records: hardware, versions, commit."""

import os
import platform
import subprocess
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import psutil

ROOT = Path(__file__).parents[2]
"""of a checkout, or where the packages are installed"""
PACKAGES = ("gvizdoom", "vizdoom", "gymnasium", "jax", "jaxlib", "flax", "optax", "numpy", "opencv-python-headless")
MEASURED = ("gvz", "actors", "learner", "configs")
_GIT_TIMEOUT_S = 30
_INSTRUCTION_SETS = {
    "SSE4_2": "sse4_2",
    "AVX": "avx",
    "AVX2": "avx2",
    "AVX512": "avx512f",
    "AVX512_VNNI": "avx512_vnni",
    "AVX512_BF16": "avx512_bf16",
    "AMX": "amx_bf16",
    "AMX_FP16": "amx_fp16",
}
"""values of XLA's flag --xla_cpu_max_isa, smallest first, and the processor flag that stands for each"""


def cpu_model() -> str:
    """As the processor calls itself."""
    file = Path("/proc/cpuinfo")
    lines = file.read_text().splitlines() if file.exists() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()


def instruction_set(cpuinfo: str | None = None, xla_flags: str | None = None) -> str:
    """The largest of XLA's instruction sets on this processor, such as AVX512_BF16; what XLA_FLAGS caps it at is told.

    Args:
        cpuinfo: text of /proc/cpuinfo; default this machine's.
        xla_flags: default the environment's XLA_FLAGS.
    """
    file = Path("/proc/cpuinfo")
    text = (file.read_text() if file.exists() else "") if cpuinfo is None else cpuinfo
    flags = next((line.partition(":")[2].split() for line in text.splitlines() if line.startswith("flags")), [])
    found = [name for name, flag in _INSTRUCTION_SETS.items() if flag in flags]
    largest = found[-1] if found else platform.machine()
    given = (os.environ.get("XLA_FLAGS", "") if xla_flags is None else xla_flags).split()
    caps = [flag.partition("=")[2] for flag in given if flag.startswith("--xla_cpu_max_isa=")]
    return f"{largest}, at most {caps[-1]} by XLA_FLAGS" if caps else largest


def describe() -> dict[str, Any]:
    """`hardware`, `versions` and `commit` in one map of JSON types."""
    return {**hardware(), "versions": versions(), "commit": commit()}


def hardware() -> dict[str, Any]:
    """JSON types: cpu, cores (that this process may use), memory_bytes (of the machine), system, devices (JAX's)."""
    import jax

    return {
        "cpu": cpu_model(),
        "cores": len(os.sched_getaffinity(0)),
        "memory_bytes": psutil.virtual_memory().total,
        "system": f"{platform.system()} {platform.machine()}",
        "devices": [f"{device.platform}: {device.device_kind}" for device in jax.devices()],
    }


def versions(packages: Sequence[str] = PACKAGES) -> dict[str, str]:
    """Of Python and of those of the packages that are installed."""
    found = {"python": platform.python_version()}
    for name in packages:
        try:
            found[name] = version(name)
        except PackageNotFoundError:  # OpenCV, for one, comes under several names
            continue
    return found


def commit(measured: Sequence[str] = MEASURED) -> str | None:
    """Of the checkout this runs from, 12 digits; None outside of one, or without git.

    Args:
        measured: directories of the checkout; with a change in one of them the commit ends in `+changes`.
    """
    if not (ROOT / ".git").exists():  # git would look further up, and find somebody else's repository
        return None
    try:
        head, changed = _git("rev-parse", "--short=12", "HEAD"), _git("status", "--porcelain", "--", *measured)
    except (OSError, subprocess.SubprocessError):
        return None
    return head + ("+changes" if changed else "")


def _git(*arguments: str) -> str:
    command = ["git", "-C", str(ROOT), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=_GIT_TIMEOUT_S, check=True)
    return done.stdout.strip()
