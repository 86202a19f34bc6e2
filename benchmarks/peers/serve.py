"""The other end of `benchmarks/remote.py`: runs a body for every line of arguments. Standard library only, because
every peer's process imports it.
"""

import importlib.metadata
import json
import sys
import time
from collections.abc import Callable
from typing import Any


def serve(body: Callable[..., dict[str, Any]], *packages: str, **about: Any) -> None:
    """Prints a description of this process, then answers each line of JSON arguments with `body(**arguments)` as JSON.

    Args:
        body: the measured function.
        *packages: installed packages whose versions are reported.
        **about: further fields of the description.
    """
    print(json.dumps({"versions": {name: importlib.metadata.version(name) for name in packages}, **about}), flush=True)
    for line in sys.stdin:
        print(json.dumps(body(**json.loads(line))), flush=True)


def serve_rate(work: Callable[[], int], *packages: str, **about: Any) -> None:
    """Serves the rate of `work`, which is done again and again and returns how much it was; the rest as of `serve`."""

    def repeat(seconds: float) -> dict[str, Any]:
        count, start = 0, time.perf_counter()
        while time.perf_counter() - start < seconds:
            count += work()
        return {"count": count, "seconds": time.perf_counter() - start}

    serve(repeat, *packages, **about)


def serve_random_play(envs: Any, *packages: str, **about: Any) -> None:
    """Serves random play in a vector environment of Gymnasium, which is closed at the end; arguments as of `serve`."""
    envs.reset(seed=0)

    def play() -> int:
        envs.step(envs.action_space.sample())
        return envs.num_envs

    try:
        serve_rate(play, *packages, **about)
    finally:
        envs.close()
