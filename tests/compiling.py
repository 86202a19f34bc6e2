"""How the tests' programs are compiled: most of the tests' processor time goes there. Imports jax.

Programs of tests that are marked isa are compiled as users have them; others with little optimization, which is quick.
"""

import os
from collections.abc import Callable, Hashable
from functools import cache, partial
from typing import Any

import jax
from jax._src import compiler


def _known(option: str) -> bool:
    """Whether this version of XLA has an option: another one would refuse to compile anything with it."""
    try:
        jax.jit(lambda: 0, compiler_options={option: False}).lower().compile()
    except jax.errors.JaxRuntimeError as error:
        if "No such compile option" not in str(error):
            raise
        return False
    return True


LITTLE = {name: False for name in ("xla_cpu_use_fusion_emitters",) if _known(name)}
"""beside jax_disable_most_optimizations: a large program compiles in less than half of the time and runs as fast"""
MUCH = {"xla_backend_optimization_level": 3, "xla_llvm_disable_expensive_passes": False, **dict.fromkeys(LITTLE, True)}
"""of a small program that runs for seconds"""

_options = compiler.get_compile_options
_flags = os.environ.get("XLA_FLAGS", "")


def prepare() -> None:
    """To be called once, before anything is compiled."""
    _options(1, 1)  # XLA reads its flags now; `optimize` changes them for other processes only
    compiler.get_compile_options = _get_compile_options


def optimize(much: bool) -> None:
    """From now on, here and in processes that are started."""
    jax.config.update("jax_disable_most_optimizations", not much)
    os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = str(int(not much))
    little = () if much else (f"--{name}={value}".lower() for name, value in LITTLE.items())
    os.environ["XLA_FLAGS"] = " ".join((_flags, *little)).strip()


@cache
def training_loop(train: Callable[..., Any], training: Hashable) -> Callable[..., Any]:
    """`train(training, ...)` as one program, a loop that runs for seconds.

    Without optimization where no instruction set is asked for: one seed takes two thirds of the time. It is XLA's
    optimized code that differs between instruction sets.
    """
    asked_for = "xla_cpu_max_isa" in os.environ.get("XLA_FLAGS", "")
    options = {} if asked_for else {"xla_backend_optimization_level": 0, **LITTLE}
    return jax.jit(partial(train, training), compiler_options=options)


def _get_compile_options(*args: Any, env_options_overrides: dict[str, Any] | None = None, **kwargs: Any) -> Any:
    much = not jax.config.read("jax_disable_most_optimizations")
    overrides = ({} if much else LITTLE) | (env_options_overrides or {})
    return _options(*args, env_options_overrides=overrides, **kwargs)
