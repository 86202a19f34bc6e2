"""The other end of `benchmarks/remote.py`: runs a body for every line of arguments. Standard library only, because
every peer's process imports it.
"""

import importlib.metadata
import json
import sys
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
