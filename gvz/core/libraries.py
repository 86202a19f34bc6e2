"""The libraries of the learner, which an environment for the benchmark alone lacks."""

from importlib.util import find_spec

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
