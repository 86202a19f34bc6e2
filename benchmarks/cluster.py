"""Actor hosts: how many of them add up, what a record costs, how old parameters are, and how long a killed host lasts.

All of it is on one machine: a Ray cluster whose nodes are processes, over the loopback. Engines that sleep stand for
those of other machines, so that hosts can add up although they share this machine's cores. Games that show stored
frames at once give the rate and the processor time of the way to the learner. The frames are a real engine's, of
84x84x3 bytes. The parameters have the size of `rainbow_4task`'s and are published ten times a second; one publication a
second goes out. A host has one actor with four games.
"""

import contextlib
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.remote import Remote
from benchmarks.rounds import Budget, Row, goal, measured, ratios

NUM_FRAMES = 512
NUM_PARAMS = 6_800_000
SLEEP_S = 0.01
_BODY_TIMES, _SHORTEST_S = 4, 1.0
"""a body is this much longer than others: batches come a few a second"""


def measure(budget: Budget) -> list[Row]:
    """Rates, processor time, ages and times of recovery, by number of hosts and with or without compression."""
    numbers = (1, 2) if budget.quick else (1, 2, 4)
    rounds = range(budget.rounds if budget.quick else min(3, budget.rounds))
    seconds = max(_SHORTEST_S, budget.body_s * _BODY_TIMES)
    with tempfile.TemporaryDirectory(prefix="gvz-benchmark-") as directory:
        frames = _real_frames(Path(directory), 64 if budget.quick else NUM_FRAMES)
        words = (str(max(numbers)), str(frames), str(1000 if budget.quick else NUM_PARAMS))
        with Remote("ray_hosts", *words) as remote:

            def play(hosts: int, step_s: float, *, compress: bool = True, kill: bool = False) -> dict[str, Any]:
                return remote(hosts=hosts, compress=compress, step_s=step_s, seconds=seconds, kill=kill)

            asleep = {count: [play(count, SLEEP_S) for _ in rounds] for count in numbers}
            awake = {
                compress: [play(2, 0.0, compress=compress, kill=compress) for _ in rounds] for compress in (True, False)
            }
            remote()  # ends the cluster
    rows: list[Row] = []
    for count in numbers:
        rows.append(measured("records/s, engines that sleep", "1/s", _per_s(asleep[count]), x=count, x_unit="hosts"))
    for count in numbers[1:]:
        alone = [count * value for value in _per_s(asleep[1])]
        name = f"records/s of {count} hosts against {count} times one host, engines that sleep"
        rows.append(goal(13, name, ratios(_per_s(asleep[count]), alone), at_least=0.9))
    for compress, found in awake.items():
        how = "compressed" if compress else "not compressed"
        rows.append(measured(f"records/s, 2 hosts, {how}", "1/s", _per_s(found)))
        rows.append(measured(f"bytes a record, {how}", "B", [one["bytes"] / one["count"] for one in found]))
        for kind in ("host", "Ray", "learner"):
            used = [1e6 * one["processor_s"][kind] / one["count"] for one in found]
            rows.append(measured(f"processor time a record, {how}: {_PROCESSES[kind]}", "us", used))
    ages = [one["params_age_s"] for one in asleep[2]]
    rows.append(measured("age of the parameters that chose a decision when it arrives, 2 hosts", "s", ages))
    rows.append(measured("a killed host is noticed after", "s", [one["noticed_s"] for one in awake[True]]))
    rows.append(measured("the actors of its successor play after", "s", [one["recovered_s"] for one in awake[True]]))
    return rows


_PROCESSES = {"host": "the hosts", "Ray": "Ray's daemons", "learner": "the learner's process"}


def _per_s(found: list[dict[str, Any]]) -> list[float]:
    return [one["count"] / one["seconds"] for one in found]


def _real_frames(directory: Path, count: int) -> Path:
    """Frames of an engine, of one game played at random: a file of uint8[N, 84, 84, 3]."""
    import gvz

    rng, frames = np.random.default_rng(1), list[np.ndarray]()
    with contextlib.closing(gvz.make("defend_the_center/default")) as env:
        frame, _ = env.reset(seed=1)
        while len(frames) < count:
            frames.append(np.asarray(frame))
            frame, _, terminated, truncated, _ = env.step(int(rng.integers(3)))
            if terminated or truncated:
                frame, _ = env.reset()
    file = directory / "frames.npy"
    np.save(file, np.stack(frames))
    return file
