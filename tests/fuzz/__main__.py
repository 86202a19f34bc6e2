"""The long form: coverage-guided fuzzing of every parser, `python -m tests.fuzz` (`make fuzz`).

Each target has a process of its own under libFuzzer, by way of atheris; the record of them all is one JSON file.
Imports atheris's version, tyro, gvz.core.janitor, gvz.run.machine.
"""

import base64
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from gvz.core import janitor
from gvz.run import machine
from tests.fuzz.targets import TARGETS

START_S = 300
"""over the time of fuzzing: for imports and examples, on a busy machine"""
INPUT_TIMEOUT_S = 60
"""of the wall clock; `attempt` counts the seconds of the CPU"""
MEMORY_MB = 2048
PACKAGES = ("atheris", "msgpack", "numpy", "orbax-checkpoint", "polars", "tyro", "vizdoom")


@dataclass(frozen=True, kw_only=True)
class Fuzz:
    """Fuzz the parsers, guided by coverage. Exit code 1 if one of them breaks its promise."""

    targets: tyro.conf.Positional[tuple[str, ...]] = ()
    """names of tests/fuzz/targets.py; default all"""
    seconds: int = 60
    """for each target"""
    out: Path = Path("results/reliability/fuzz.json")
    """the record; targets that are not named keep what stands in it"""

    def run(self) -> int:
        """Fuzzes, prints a line for each target, writes the record."""
        if unknown := set(self.targets) - set(TARGETS):
            print(f"error: no target {', '.join(sorted(unknown))}; there are {', '.join(TARGETS)}", file=sys.stderr)
            return 2
        found: dict[str, dict[str, Any]] = {}
        with tempfile.TemporaryDirectory(prefix="gvz-fuzz-") as directory:
            os.environ |= {"TMPDIR": directory, "GVZ_RUNTIME_DIR": directory, "JAX_PLATFORMS": "cpu"}
            try:
                for name in self.targets or TARGETS:
                    found[name] = fuzz(name, Path(directory), self.seconds)
                    print(summary(name, found[name]), flush=True)
            except KeyboardInterrupt:
                print("stopped; no record is written", file=sys.stderr)
                return 130
            finally:
                janitor.clean_dead_instances()
        command = "python -m tests.fuzz " + " ".join(sys.argv[1:])
        if self.targets and self.out.exists():  # those of before stand beside
            before = json.loads(self.out.read_text())
            found, command = before["targets"] | found, f"{before['command']}; {command}"
        record = {
            "schema": 1,
            "command": command,
            **machine.hardware(),
            "versions": machine.versions(PACKAGES),
            "inputs": sum(target["inputs"] for target in found.values()),
            "targets": found,
        }
        self.out.parent.mkdir(parents=True, exist_ok=True)
        self.out.write_text(json.dumps(record, indent=2) + "\n")
        print(f"{record['inputs']:,} inputs; {self.out}")
        return 1 if any(target["crashes"] for target in found.values()) else 0


def fuzz(name: str, directory: Path, seconds: int) -> dict[str, Any]:
    """Fuzzes one target.

    Returns: date and commit, seconds, inputs tried, edges and features covered, inputs in the corpus, and what broke
    the promise.
    """
    home, crashes = directory / name, directory / f"{name}-crashes"
    for folder in (home, crashes):
        folder.mkdir()
    flags = {
        "max_total_time": seconds,
        "timeout": INPUT_TIMEOUT_S,
        "rss_limit_mb": MEMORY_MB,
        "artifact_prefix": f"{crashes}/",
        "print_final_stats": 1,
        "seed": 1,
    }
    command = [sys.executable, "-m", "tests.fuzz.child", name, str(home)]
    command += [f"-{flag}={value}" for flag, value in flags.items()]
    log = home / "log"
    started, start_s = time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime()), time.monotonic()
    with log.open("wb") as stream:
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=stream, stderr=stream, start_new_session=True
        )
        try:
            code = process.wait(seconds + START_S)
        except subprocess.TimeoutExpired:
            code = None
        finally:  # Ctrl-C, too
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
    return {
        "date": started,
        "commit": machine.commit(("gvz", "actors", "learner", "tests/fuzz")),
        "seconds": round(time.monotonic() - start_s, 1),
        **counts(log.read_text(errors="replace")),
        "crashes": broken(log.read_text(errors="replace"), code, sorted(crashes.iterdir())),
    }


def counts(log: str) -> dict[str, int]:
    """What libFuzzer says of its work: inputs tried, edges and features covered, inputs in the corpus."""
    tried = re.findall(r"stat::number_of_executed_units: (\d+)", log) or re.findall(r"^#(\d+)", log, re.MULTILINE)
    covered = re.findall(r"cov: (\d+) ft: (\d+) corp: (\d+)/", log)
    edges, features, corpus = map(int, covered[-1]) if covered else (0, 0, 0)
    return {"inputs": int(tried[-1]) if tried else 0, "edges": edges, "features": features, "corpus": corpus}


def broken(log: str, code: int | None, artifacts: list[Path]) -> list[dict[str, str]]:
    """What ended the fuzzing before its time: the kind, the input as base64, the end of the log."""
    if code == 0 and not artifacts:
        return []
    _, _, error = log.rpartition("=== Uncaught Python exception: ===")
    said = error[-4000:].strip()
    if not artifacts:
        return [{"kind": "killed" if code is None else f"exit code {code}", "input": "", "log": said}]
    return [
        {"kind": file.name.partition("-")[0], "input": base64.b64encode(file.read_bytes()).decode(), "log": said}
        for file in artifacts
    ]


def summary(name: str, found: dict[str, Any]) -> str:
    """A line about a target."""
    end = "; ".join(f"BROKEN ({crash['kind']})" for crash in found["crashes"]) or "no promise broken"
    return f"{name:20} {found['seconds']:6.0f} s {found['inputs']:10,} inputs {found['edges']:6,} edges  {end}"


if __name__ == "__main__":
    sys.exit(tyro.cli(Fuzz, prog="python -m tests.fuzz").run())
