"""The soak: the main job at full speed while its actors are killed one after the other for an hour.

    python -m benchmarks.soak                      # 60 minutes of kills, a kill every 20 s; record, page and plot
    python -m benchmarks.soak --minutes 6 --stretches 1 --out soak.json

The run is the real command. Stretches with kills alternate with short undisturbed ones. The cost of the kills is the
ratio of a stretch's speed to that of the stretches beside it, because the machine's own speed drifts. Memory,
descriptors, shared memory and processes are sampled throughout. At the end SIGTERM stops the run, and the files that it
left behind are counted.
"""

import contextlib
import json
import shlex
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import psutil
import tyro
from rich.console import Console

from benchmarks import record
from benchmarks.whole import end_run, tree_bytes
from gvz.core import janitor, records
from gvz.run import machine

SCHEMA = 1
"""of all records in DIRECTORY, also those of the fuzzing"""
DIRECTORY = record.ROOT / "results" / "reliability"
_START_TIMEOUT_S, _STOP_TIMEOUT_S, _CLEARED_S = 900.0, 120.0, 60.0
_FIRST_UPDATES = 20
"""gradient steps after which a run is warm"""
KINDS = {"RemoteHost": "host", "actors.worker": "actor", "+viz_instance_id": "engine"}
"""a word of the command line, and which process that is"""


@dataclass(frozen=True, kw_only=True)
class Soak:
    """Run the main job while its actors are killed; record growth, losses and cost."""

    minutes: float = 60.0
    """total length of the stretches with kills"""
    kill_every_s: float = 20.0
    """seconds between two kills; the actors take turns"""
    stretches: int = 20
    """number of stretches with kills; undisturbed ones are before, between and after them"""
    undisturbed_minutes: float = 1.0
    """length of an undisturbed stretch"""
    sample_s: float = 5.0
    """seconds between two samples"""
    out: Path = DIRECTORY / "soak.json"
    """file of the record"""
    flags: tyro.conf.Positional[tuple[str, ...]] = ()
    """further words for `python -m gvz.launch --config rainbow_4task.py`, after a `--`"""


class Watched:
    """A run of the real command, its actors and its use of the machine."""

    def __init__(self, directory: Path, flags: Sequence[str], environment: Mapping[str, str]):
        self.directory = directory
        self._before = _shared()
        words = ["--config", "rainbow_4task.py", "--run-dir", str(directory), "--log.period-updates", "5", *flags]
        self.command = [sys.executable, "-m", "gvz.launch", *words]
        self._output = (directory.parent / "output.log").open("w+b")
        self.process = subprocess.Popen(
            self.command, stdout=self._output, stderr=self._output, cwd=record.ROOT, env=environment
        )
        self._root = psutil.Process(self.process.pid)

    def close(self) -> None:
        """Ends what still runs."""
        end_run(self.process)
        self._output.close()

    def output(self) -> str:
        """The end of the command's output."""
        self._output.seek(0)
        return self._output.read().decode(errors="replace")[-4000:]

    def wait_for_updates(self) -> None:
        """Waits until metrics.jsonl is past warm-up and the first updates."""
        deadline = time.monotonic() + _START_TIMEOUT_S
        while not (rows := self.metrics()) or rows[-1]["num_updates"] < _FIRST_UPDATES:
            self.check()
            if time.monotonic() > deadline:
                raise TimeoutError(
                    f"soak: no {_FIRST_UPDATES} updates within {_START_TIMEOUT_S:.0f} s; {self.output()}"
                )
            time.sleep(0.5)

    def check(self) -> None:
        """Raises RuntimeError: the run has ended."""
        if self.process.poll() is not None:
            raise RuntimeError(f"soak: the run ended with code {self.process.returncode}:\n{self.output()}")

    def metrics(self) -> list[dict[str, Any]]:
        """Rows of metrics.jsonl so far."""
        return records.read_stored(self.directory / "metrics.jsonl")[0]

    def sample(self) -> dict[str, float]:
        """The run's present use: bytes of memory, counts of descriptors, processes and files in /dev/shm."""
        sizes = []
        for name in self.shared_memory():
            with contextlib.suppress(FileNotFoundError):
                sizes.append((janitor.SHM_DIR / name).stat().st_size)
        return {
            "learner_bytes": self._root.memory_info().rss,
            "all_bytes": tree_bytes(self.process.pid),
            "learner_descriptors": self._root.num_fds(),
            "processes": 1 + len(self._root.children(recursive=True)),
            "shared_memory_files": len(sizes),
            "shared_memory_bytes": sum(sizes),
        }

    def shared_memory(self) -> set[str]:
        """Files of engines in /dev/shm that are newer than the run."""
        return _shared() - self._before

    def left_behind(self) -> list[str]:
        """Files of the ended run in /dev/shm that no process has mapped.

        Another run may be about to remove files of its own dead engines, so this waits up to a minute for that.
        """
        deadline = time.monotonic() + _CLEARED_S
        while (left := _unmapped(self.shared_memory())) and time.monotonic() < deadline:
            time.sleep(1.0)
        return left


