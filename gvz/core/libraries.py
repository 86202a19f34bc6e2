"""Libraries: what the learner needs and an environment for the benchmark alone lacks; where all are imported from."""

import os
import sys
from importlib.util import find_spec
from pathlib import Path

from gvz.core.errors import ConfigError

LEARNER_LIBRARIES = ("jax", "jaxtyping", "chex", "flax", "optax", "orbax")


def require_learner(what: str) -> None:
    """Call it before the first import of the learner.

    Raises:
        ConfigError: `what` needs a library that is not installed.
    """
    missing = [name for name in LEARNER_LIBRARIES if find_spec(name) is None]
    if missing:
        raise ConfigError(
            f"{what} needs JAX and the other libraries of the learner; not installed here: {', '.join(missing)}; "
            "`pip install gvizdoom`, without --no-deps, installs them"
        )


def import_path() -> str:
    """Where this process imports from, as $PYTHONPATH of a process that it starts with `python -P -m`.

    Without the two, that process would import from the working directory first: a user's random.py in it would be
    executed. And it would not find what a program has put into sys.path.
    """
    return os.pathsep.join(str(Path(entry).absolute()) for entry in sys.path)
