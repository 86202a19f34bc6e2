"""A benchmark's record: one JSON file with the measurements, machine, date, versions and command."""

import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import psutil

from benchmarks.rounds import Row
from gvz.core.errors import ConfigError
from gvz.engine.tuned import TUNED
from gvz.run import machine

SCHEMA = 1
"""Part of every record; increased by one when a record's meaning changes."""
ROOT = Path(__file__).parent.parent
DIRECTORY = ROOT / "results" / "performance"
WITHOUT_AN_ENGINE = frozenset({"augmentations", "encoders", "learner_update", "sum_tree"})
"""benchmarks that play no game, so that the installed engine does not matter"""


@dataclass(frozen=True, kw_only=True)
class Record:
    """One run of one benchmark."""

    schema: int
    benchmark: str
    device: str
    """cpu, gpu or tpu: JAX's default backend"""
    commit: str
    """with `+changes` if the tree was not clean"""
    date: str
    """of the start, UTC"""
    command: str
    quick: bool
    """smallest sizes; the figures have no meaning"""
    seconds: float
    machine: dict[str, Any]
    versions: dict[str, str]
    rows: list[Row]

    @property
    def variant(self) -> str:
        """What sets the record apart from one of a CPU and the released engine: "gpu", "tuned" (the engine), or
        nothing.
        """
        plays = self.benchmark not in WITHOUT_AN_ENGINE
        tuned = "tuned" if plays and TUNED in self.versions.get("vizdoom", "") else ""
        return "_".join(word for word in (self.device if self.device != "cpu" else "", tuned) if word)


def environment() -> dict[str, str]:
    """The environment of measured commands: ours without PYTHONDONTWRITEBYTECODE, so that bytecode is cached."""
    return {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}


def describe_machine() -> dict[str, Any]:
    """The measuring machine, with its load and free memory at the start."""
    return {
        **machine.hardware(),
        "free_memory_bytes": psutil.virtual_memory().available,
        "load": [round(load, 2) for load in os.getloadavg()],
    }


def describe_commit() -> str:
    """The checkout's commit, with `+changes` if measured files differ from it; "unknown" without a checkout."""
    return machine.commit((*machine.OWN_PACKAGES, "benchmarks")) or "unknown"


def write(record: Record, directory: Path) -> Path:
    """Writes `<benchmark>.json`, or `<benchmark>_<variant>.json`, one row per line."""
    directory.mkdir(parents=True, exist_ok=True)
    suffix = f"_{record.variant}" if record.variant else ""
    file = directory / f"{record.benchmark}{suffix}.json"
    fields = asdict(record)
    rows = ",\n    ".join(json.dumps(row) for row in fields.pop("rows"))
    head = json.dumps(fields, indent=2).removesuffix("\n}")
    file.write_text(f'{head},\n  "rows": [\n    {rows}\n  ]\n}}\n')
    return file


def read_all(directory: Path = DIRECTORY) -> list[Record]:
    """Every record of a directory, in the order of the file names.

    Raises:
        ConfigError: a file is not a record, has another schema, or was made by `--quick`.
    """
    records = []
    for file in sorted(directory.glob("*.json")):
        try:
            record = Record(**json.loads(file.read_text()))
        except (ValueError, TypeError) as error:
            raise ConfigError(f"{file}: not a record of benchmarks ({error}); measure again or remove it") from error
        if record.schema != SCHEMA:
            raise ConfigError(f"{file}: schema {record.schema}, want {SCHEMA}; measure again")
        if record.quick:
            raise ConfigError(f"{file}: made by --quick, its figures mean nothing; measure without")
        records.append(record)
    return records
