"""The rate of float32 matrix products on one core, with the settings of an actor's process: `python cpu_matmul.py`."""

import time
from typing import Any

import jax
import jax.numpy as jnp
from serve import serve

_SIZE = 768


def main() -> None:
    """Compiles the product and serves."""
    product = jax.jit(lambda a, b: a @ b)
    a = jnp.ones((_SIZE, _SIZE), jnp.float32) / _SIZE
    product(a, a).block_until_ready()

    def multiply(seconds: float) -> dict[str, Any]:
        count, x, start = 0, a, time.perf_counter()
        while time.perf_counter() - start < seconds:
            x = product(x, a).block_until_ready()
            count += 2 * _SIZE**3
        return {"count": count, "seconds": time.perf_counter() - start}

    serve(multiply, "jax")


if __name__ == "__main__":
    main()
