"""A benchmark's record: one JSON file with what was measured, where, when, with what and by which command."""

import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import psutil

from benchmarks.rounds import Row
from gvz.core.errors import ConfigError
from gvz.run import machine

SCHEMA = 1
"""Stands in every record; raised by one when a record's meaning changes."""
ROOT = Path(__file__).parent.parent
DIRECTORY = ROOT / "results" / "performance"


@dataclass(frozen=True, kw_only=True)
class Record:
    """One benchmark, once."""

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
    """smallest sizes, whose figures mean nothing"""
    seconds: float
    machine: dict[str, Any]
    versions: dict[str, str]
    rows: list[Row]


def environment() -> dict[str, str]:
    """Of what is measured: this one, but bytecode is cached, as it is wherever PYTHONDONTWRITEBYTECODE is not set."""
    return {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}


def describe_machine() -> dict[str, Any]:
    """What the figures were measured on; load and free memory are those at the start."""
    return {
        **machine.hardware(),
        "free_memory_bytes": psutil.virtual_memory().available,
        "load": [round(load, 2) for load in os.getloadavg()],
    }


def describe_commit() -> str:
    """Of the checkout, with `+changes` if measured files differ from it; "unknown" outside of one."""
    return machine.commit((*machine.MEASURED, "benchmarks")) or "unknown"


def write(record: Record, directory: Path) -> Path:
    """Writes `<benchmark>.json` (`<benchmark>_<device>.json` if that is no CPU), a row a line."""
    directory.mkdir(parents=True, exist_ok=True)
    suffix = "" if record.device == "cpu" else f"_{record.device}"
    file = directory / f"{record.benchmark}{suffix}.json"
    fields = asdict(record)
    rows = ",\n    ".join(json.dumps(row) for row in fields.pop("rows"))
    head = json.dumps(fields, indent=2).removesuffix("\n}")
    file.write_text(f'{head},\n  "rows": [\n    {rows}\n  ]\n}}\n')
    return file


def read_all(directory: Path = DIRECTORY) -> list[Record]:
    """Every record of a directory, in the order of the file names.

    Raises:
        ConfigError: a file is no record, of another schema, or made by `--quick`.
    """
    records = []
    for file in sorted(directory.glob("*.json")):
        try:
            record = Record(**json.loads(file.read_text()))
        except (ValueError, TypeError) as error:
            raise ConfigError(f"{file}: not a record of benchmarks ({error}); measure anew or remove it") from error
        if record.schema != SCHEMA:
            raise ConfigError(f"{file}: schema {record.schema}, want {SCHEMA}; measure anew")
        if record.quick:
            raise ConfigError(f"{file}: made by --quick, its figures mean nothing; measure without")
        records.append(record)
    return records
