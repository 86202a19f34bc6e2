"""`gvz export`: records of runs as tables."""

import io
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from gvz.core import records
from gvz.core.errors import ConfigError
from gvz.core.files import written_whole
from gvz.run.rundir import RECORD_FILES, START_RECORDS, no_run

if TYPE_CHECKING:
    import polars as pl


@dataclass(frozen=True, kw_only=True)
class Export:
    """Write the records of runs as CSV or Parquet: a table each of metrics, episodes, faults, starts and evaluations.

    The rows of all runs go into one table, with the columns `run_dir`, `run` and `run_seed`. A table without rows is
    not written, and one of that name and format from an earlier export is removed. It writes no policies;
    `gvz zoo --add` makes a file of one.

    Example: gvz export runs/rainbow_4task/seed_* --format parquet --out tables
    """

    run_dirs: Annotated[
        tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="RUN_DIR ...", help_behavior_hint="")
    ]
    """run directories of the trainer, or zoo:NAME (see gvz zoo)"""
    format: Literal["csv", "parquet"] = "csv"
    """csv, or parquet, which keeps the types"""
    out: Path = Path("tables")
    """directory to write to"""

    def run(self) -> int:
        """Writes the tables that have rows; prints their paths, what was removed, and what could not be read."""
        if not self.run_dirs:
            raise ConfigError("export: got no run directory, want at least one")
        from gvz.evaluation.dataset import collect_evaluations
        from gvz.evaluation.zoo import run_directory

        problems: list[str] = []
        run_dirs = [run_directory(path) for path in self.run_dirs]
        tables = {Path(name).stem: run_table(run_dirs, name, problems) for name in (*RECORD_FILES, START_RECORDS)}
        tables["evaluation"], damaged = collect_evaluations(run_dirs)
        try:
            self.out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"--out: {self.out} cannot be made: {error.strerror}") from error
        for name, table in tables.items():
            file = self.out / f"{name}.{self.format}"
            if not table.is_empty():
                print(write_table(table, file))
            elif file.is_file():
                file.unlink()
                problems.append(f"{file} is removed: it is of an earlier export, and this one has no rows for it")
        for problem in problems + damaged:
            print(f"note: {problem}", file=sys.stderr)
        return 0


COMMAND = Export

MAX_COLUMNS = 2000
"""a small file of rows with fields of their own each would fill the memory with empty cells"""


def run_table(run_dirs: Sequence[Path], name: str, problems: list[str]) -> "pl.DataFrame":
    """The rows of one record file of each run, one after the other.

    Args:
        run_dirs: run directories; one without such a file has no rows.
        name: one of RECORD_FILES, or START_RECORDS; compressed, too (.gz).
        problems: is added a message for every line that cannot be read.

    Returns:
        A column for each field of any row; `reward_components` become columns `reward/<name>`.

    Raises:
        ConfigError: not a run directory.
    """
    import polars as pl

    rows: list[dict[str, Any]] = []
    for run_dir in run_dirs:
        try:
            config = json.loads((run_dir / "config.json").read_text())["config"]
            whose = {"run_dir": str(run_dir), "run": config["name"], "run_seed": config["seed"]}
        except OSError as error:
            raise no_run(run_dir, error) from error
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise ConfigError(f"{run_dir / 'config.json'} cannot be read: {error!r}") from error
        found, damaged = records.read_stored(run_dir / name)
        rows += ({**whose, **_flat(row)} for row in found)
        problems += damaged
    columns = list(dict.fromkeys(column for row in rows for column in row))
    if len(columns) > MAX_COLUMNS:
        problems.append(f"{name}: got rows of {len(columns)} different fields, want at most {MAX_COLUMNS}; not written")
        columns = []
    return pl.DataFrame([pl.Series(column, [row.get(column) for row in rows], strict=False) for column in columns])


def write_table(table: "pl.DataFrame", file: Path) -> Path:
    """Writes .csv (lists as their elements with a +) or .parquet; the file appears once it is whole."""
    import polars as pl

    data = io.BytesIO()  # polars has errors of its own for a full disk
    if file.suffix == ".csv":
        lists = [name for name, kind in table.schema.items() if isinstance(kind, pl.List)]
        table.with_columns(pl.col(lists).list.join("+")).write_csv(data)
    else:
        table.write_parquet(data)
    with written_whole(file) as writing:
        writing.write_bytes(data.getbuffer())
    return file


def _flat(row: dict[str, Any]) -> dict[str, Any]:
    components = row.get("reward_components")
    if isinstance(components, dict):
        row = {n: v for n, v in row.items() if n != "reward_components"}
        row |= {f"reward/{name}": value for name, value in components.items()}
    return {_text(name): _cell(value) for name, value in row.items()}


def _cell(value: Any) -> Any:
    """What a column can hold: numbers of 64 bits, booleans, text; anything else as its JSON text."""
    if value is None or isinstance(value, bool | float) or (isinstance(value, int) and -(2**63) <= value < 2**63):
        return value
    return _text(value) if isinstance(value, str) else json.dumps(value)


def _text(value: str) -> str:
    return value.encode(errors="backslashreplace").decode()  # half a pair of surrogates has no place in a file
