"""The soak of actor hosts: a run plays on a Ray cluster of this machine while its hosts are killed one after the other.

    python -m benchmarks.hosts_soak                                  # 20 minutes, a kill every 30 s
    python -m benchmarks.hosts_soak --minutes 2 --kill-every-s 20 --out soak.json

The run is the real command with real engines. Hosts get a SIGKILL, the oldest first. At the end SIGTERM stops the run.
Every kill must have been noticed, every lane must have gone on, and no episode may be in the records twice. What the
run and the cluster have left behind is counted: processes, files in /dev/shm, private directories.
"""

import json
import signal
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro
from rich.console import Console

from benchmarks.soak import DIRECTORY, KINDS, Watched, about, growth, processes, ticks
from gvz.core import janitor, records
from gvz.run import machine

if TYPE_CHECKING:
    from tests.cluster.conftest import RayCluster

_STOP_TIMEOUT_S, _CLEARED_S, _MENDED_S = 120.0, 60.0, 120.0


@dataclass(frozen=True, kw_only=True)
class HostsSoak:
    """Run the main job on actor hosts while these are killed; record losses and what is left."""

    minutes: float = 20.0
    """length of the stretch with kills"""
    kill_every_s: float = 30.0
    """seconds between two kills"""
    hosts: int = 3
    """each on a node of its own, with one actor of four games"""
    sample_s: float = 5.0
    """seconds between two samples"""
    out: Path = DIRECTORY / "hosts_soak.json"
    """file of the record"""
    flags: tyro.conf.Positional[tuple[str, ...]] = ()
    """further words for `python -m gvz.launch --config rainbow_4task.py`, after a `--`"""


def soak(options: HostsSoak, cluster: "RayCluster", console: Console) -> dict[str, Any]:
    """Runs the whole soak on a cluster of this process with enough nodes; returns the record."""
    head = about("hosts_soak", options, (*machine.PACKAGES, "ray", "zstandard"))
    hosts = f"--actors.num-actors 1 --actors.games-per-actor 4 --cluster.hosts {options.hosts}".split()
    words = [*hosts, "--cluster.address", cluster.address, *options.flags]
    with tempfile.TemporaryDirectory(prefix="gvz-soak-") as directory:
        run = Watched(Path(directory) / "run", words, cluster.environment)
        samples: list[dict[str, float]] = []
        kills: list[float] = []
        try:
            run.wait_for_updates()
            console.print(f"warm; {options.minutes:g} minutes of kills begin")
            begin = time.time()
            for now in ticks(options.minutes * 60, options.sample_s):
                run.check()
                samples.append({"time_s": round(now, 1), **run.sample(), **_counts()})
                if now >= options.kill_every_s * (len(kills) + 1) and (victims := processes("host")):
                    victims[0].kill()  # the oldest, so that they take turns
                    kills.append(round(time.time() - begin, 1))
                    console.print(f"{now / 60:5.1f} min  {len(kills)} kills, {_restarts(run)} hosts replaced")
            deadline = time.monotonic() + _MENDED_S
            while _restarts(run) < len(kills) or run.metrics()[-1]["cluster/hosts"] < options.hosts:
                run.check()
                if time.monotonic() > deadline:
                    break
                time.sleep(1.0)
            run.process.send_signal(signal.SIGTERM)
            code = run.process.wait(_STOP_TIMEOUT_S)
        finally:
            run.close()
        rows, problems = records.read(run.directory / "metrics.jsonl")
        faults, _ = records.read(run.directory / "faults.jsonl")
        episodes, damaged = records.read(run.directory / "episodes.jsonl")
        repeated = sum(count - 1 for count in Counter((row["lane"], row["episode"]) for row in episodes).values())
        last = rows[-1]
        return {
            **head,
            "kills": kills,
            "samples": {name: [sample[name] for sample in samples] for name in samples[0]},
            "faults": dict(Counter(fault["kind"] for fault in faults)),
            "host_restarts": int(last["cluster/host_restarts"]),
            "cut_episodes": int(last["cluster/cut_episodes"]),
            "dropped_records": int(last["cluster/dropped_records"]),
            "updates": last["num_updates"],
            "env_steps": last["actors/env_steps"],
            "episodes": len(episodes),
            "repeated_episodes": repeated,
            "exit_code": code,
            "damaged_rows": len(problems) + len(damaged),
            "left_behind": _left_behind(run),
        }


def table(made: dict[str, Any] | None) -> str:
    """The record as docs/RELIABILITY.md shows it."""
    if made is None:
        return "There is no record of this soak; `python -m benchmarks.hosts_soak` makes one."
    machine_of, samples = made["machine"], made["samples"]
    grows = {"learner_bytes": "resident memory of the learner", "learner_descriptors": "its descriptors"}
    return "\n".join(
        [
            f"*{made['date']} UTC, commit {made['commit']}, `{made['command']}`; {machine_of['cpu']}, "
            f"{machine_of['cores']} cores.*",
            "",
            "| | |",
            "|---|---|",
            f"| hosts killed (SIGKILL) | {len(made['kills'])} in {made['settings']['minutes']:g} minutes |",
            f"| hosts replaced, as the run counted | {made['host_restarts']} |",
            f"| episodes cut, of those that ended | {made['cut_episodes']} of {made['episodes']:,} |",
            f"| episodes played twice | {made['repeated_episodes']} |",
            f"| records that came too late and were dropped | {made['dropped_records']} |",
            f"| gradient steps, decisions | {made['updates']:,}, {made['env_steps']:,} |",
            f"| damaged rows in the records | {made['damaged_rows']} |",
            *(f"| {text}, last fifth / first fifth | {growth(samples[name]):.3f} |" for name, text in grows.items()),
            f"| exit code after SIGTERM | {made['exit_code']} |",
            f"| left behind | {', '.join(made['left_behind']) or 'nothing'} |",
        ]
    )


def _counts() -> dict[str, float]:
    return {f"{kind}s": len(processes(kind)) for kind in KINDS.values()}


def _restarts(run: Watched) -> int:
    return int(run.metrics()[-1]["cluster/host_restarts"])


def _left_behind(run: Watched) -> list[str]:
    """Of the ended run, on all nodes, a minute later at the latest."""
    deadline = time.monotonic() + _CLEARED_S
    while (left := [*map(str, processes()), *janitor.dead_instances()]) and time.monotonic() < deadline:
        time.sleep(1.0)
    return left + run.left_behind()


def main() -> int:
    """Entry point; returns the exit code."""
    options = tyro.cli(HostsSoak, prog="python -m benchmarks.hosts_soak")
    from tests.cluster.conftest import RayCluster

    cluster = RayCluster(1 + options.hosts, num_cores=1)
    try:
        made = soak(options, cluster, Console())
    finally:
        cluster.close()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(made, indent=1) + "\n")
    print(table(made))
    lost = made["host_restarts"] < len(made["kills"]) or made["repeated_episodes"] or made["damaged_rows"]
    return 0 if made["exit_code"] == 128 + signal.SIGTERM and not made["left_behind"] and not lost else 1


if __name__ == "__main__":
    sys.exit(main())
