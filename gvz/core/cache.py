"""The cache: compiled maps and compiled XLA programs, which can always be made again."""

import os
from pathlib import Path

from platformdirs import user_cache_path


def cache_directory() -> Path:
    """$GVZ_CACHE_DIR, or else the user's cache directory; it need not exist yet."""
    return Path(os.environ.get("GVZ_CACHE_DIR") or user_cache_path("gvizdoom")).absolute()


def xla_cache_directory() -> Path:
    """Compiled XLA programs, shared by learner and actors: some 10 s less at every start but the first.

    Machines of several processor generations may share it, as in a home directory on a network. The name of an entry
    holds XLA's fingerprint of the processor, so a machine reads only what was compiled for processors like its own
    (jax 0.10.2: the fingerprints of an emulated Haswell, an emulated EPYC and of each --xla_cpu_max_isa differ).
    """
    return Path(os.environ.get("JAX_COMPILATION_CACHE_DIR") or cache_directory() / "xla")
