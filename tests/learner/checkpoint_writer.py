"""Lives of a process that writes checkpoints one after another, each ended by SIGKILL at a random moment.

`python checkpoint_writer.py DIRECTORY COUNT` prints a line of JSON for each life: what it found (`newest` checkpoint,
0 if none; `damage` told; whether the newest is `right`; whether the last life left something `unfinished`), and the
last checkpoint it `saved`. Lives are forks of a process that has imported all and used nothing, as an import takes
longer than the rest.
"""

import json
import os
import random
import signal
import sys
import time
from pathlib import Path

import numpy as np

from learner.checkpoint import Checkpointer, restore_newest

NUM_BYTES = 300_000


def arrays_of(step: int) -> dict[str, np.ndarray]:
    """Noise, which no compression makes smaller."""
    return {"noise": np.random.default_rng(step).integers(0, 256, NUM_BYTES, dtype=np.uint8)}


def live(run: Path, told: int) -> None:
    """Tells what it finds, then writes checkpoints until it is killed, and tells of each."""
    unfinished = any(run.glob("*/.writing-*"))
    restored = restore_newest(run / "checkpoints", arrays_of(0))
    newest = 0 if restored is None else restored.num_updates
    found = {"newest": newest, "unfinished": unfinished, "damage": [], "right": True}
    if restored is not None:
        right = np.array_equal(restored.arrays["noise"], arrays_of(newest)["noise"])
        found |= {"damage": restored.damage, "right": right and restored.host == {"step": newest}}
    os.write(told, json.dumps(found).encode() + b"\n")
    saver = Checkpointer(run, keep=2)
    for step in range(newest + 1, 10**6):
        saver.save(step, arrays_of(step), {"w": np.zeros(4, np.float32)}, {"step": step})
        saver.wait()
        assert saver.outcome() == ""
        os.write(told, f"{step}\n".encode())


def main(run: Path, count: int) -> None:
    rng = random.Random(0)
    first_s = next_s = 0.0  # how long a process's first save takes, and another one
    for number in range(count + 1):
        reading, writing = os.pipe()
        pid = os.fork()
        if pid == 0:
            os.close(reading)
            live(run, writing)
        os.close(writing)
        with os.fdopen(reading) as told:
            found, saved = json.loads(told.readline()), []
            start = time.monotonic()
            if number == 0:
                saved = [int(told.readline())]
                first_s = time.monotonic() - start
                saved += [int(told.readline())]
                next_s = time.monotonic() - start - first_s
            elif number < count and number % 2:
                saved = [int(told.readline())]
                time.sleep(rng.uniform(0.0, 2 * next_s))
            elif number < count:
                time.sleep(rng.uniform(0.0, first_s))
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
            saved += [int(line) for line in told]
        print(json.dumps({**found, "saved": max([found["newest"], *saved])}), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