def soak(options: Soak, console: Console) -> dict[str, Any]:
    """Runs the whole soak; returns the record."""
    head = about("soak", options)
    with tempfile.TemporaryDirectory(prefix="gvz-soak-") as directory:
        run = Watched(Path(directory) / "run", options.flags, record.environment())
        samples: list[dict[str, float]] = []
        kills: list[float] = []
        stretches: list[dict[str, Any]] = []
        try:
            run.wait_for_updates()
            console.print(f"warm; {options.minutes:g} minutes of kills begin")
            begin = time.time()
            for kind, seconds in _plan(options):
                stretch = {"kind": kind, "begin_s": time.time() - begin}
                for now in ticks(seconds, options.sample_s):
                    run.check()
                    samples.append({"time_s": round(time.time() - begin, 1), **run.sample()})
                    due = kind == "kills" and now >= options.kill_every_s * _killed_since(kills, stretch)
                    if due and (actors := processes("actor")):
                        actors[0].kill()  # the oldest, so that they take turns
                        kills.append(round(time.time() - begin, 1))
                stretches.append({**stretch, "end_s": time.time() - begin})
                console.print(f"{(time.time() - begin) / 60:5.1f} min  {kind:11} {len(kills)} kills so far")
            run.process.send_signal(signal.SIGTERM)
            code = run.process.wait(_STOP_TIMEOUT_S)
        finally:
            run.close()
        rows, problems = records.read(run.directory / "metrics.jsonl")
        faults, _ = records.read(run.directory / "faults.jsonl")
        for stretch in stretches:
            stretch["updates_per_s"] = _rate(rows, begin, stretch)
        return {
            **head,
            "kills": kills,
            "stretches": [{k: v if k == "kind" else round(v, 3) for k, v in s.items()} for s in stretches],
            "samples": {name: [sample[name] for sample in samples] for name in samples[0]},
            "faults": dict(Counter(fault["kind"] for fault in faults)),
            "restarts": int(rows[-1]["actors/restarts"]),
            "updates": rows[-1]["num_updates"],
            "exit_code": code,
            "damaged_rows": len(problems),
            "left_behind": run.left_behind(),
        }


def processes(kind: str | None = None) -> list[psutil.Process]:
    """Hosts, actors or engines (or all) below this process, oldest first."""
    found: list[psutil.Process] = []
    for process in psutil.Process().children(recursive=True):
        try:
            words = " ".join(process.cmdline())
            is_one = any(mark in words and kind in (None, name) for mark, name in KINDS.items())
            if is_one and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process)
        except psutil.Error:  # it has just ended
            continue
    return sorted(found, key=lambda process: process.create_time())


def summary(made: dict[str, Any]) -> dict[str, float]:
    """The promised quantities: `growth` of each sample, and the median of `kill_ratios`."""
    grown = {name: growth(values) for name, values in made["samples"].items() if name != "time_s"}
    return {**grown, "updates_per_s": statistics.median(kill_ratios(made))}


