"""The other end of `benchmarks/remote.py`: runs a body for every line of arguments. Standard library only, since every
peer's process imports it, whatever else is installed there.
"""

import importlib.metadata
import json
import sys
from collections.abc import Callable
from typing import Any


def serve(body: Callable[..., dict[str, Any]], *packages: str, **about: Any) -> None:
    """Says who this is, then answers each line of JSON arguments with the JSON of `body(**arguments)`.

    Args:
        body: what is measured.
        *packages: installed packages whose versions are told.
        **about: more to tell.
    """
    print(json.dumps({"versions": {name: importlib.metadata.version(name) for name in packages}, **about}), flush=True)
    for line in sys.stdin:
        print(json.dumps(body(**json.loads(line))), flush=True)
