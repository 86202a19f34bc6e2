"""What something was computed on and with, for records: hardware, versions, commit. Imports psutil; jax once asked."""

import os
import platform
import subprocess
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import psutil

ROOT = Path(__file__).parent.parent
"""of a checkout, or where the packages are installed"""
PACKAGES = ("gvizdoom", "vizdoom", "gymnasium", "jax", "jaxlib", "flax", "optax", "numpy", "opencv-python-headless")
MEASURED = ("gvz", "actors", "learner", "configs")
_GIT_TIMEOUT_S = 30


def cpu_model() -> str:
    """As the processor calls itself."""
    file = Path("/proc/cpuinfo")
    lines = file.read_text().splitlines() if file.exists() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()


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
