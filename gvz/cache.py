"""Where things are kept that can always be made anew: compiled maps and compiled XLA programs. Tier 0."""

import os
from pathlib import Path

from platformdirs import user_cache_path


def cache_directory() -> Path:
    """$GVZ_CACHE_DIR, or else the user's cache directory; it need not exist yet."""
    return Path(os.environ.get("GVZ_CACHE_DIR") or user_cache_path("gvizdoom"))


def xla_cache_directory() -> Path:
    """Compiled XLA programs, shared by learner and actors: some 10 s less at every start but the first."""
    return Path(os.environ.get("JAX_COMPILATION_CACHE_DIR") or cache_directory() / "xla")
