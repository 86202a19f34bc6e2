"""A run directory and the processes that use it one after another, or at once."""

import json
from pathlib import Path

import pytest

from gvz.core import records
from gvz.core.errors import ConfigError, ResumeError
from gvz.launch import main
from gvz.run import rundir
from gvz.run.config_files import load_config
from gvz.run.rundir import RunDir, refuse_other_contents


def test_a_directory_that_is_moved_before_it_is_locked_is_not_held(tmp_path, monkeypatch):
    """As by `--fresh` in another process, which then makes a new one in its place."""
    path, lock = tmp_path / "run", records.lock

    def move_first(file, **options):
        monkeypatch.undo()
        path.rename(tmp_path / "moved")
        path.mkdir()
        return lock(file, **options)

    monkeypatch.setattr(records, "lock", move_first)
    with pytest.raises(ResumeError, match="another running process uses it"):
        RunDir(path)
    RunDir(path).close()


def test_after_a_power_cut_the_configuration_is_the_old_one_or_the_new_one(tmp_path, monkeypatch):
    file, writing = tmp_path / "config.json", tmp_path / "config.json.tmp"
    with RunDir(tmp_path) as run:
        run.write_config(load_config("rainbow_quick"))
        done: list[tuple[Path, bool, bool]] = []
        monkeypatch.setattr(
            rundir, "fsync", lambda path: done.append((path, writing.exists(), file.stat().st_ino != before))
        )
        before = file.stat().st_ino
        run.write_config(load_config("rainbow_quick"))
    assert done == [(writing, True, False), (tmp_path, False, True)], "its contents, then its name"


def test_a_row_follows_no_half_row_of_a_process_that_was_killed_on_a_full_disk(tmp_path):
    """Its checkpoint vouches for rows that it still had in memory, so a later cut can be within another row."""
    file, vouched = tmp_path / "episodes.jsonl", {"episodes.jsonl": 80}
    file.write_text('{"schema": 1, "row": 0}\n{"schema": 1, "row": 1}\n{"schema": ')
    for start in (2, 3, 4):
        with RunDir(tmp_path) as run:
            run.truncate_records(vouched)
            run.append(file.name, {"row": start})
    rows, problems = records.read(file)
    assert ([row["row"] for row in rows], problems) == ([0, 1, 2, 4], [])
    assert (tmp_path / "discarded" / file.name).read_text() == '": 1, "row": 3}\n'


def test_no_evaluation_begins_before_later_policies_are_discarded(tmp_path, monkeypatch):
    """Its rows would be of a policy that the run never had."""
    file, move = tmp_path / "evaluation.jsonl", rundir._move_into
    file.write_text('{"schema": 1, "num_updates": 20}\n')
    (tmp_path / "policies" / "20").mkdir(parents=True)
    began = []

    def move_beside_an_evaluation(folder, directory):
        evaluation = records.Writer(file)
        began.append(evaluation.lock())
        evaluation.close()
        move(folder, directory)

    monkeypatch.setattr(rundir, "_move_into", move_beside_an_evaluation)
    with RunDir(tmp_path) as run:
        run.discard_after(10)
    assert began == [False]
    assert file.read_text() == ""
    assert not list((tmp_path / "policies").iterdir())


@pytest.mark.parametrize("flags", [[], ["--fresh"]])
def test_a_directory_that_holds_something_else_is_not_made_a_run(tmp_path, capsys, flags):
    """A run replaces `segmenters/`. A later `--fresh` would move the other files, too."""
    (tmp_path / "segmenters").mkdir()
    (tmp_path / "segmenters" / "mine.onnx").write_text("precious")
    assert main(["--config", "rainbow_quick", "--run-dir", str(tmp_path), *flags]) == 2
    assert str(tmp_path) in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["segmenters"]
    with pytest.raises(
        ConfigError, match=r"--run-dir: .* holds segmenters, and no run \(no config\.json\); want an empty"
    ):
        refuse_other_contents(tmp_path)


def test_fresh_begins_a_run_with_other_settings_beside_the_old_one(tmp_path, monkeypatch):
    monkeypatch.setattr("gvz.run.train.train", lambda config, run, _: run.write_config(config) or 0)
    path = tmp_path / "run"
    for flags, code in (([], 0), (["--seed", "7"], 2), (["--seed", "7", "--fresh"], 0)):
        assert main(["--config", "rainbow_quick", "--run-dir", str(path), *flags]) == code
    (old,) = set(tmp_path.iterdir()) - {path}
    seeds = [json.loads((one / "config.json").read_text())["config"]["seed"] for one in (old, path)]
    assert seeds == [1111, 7]


def test_links_to_another_disk_and_what_an_earlier_start_left_are_no_other_contents(tmp_path):
    (tmp_path / "checkpoints").symlink_to(tmp_path / "another_disk")
    for log in ("log.txt", "slurm-7.out"):  # gvz train --run-dir here > here/log.txt
        (tmp_path / log).touch()
    refuse_other_contents(tmp_path)
    RunDir(tmp_path).close()
    (tmp_path / "notes.txt").write_text("of a run that did not fit into the memory")
    refuse_other_contents(tmp_path)
    refuse_other_contents(tmp_path / "new")
    with pytest.raises(ResumeError, match=r"notes\.txt: Not a directory; mend this, or choose another with --run-dir"):
        refuse_other_contents(tmp_path / "notes.txt")
