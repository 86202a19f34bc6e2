"""Hardware, versions and commit, for records."""

import contextlib
import os
import platform
import subprocess
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import psutil

from gvz.core.control_groups import num_cores, own_groups

ROOT = Path(__file__).parents[2]
"""of a checkout, or where the packages are installed"""
PACKAGES = (
    *("gvizdoom", "vizdoom", "gymnasium", "jax", "jaxlib", "flax", "optax"),
    *("numpy", "opencv-python-headless", "onnxruntime"),
)
OWN_PACKAGES = ("gvz", "actors", "learner", "configs")
PROC = Path("/proc")
"""where Linux tells of processors and processes"""
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
    """The name that the processor reports."""
    return _cpuinfo("model name") or platform.processor() or platform.machine()


def instruction_set() -> str:
    """The largest of XLA's instruction sets on this processor, such as AVX512_BF16, and the limit of XLA_FLAGS."""
    flags = _cpuinfo("flags").split()
    found = [name for name, flag in _INSTRUCTION_SETS.items() if flag in flags]
    largest = found[-1] if found else platform.machine()
    given = os.environ.get("XLA_FLAGS", "").split()
    caps = [flag.partition("=")[2] for flag in given if flag.startswith("--xla_cpu_max_isa=")]
    return f"{largest}, at most {caps[-1]} by XLA_FLAGS" if caps else largest


def _cpuinfo(field: str) -> str:
    """The first value of a field of /proc/cpuinfo; empty if there is none."""
    lines = (PROC / "cpuinfo").read_text().splitlines() if (PROC / "cpuinfo").exists() else ()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(field)), "")


def describe() -> dict[str, Any]:
    """`hardware`, `versions` and `commit` in one map of JSON types."""
    return {**hardware(), "versions": versions(), "commit": commit()}


def hardware() -> dict[str, Any]:
    """JSON types: cpu, cores (`num_cores`), memory_bytes (of the machine), system, devices (JAX's)."""
    import jax

    return {
        "cpu": cpu_model(),
        "cores": num_cores(),
        "memory_bytes": psutil.virtual_memory().total,
        "system": f"{platform.system()} {platform.machine()}",
        "devices": [f"{device.platform}: {device.device_kind}" for device in jax.devices()],
    }


def available_memory() -> int:
    """Bytes that this process can still take of the machine's memory, within the limits of a container or batch job."""
    free = [int(psutil.virtual_memory().available)]
    for group in own_groups("memory"):
        with contextlib.suppress(OSError, ValueError):  # it has no limit, or another container has it
            free.append(_room_in(group))
    return max(0, min(free))


def _room_in(group: Path) -> int:
    """Bytes to the memory limit of a control group. What it holds of files gives way."""
    limit, used, prefix = "memory.max", "memory.current", ""
    if not (group / limit).exists():
        limit, used, prefix = "memory.limit_in_bytes", "memory.usage_in_bytes", "total_"
    lines = (line.split() for line in (group / "memory.stat").read_text().splitlines())
    files = sum(int(count) for name, count in lines if name in (f"{prefix}active_file", f"{prefix}inactive_file"))
    return int((group / limit).read_text()) - int((group / used).read_text()) + files


def free_device_memory() -> int | None:
    """Bytes that JAX can still take of this process's first device; None if it does not say, as on a CPU."""
    import jax

    stats = jax.local_devices()[0].memory_stats() or {}
    return stats["bytes_limit"] - stats["bytes_in_use"] if "bytes_limit" in stats else None


def versions(packages: Sequence[str] = PACKAGES) -> dict[str, str]:
    """Of Python and of those of the packages that are installed."""
    found = {"python": platform.python_version()}
    for name in packages:
        try:
            found[name] = version(name)
        except PackageNotFoundError:  # OpenCV, for one, comes under several names
            continue
    return found


def commit(measured: Sequence[str] = OWN_PACKAGES) -> str | None:
    """Of the checkout this runs from, 12 digits; None outside of one, or without git.

    With a change in one of the `measured` directories it ends in `+changes`.
    """
    if not (ROOT / ".git").exists():  # git would look further up, and find somebody else's repository
        return None
    try:
        head, changed = _git("rev-parse", "--short=12", "HEAD"), _git("status", "--porcelain", "--", *measured)
    except (OSError, subprocess.SubprocessError):
        return None
    return head + ("+changes" if changed else "")


def processor_s() -> float:
    """Processor time of this process and of all that it started, seconds.

    That of a process that ended counts if its parent waited for it: the time of games that were killed together with
    their actor is lost.
    """
    me, total_s = psutil.Process(), 0.0
    for process in (me, *me.children(recursive=True)):
        with contextlib.suppress(psutil.NoSuchProcess):  # it has ended meanwhile
            total_s += sum(process.cpu_times()[:4])  # user and system, own and of children that were waited for
    return total_s


def _git(*arguments: str) -> str:
    command = ["git", "-C", str(ROOT), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=_GIT_TIMEOUT_S, check=True)
    return done.stdout.strip()
