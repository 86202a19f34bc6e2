"""Reads new versions of the parameters, and looks for them as often as a fast actor acts:
`python params_reader.py DESCRIPTOR NUM_PARAMS`."""

import sys
import time

from serve import serve_rate

from gvz.transport.broadcast import BroadcastReader

_STEP_S = 0.001
"""between two looks: an actor looks once a step"""


def main() -> None:
    """Attaches to the queue and serves."""
    reader = BroadcastReader.attach(int(sys.argv[1]), int(sys.argv[2]), 0)

    def read() -> int:
        found = reader.read()
        time.sleep(_STEP_S)
        return found is not None

    serve_rate(read)


if __name__ == "__main__":
    main()
