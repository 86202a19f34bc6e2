"""gvz export, as it is called."""

import gzip
import json
from pathlib import Path

import polars as pl
import pytest

from gvz import cli
from tests.full_disk import full_disk


@pytest.fixture
def run_dirs(tmp_path: Path) -> list[Path]:
    """Two runs: both with metrics, the second with an episode, an evaluation and a damaged line."""
    runs = []
    for seed in (1, 2):
        run = tmp_path / f"seed_{seed}"
        run.mkdir()
        config = {"config": {"name": "tiny", "seed": seed}, "resolved": {"tasks": ["health_gathering/lava"]}}
        (run / "config.json").write_text(json.dumps(config))
        rows = [{"schema": 1, "num_updates": n, "learner/loss": 0.5 * n} for n in (0, 1)]
        (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
        runs.append(run)
    episode = {"schema": 1, "task": "health_gathering/lava", "score": 4, "reward_components": {"health": 0.25}}
    (runs[1] / "episodes.jsonl").write_text(json.dumps(episode) + "\nhalf")
    evaluation = {"schema": 1, "player": "p", "task": "health_gathering/obstacles+slime", "episode": 0, "seed": 3}
    (runs[1] / "evaluation.jsonl").write_text(json.dumps({**evaluation, "score": 210.0, "terminated": True}) + "\n")
    return runs


def test_csv_has_a_table_of_each_kind_of_record_and_names_damage(run_dirs, tmp_path, capsys):
    out = tmp_path / "tables"
    assert cli.main(["export", *map(str, run_dirs), "--out", str(out)]) == 0
    printed = capsys.readouterr()
    assert printed.out.splitlines() == [str(out / f"{n}.csv") for n in ("metrics", "episodes", "evaluation")]
    assert "episodes.jsonl, line 2: not JSON" in printed.err
    metrics = pl.read_csv(out / "metrics.csv")
    assert metrics["run_seed"].to_list() == [1, 1, 2, 2]
    assert metrics["learner/loss"].to_list() == [0.0, 0.5, 0.0, 0.5]
    assert pl.read_csv(out / "episodes.csv")["reward/health"].to_list() == [0.25]
    evaluation = pl.read_csv(out / "evaluation.csv")
    assert evaluation["attributes"].to_list() == ["obstacles+slime"]
    assert evaluation["normalized_score"].to_list() == [10.0]


def test_parquet_keeps_types(run_dirs, tmp_path, capsys):
    assert cli.main(["export", str(run_dirs[1]), "--format", "parquet", "--out", str(tmp_path / "t")]) == 0
    capsys.readouterr()
    evaluation = pl.read_parquet(tmp_path / "t" / "evaluation.parquet")
    assert evaluation["attributes"].to_list() == [["obstacles", "slime"]]
    assert evaluation["terminated"].to_list() == [True]
    assert not list((tmp_path / "t").glob("*.tmp"))


def test_compressed_records_and_starts_are_tables_too(run_dirs, tmp_path, capsys):
    (run_dirs[0] / "metrics.jsonl.gz").write_bytes(gzip.compress((run_dirs[0] / "metrics.jsonl").read_bytes()))
    (run_dirs[0] / "metrics.jsonl").unlink()
    start = {"schema": 1, "num_updates": 0, "cores": 2, "devices": ["cpu: cpu"], "versions": {"jax": "0.7"}}
    (run_dirs[0] / "starts.jsonl").write_text(json.dumps(start) + "\n")
    assert cli.main(["export", str(run_dirs[0]), "--out", str(tmp_path / "t")]) == 0
    assert capsys.readouterr().out.splitlines() == [str(tmp_path / "t" / f"{n}.csv") for n in ("metrics", "starts")]
    assert pl.read_csv(tmp_path / "t" / "metrics.csv")["num_updates"].to_list() == [0, 1]
    starts = pl.read_csv(tmp_path / "t" / "starts.csv")
    assert starts["cores"].to_list() == [2]
    assert json.loads(starts["versions"][0]) == {"jax": "0.7"}


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_a_full_disk_is_one_line_and_leaves_the_table_of_before(kind, run_dirs, tmp_path, capsys):
    table = tmp_path / "tables" / f"metrics.{kind}"
    table.parent.mkdir()
    table.write_text("of before")
    with full_disk(50):
        assert cli.main(["export", str(run_dirs[0]), "--format", kind, "--out", str(table.parent)]) == 1
    printed = capsys.readouterr()
    assert printed.err == f"error: {table}: File too large; make room or give a place that you can write to\n"
    assert [(file, file.read_text()) for file in table.parent.iterdir()] == [(table, "of before")]


def test_tables_of_an_earlier_export_that_are_not_written_again_are_removed(run_dirs, tmp_path, capsys):
    out = tmp_path / "tables"
    for kind in ("csv", "parquet"):
        assert cli.main(["export", str(run_dirs[1]), "--format", kind, "--out", str(out)]) == 0
    (out / "notes.csv").write_text("mine")
    capsys.readouterr()
    assert cli.main(["export", str(run_dirs[0]), "--out", str(out)]) == 0
    printed = capsys.readouterr()
    assert printed.out.splitlines() == [str(out / "metrics.csv")]
    why = "is removed: it is of an earlier export, and this one has no rows for it"
    assert printed.err.splitlines() == [f"note: {out / name}.csv {why}" for name in ("episodes", "evaluation")]
    assert {file.name for file in out.iterdir()} == {
        *("metrics.csv", "notes.csv", "metrics.parquet", "episodes.parquet", "evaluation.parquet"),
    }


def test_bad_input_is_named(run_dirs, tmp_path, refusal):
    assert "got no run directory, want at least one" in refusal("export")
    said = refusal("export", str(tmp_path))
    assert f"{tmp_path} is not a run directory (config.json: No such file or directory)" in said
    assert f"; did you mean {run_dirs[0]}?" in refusal("export", str(run_dirs[0].parent))
    (tmp_path / "file").touch()
    assert "--out: " in refusal("export", str(run_dirs[0]), "--out", str(tmp_path / "file"))
