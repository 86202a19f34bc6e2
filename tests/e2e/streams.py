"""Proof from a run's last checkpoint that nothing was lost: its replay, game by game, against what the run recorded.

Records and episodes come to the learner on two ways (shared memory, a socket). Where an episode's length and reward
are the same on both, no record of it was lost, repeated or torn.
"""

from dataclasses import dataclass
from pathlib import Path

import msgpack
import numpy as np
from command import arrays_of, rows

from gvz.core.durable import saved_steps
from learner.checkpoint import verify

_FIELDS = ("reward", "task", "first", "last", "terminated")


@dataclass(frozen=True, kw_only=True)
class Streams:
    """What was found in the streams of a run.

    Attributes:
        num_records: step records, over all games.
        num_matched: episodes that are the same in the replay and in episodes.jsonl.
        unrecorded: per game, episodes of the replay of which episodes.jsonl knows nothing: their actor died.
        rows: episodes.jsonl.
    """

    num_records: int
    num_matched: int
    unrecorded: list[int]
    rows: list[dict]


def check_streams(run: Path, num_lanes: int, num_tasks: int) -> Streams:
    """Checks every record in the replay of a run's last checkpoint, which must hold all the records of the run."""
    checkpoint = run / "checkpoints" / str(saved_steps(run / "checkpoints")[-1])
    verify(checkpoint)
    counts = msgpack.unpackb((checkpoint / "host.msgpack").read_bytes())["counts"]
    arrays = arrays_of(checkpoint)
    replay = {name: arrays[f"['replay'].store.{name}"] for name in (*_FIELDS, "heads")}
    episodes = rows(run, "episodes.jsonl")
    assert len({(row["lane"], row["episode"]) for row in episodes}) == len(episodes), "an episode was recorded twice"
    capacity = len(replay["task"]) // num_lanes
    num_records = num_last = num_matched = 0
    unrecorded = []
    for lane in range(num_lanes):
        head = int(replay["heads"][lane])
        mine = {name: replay[name][lane * capacity :][:capacity] for name in _FIELDS}
        assert (mine["task"][:head] == lane % num_tasks).all()
        assert (mine["task"][head:] == num_tasks).all(), "the replay is too small to hold the whole run"
        stored = {name: array[:head] for name, array in mine.items()}
        assert stored["first"][0]
        np.testing.assert_array_equal(stored["first"][1:], stored["last"][:-1])  # one unbroken stream
        assert (stored["last"] >= stored["terminated"]).all()
        assert (stored["reward"][stored["first"]] == 0).all()
        known = sorted((row for row in episodes if row["lane"] == lane), key=lambda row: row["episode"])
        matched, missing = _match(stored, known)
        # the last one's records may still be on their way
        assert matched >= len(known) - 1, "an episode is not in the replay as it was recorded"
        num_records, num_last = num_records + head, num_last + int(stored["last"].sum())
        num_matched += matched
        unrecorded.append(missing)
    assert num_records == counts["records"]
    assert num_records - num_last <= counts["env_steps"] <= num_records - num_last + sum(unrecorded) + num_lanes
    return Streams(num_records=num_records, num_matched=num_matched, unrecorded=unrecorded, rows=episodes)


def _match(stored: dict[str, np.ndarray], known: list[dict]) -> tuple[int, int]:
    """Finds each recorded episode of a game in its stream, in their order: how many, and how many others there are."""
    starts = np.flatnonzero(stored["first"])
    ends = np.append(starts[1:], len(stored["first"]))
    rewards = np.add.reduceat(stored["reward"], starts)
    played = list(zip(ends - starts - 1, rewards, ends, strict=True))
    found = []
    for row in known:
        after = found[-1] + 1 if found else 0
        found += [at for at in range(after, len(played)) if _is(row, stored, *played[at])][:1]
    ended = stored["last"][ends - 1]
    until = found[-1] + 1 if found else 0
    before, after = int(ended[:until].sum()), int(ended[until:].sum())
    return len(found), before - len(found) + max(0, after - 1)  # of the last one it may just not have been told


def _is(row: dict, stored: dict[str, np.ndarray], length_steps: int, reward: float, end: int) -> bool:
    return (
        row["length_steps"] == length_steps
        and abs(row["reward"] - reward) < 1e-3
        and bool(stored["last"][end - 1])
        and row["terminated"] == stored["terminated"][end - 1]
    )
