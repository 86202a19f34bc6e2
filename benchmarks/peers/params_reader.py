"""Reads new versions of the parameters, and looks for them as often as a fast actor acts:
`python params_reader.py DESCRIPTOR NUM_PARAMS`."""

import sys
import time
from typing import Any

from serve import serve

from gvz.transport.broadcast import BroadcastReader

_STEP_S = 0.001
"""between two looks: an actor looks once a step"""


def main() -> None:
    """Attaches to the queue and serves."""
    reader = BroadcastReader.attach(int(sys.argv[1]), int(sys.argv[2]), 0)

    def read(seconds: float) -> dict[str, Any]:
        count, start = 0, time.perf_counter()
        while time.perf_counter() - start < seconds:
            count += reader.read() is not None
            time.sleep(_STEP_S)
        return {"count": count, "seconds": time.perf_counter() - start}

    serve(read)


if __name__ == "__main__":
    main()
