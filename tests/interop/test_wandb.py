"""Weights & Biases offline: it gets the scalars of the records, and a resumed run is the same run there."""

import json
import os
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from wandb.proto.wandb_internal_pb2 import Record

TWO_STARTS = """
import sys
from pathlib import Path
from gvz.run.config import LogConfig
from gvz.run.config_files import load_config
from gvz.run.rundir import RunDir
from gvz.run.telemetry import Telemetry
with RunDir(Path(sys.argv[1])) as run:
    config = load_config("rainbow_quick")
    run.write_config(config)
    for num_updates in (10, 20):
        records = Telemetry(run, config.table, LogConfig(tensorboard=False, wandb=True), 0)
        records.scalars(num_updates, {"learner/loss": 0.5, "actors/env_steps": 4 * num_updates})
        records.close()
        records.close()
"""


def track(where: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """In a process of its own: wandb starts a service that lives as long as the process does."""
    command = [sys.executable, "-c", TWO_STARTS, str(where)]
    environment = {**os.environ, "HOME": str(where), "NETRC": str(where / "none"), **environment}
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=400, check=False)


def records(file: Path) -> Iterator[Record]:
    """The records of an offline run: 7 bytes of header, then pieces of records that keep to blocks of 32 KiB."""
    data, at, record = file.read_bytes(), 7, b""
    while at < len(data):
        if 32768 - at % 32768 < 7:
            at += 32768 - at % 32768
        _, length, kind = struct.unpack_from("<IHB", data, at)
        record += data[at + 7 : at + 7 + length]
        at += 7 + length
        if kind in (1, 4):  # whole, or a last piece
            yield Record.FromString(record)
            record = b""


def test_offline_runs_hold_the_scalars_and_are_one_run(tmp_path):
    done = track(tmp_path, WANDB_MODE="offline")
    assert done.returncode == 0, done.stderr
    found = [record for file in sorted(tmp_path.glob("wandb/offline-run-*/*.wandb")) for record in records(file)]
    runs = [record.run for record in found if record.WhichOneof("record_type") == "run"]
    assert {run.run_id for run in runs} == {(tmp_path / "wandb_id").read_text()}
    assert {(run.project, run.display_name) for run in runs} == {("gvizdoom", "rainbow_quick/seed_1111")}
    history = [record.history.item for record in found if record.WhichOneof("record_type") == "history"]
    logged = [{item.nested_key[0]: json.loads(item.value_json) for item in items} for items in history]
    written = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    names = ("num_updates", "learner/loss", "actors/env_steps")
    assert [[row[n] for n in names] for row in logged] == [[row[n] for n in names] for row in written]
    assert [row["num_updates"] for row in logged] == [10, 20]


def test_not_knowing_who_logs_is_an_error_with_its_remedy(tmp_path):
    done = track(tmp_path, WANDB_MODE="online", WANDB_API_KEY="")
    assert done.returncode != 0
    assert "ConfigError: log.wandb: " in done.stderr
    assert "log in (wandb login), set WANDB_MODE=offline, or leave --log.wandb out" in done.stderr
