"""The rate of float32 matrix products on one core, with the settings of an actor's process: `python cpu_matmul.py`."""

import jax
import jax.numpy as jnp
from serve import serve_rate

_SIZE = 768


def main() -> None:
    """Compiles the product and serves."""
    product = jax.jit(lambda a, b: a @ b)
    a = jnp.ones((_SIZE, _SIZE), jnp.float32) / _SIZE
    product(a, a).block_until_ready()

    def multiply() -> int:
        product(a, a).block_until_ready()
        return 2 * _SIZE**3

    serve_rate(multiply, "jax")


if __name__ == "__main__":
    main()