def growth(values: Sequence[float]) -> float:
    """Median of the last fifth over that of the first."""
    fifth = max(1, len(values) // 5)
    return statistics.median(values[-fifth:]) / statistics.median(values[:fifth])


def kill_ratios(made: dict[str, Any]) -> list[float]:
    """Gradient steps/s of every stretch with kills over the mean of the undisturbed ones before and after it."""
    rates = [stretch["updates_per_s"] for stretch in made["stretches"]]
    return [
        2 * killed / (before + after)
        for before, killed, after in zip(rates[::2], rates[1::2], rates[2::2], strict=False)
    ]


def _shared() -> set[str]:
    """Names of engines' files in /dev/shm."""
    return {file.name for file in janitor.SHM_DIR.iterdir() if file.name.startswith("ViZDoom")}


def _unmapped(names: set[str]) -> list[str]:
    """The names of files that no process has mapped."""
    mapped = ""
    for process in psutil.process_iter() if names else ():
        with contextlib.suppress(OSError):
            mapped += Path(f"/proc/{process.pid}/maps").read_text()
    return sorted(name for name in names if f"/dev/shm/{name}" not in mapped)


def _plan(options: Soak) -> Iterator[tuple[str, float]]:
    """Kinds and seconds of the stretches, in order."""
    quiet = ("undisturbed", options.undisturbed_minutes * 60)
    for _ in range(options.stretches):
        yield quiet
        yield "kills", options.minutes * 60 / options.stretches
    yield quiet


def ticks(seconds: float, period_s: float) -> Iterator[float]:
    """Seconds since the first tick, one every `period_s`, for `seconds`."""
    start = time.monotonic()
    number = 0
    while (now := time.monotonic() - start) < seconds:
        yield now
        number += 1
        time.sleep(max(0.0, start + number * period_s - time.monotonic()))


def _killed_since(kills: Sequence[float], stretch: dict[str, Any]) -> int:
    return sum(kill >= stretch["begin_s"] for kill in kills)


def _rate(rows: Sequence[dict[str, Any]], begin: float, stretch: dict[str, Any]) -> float:
    """Gradient steps a second between the first and the last row of a stretch."""
    mine = [r for r in rows if stretch["begin_s"] <= r["time_s"] - begin <= stretch["end_s"]]
    if len(mine) < 2:
        raise RuntimeError(
            f"soak: a stretch has {len(mine)} rows of metrics, want 2 or more; make the stretches longer"
        )
    return (mine[-1]["num_updates"] - mine[0]["num_updates"]) / (mine[-1]["time_s"] - mine[0]["time_s"])


def about(name: str, options: Any, packages: Sequence[str] = machine.PACKAGES) -> dict[str, Any]:
    """The head of the record of a soak that begins now. Of the options, a dataclass, the command has what is not as by
    default.
    """
    default, words = type(options)(), list[str]()
    for option, value in asdict(options).items():
        if option not in ("out", "flags") and value != getattr(default, option):
            words += [f"--{option.replace('_', '-')}", f"{value:g}"]
    words += ["--", *options.flags] if options.flags else []
    return {
        "schema": SCHEMA,
        "date": time.strftime("%Y-%m-%d %H:%M", time.gmtime()),
        "commit": record.describe_commit(),
        "command": shlex.join(["python", "-m", f"benchmarks.{name}", *words]),
        "machine": machine.hardware(),
        "versions": machine.versions(packages),
        "settings": {**asdict(options), "out": None, "flags": list(options.flags)},
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns the exit code: 0 if nothing was lost or left behind, else 1."""
    options = tyro.cli(Soak, args=arguments, prog="python -m benchmarks.soak")
    console = Console(stderr=True)
    made = soak(options, console)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(made) + "\n")
    for name, ratio in summary(made).items():
        console.print(f"{name}: {ratio:.3f}")
    console.print(
        f"{len(made['kills'])} kills, {made['restarts']} restarts, left behind: {made['left_behind'] or 'nothing'}"
    )
    return 0 if made["exit_code"] == 128 + signal.SIGTERM and not made["left_behind"] else 1


if __name__ == "__main__":
    sys.exit(main())
