"""The run directory: locked, private, never overwritten; its records survive a cut."""

import dataclasses
import gzip
import json
import os
import stat
import tempfile
from pathlib import Path

import numpy as np
import pytest

import gvz
from gvz.core import records
from gvz.core.durable import saved_steps
from gvz.core.errors import CheckpointError, ConfigError, GvzError, ResumeError
from gvz.run.config_files import load_config
from gvz.run.group import Group
from gvz.run.restore import restore
from gvz.run.rundir import RunDir, move_aside
from learner.checkpoint import write
from tests.full_disk import full_disk

CONFIG = load_config("rainbow_4task")
WEIGHTS = {"weights": np.zeros(2, np.float32)}


def test_it_is_private_and_held_by_one(tmp_path):
    with RunDir(tmp_path / "run") as run:
        assert stat.S_IMODE(run.path.stat().st_mode) == 0o700
        with pytest.raises(ResumeError, match="another running process uses it"):
            RunDir(tmp_path / "run")
    RunDir(tmp_path / "run").close()


def test_the_directory_of_process_0_is_private_also_if_another_process_of_the_group_makes_it(tmp_path):
    before = os.umask(0)
    with RunDir(tmp_path / "runs" / "one" / "process_1", in_another=True):
        assert stat.S_IMODE((tmp_path / "runs" / "one").stat().st_mode) == 0o700
        assert stat.S_IMODE((tmp_path / "runs").stat().st_mode) == 0o777
    os.umask(before)


def test_a_run_goes_on_with_its_own_file_however_its_path_is_written(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.py").write_text((Path(gvz.__file__).parents[1] / "learner" / "encoders" / "nature.py").read_text())
    agent = dataclasses.replace(CONFIG.agent, encoder="./own.py")
    with RunDir(tmp_path / "run") as run:
        run.write_config(dataclasses.replace(CONFIG, agent=agent))
        for path in ("./own.py", "own.py", f"{tmp_path}/own.py"):
            assert (
                run.check_resumable(dataclasses.replace(CONFIG, agent=dataclasses.replace(agent, encoder=path))) == []
            )


@pytest.mark.parametrize(("folder", "saved"), [("checkpoints", False), ("policies", False), ("policies", True)])
def test_a_run_does_not_begin_without_what_is_on_a_disk_that_is_not_there(tmp_path, folder, saved):
    with RunDir(tmp_path / "run") as run:
        run.append("metrics.jsonl", {"row": 1})
        if saved:
            write(run.checkpoints / "1", WEIGHTS, {})
        (run.path / folder).symlink_to(tmp_path / "not mounted")
        with pytest.raises(CheckpointError, match=rf"{folder}: leads to .*not mounted, which is not there; mount its"):
            restore(run, WEIGHTS, Group(), print)
    assert (tmp_path / "run" / "metrics.jsonl").read_text()


@pytest.mark.parametrize("folder", ["policies", "checkpoints"])
def test_what_a_run_does_not_go_on_from_is_kept_apart(tmp_path, folder):
    with RunDir(tmp_path) as run:
        for directory in (f"{folder}/10", f"{folder}/20", f"{folder}/25", f"discarded/{folder}/25"):
            (tmp_path / directory).mkdir(parents=True)
            (tmp_path / directory / "which").write_text(directory)
        (tmp_path / folder / "30.tmp").mkdir()
        run.discard_after(10)
        assert {p.name for p in (tmp_path / folder).iterdir()} == {"10", "30.tmp"}
        moved = {p.name: (p / "which").read_text() for p in (tmp_path / "discarded" / folder).iterdir()}
        assert moved == {"20": f"{folder}/20", "25": f"{folder}/25"}


@pytest.mark.parametrize("folder", ["policies", "checkpoints"])
def test_what_a_run_does_not_go_on_from_stays_on_its_own_disk(tmp_path, folder):
    with tempfile.TemporaryDirectory(dir="/dev/shm") as name, RunDir(tmp_path) as run:
        disk = Path(name)
        if disk.stat().st_dev == tmp_path.stat().st_dev:
            pytest.skip("temporary files are in /dev/shm, too")
        (tmp_path / folder).symlink_to(disk)
        for directory in ("10", "20", "25", "discarded/25"):
            (disk / directory).mkdir(parents=True)
            (disk / directory / "which").write_text(directory)
        for _ in range(2):  # the second time there is nothing to do
            run.discard_after(10)
            assert {p.name for p in disk.iterdir()} == {"10", "discarded"}
            assert saved_steps(tmp_path / folder) == [10]
            assert {p.name: (p / "which").read_text() for p in (disk / "discarded").iterdir()} == {
                "20": "20",
                "25": "25",
            }


def evaluated(*num_updates: int) -> list[str]:
    return [json.dumps({"schema": 1, "num_updates": n, "episode": n % 7}) + "\n" for n in num_updates]


def test_evaluations_of_policies_that_a_run_never_had_are_kept_apart(tmp_path):
    file, moved = tmp_path / "evaluation.jsonl", tmp_path / "discarded" / "evaluation.jsonl"
    player = '{"schema": 1, "player": "random", "episode": 0}\n'
    early, late, later = evaluated(10, 20, 30)
    with RunDir(tmp_path) as run:
        run.discard_after(10)
        file.write_text(late + early + "no row\n" + player + later.rstrip())
        run.discard_after(10)
        assert file.read_text() == early + "no row\n" + player
        assert moved.read_text() == late + later
        run.discard_after(10)
        file.write_text(early + later + early[:9])
        run.discard_after(10)
    assert file.read_text() == early + early[:9]
    assert moved.read_text() == late + later + later
    assert not (tmp_path / "evaluation.jsonl.tmp").exists()


@pytest.mark.parametrize("left", ["policy", "rows"])
def test_a_run_does_not_discard_what_is_being_evaluated(tmp_path, left):
    (early,) = evaluated(10)
    with RunDir(tmp_path) as run:
        evaluation = records.Writer(tmp_path / "evaluation.jsonl")
        assert evaluation.lock()
        evaluation.append({"num_updates": 10, "episode": 3})
        run.discard_after(10)  # there is nothing to discard
        if left == "policy":
            (tmp_path / "policies" / "20").mkdir(parents=True)
        else:
            evaluation.append({"num_updates": 20, "episode": 6})
        with pytest.raises(ResumeError, match=r"evaluation.jsonl is being written by another process, .* update 10, "):
            run.discard_after(10)
        assert not (tmp_path / "discarded").exists()
        evaluation.close()
        run.discard_after(10)
    assert (tmp_path / "evaluation.jsonl").read_text() == early
    assert {p.name for p in (tmp_path / "discarded").iterdir()} == (
        {"policies"} if left == "policy" else {"evaluation.jsonl"}
    )


def test_evaluations_stay_as_they_are_where_a_full_disk_cannot_take_the_discarded_ones(tmp_path):
    text = "".join(evaluated(10, 20, 10, 10))
    (tmp_path / "evaluation.jsonl").write_text(text)
    with RunDir(tmp_path) as run:
        for limit_bytes in (10, 60):  # for the discarded row, and for those that stay
            with full_disk(limit_bytes), pytest.raises(ResumeError, match="File too large"):
                run.discard_after(10)
            assert (tmp_path / "evaluation.jsonl").read_text() == text
            assert not (tmp_path / "evaluation.jsonl.tmp").exists()


def test_what_goes_by_the_length_of_a_run_is_said_when_that_changes(tmp_path):
    longer = dataclasses.replace(CONFIG.learner, total_updates=2 * CONFIG.learner.total_updates)
    with RunDir(tmp_path) as run:
        run.write_config(CONFIG)
        (note,) = run.check_resumable(dataclasses.replace(CONFIG, learner=longer, max_processor_s=9.0))
        assert note == (
            "learner.total_updates: 200000 -> 400000: the importance-sampling exponent, which goes from 0.4 to 1 by "
            "its end, is from now on that of a run of 400000 gradient steps"
        )
        plain, equal = ({"prioritized": False, "equal_shares": shares} for shares in (False, True))
        uniform = ((plain, 1, []), (plain, 2, [note]), (equal, 1, [note]))
        for changes, n, notes in (({"importance_sampling_exponent_end": 0.4}, 1, []), *uniform):
            other = dataclasses.replace(CONFIG, replay=dataclasses.replace(CONFIG.replay, **changes))
            run.write_config(other)
            learner = dataclasses.replace(longer, devices=n)
            assert run.check_resumable(dataclasses.replace(other, learner=learner)) == notes
        ppo = load_config("ppo_quick")
        ppo = dataclasses.replace(ppo, learner=dataclasses.replace(ppo.learner, learning_rate_decay=True))
        run.write_config(ppo)
        assert run.check_resumable(ppo) == []
        ppo = dataclasses.replace(ppo, learner=dataclasses.replace(ppo.learner, total_updates=10**6))
        (note,) = run.check_resumable(ppo)
        assert "the learning rate, which falls to 0 at its end, is from now on" in note


def test_a_path_that_cannot_be_made_says_so(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ResumeError, match=r"file/run: Not a directory; mend this, or choose another with --run-dir"):
        RunDir(tmp_path / "file" / "run")


def test_the_saved_configuration_comes_back(tmp_path):
    with RunDir(tmp_path) as run:
        assert run.saved_config() is None
        run.write_config(CONFIG)
        saved = run.saved_config()
        assert saved is not None
        assert saved.agent == CONFIG.with_support(CONFIG.support).agent
        assert saved.num_lanes == CONFIG.num_lanes
        run.check_resumable(CONFIG)


def test_a_change_of_meaning_is_refused_field_by_field(tmp_path):
    with RunDir(tmp_path) as run:
        run.write_config(CONFIG)
        other = dataclasses.replace(
            CONFIG,
            seed=3,
            env=dataclasses.replace(CONFIG.env, reward_weights=(("kill", 2.0),)),
            learner=dataclasses.replace(CONFIG.learner, batch_size=64, total_updates=300_000),
            log=dataclasses.replace(CONFIG.log, period_updates=7),
            agent=dataclasses.replace(CONFIG.agent, conv_form="direct"),
        )
        with pytest.raises(ResumeError) as refusal:
            run.check_resumable(other)
    text = str(refusal.value)
    for part in ("seed: 1111 -> 3", "env.reward_weights: () -> (('kill', 2.0),)", "learner.batch_size: 32 -> 64"):
        assert part in text
    assert not any(name in text for name in ("total_updates", "log.", "conv_form"))


@pytest.mark.parametrize("support", [(-6.9, 14.1), None])
def test_a_run_that_began_with_other_atoms_goes_on_with_those_alone(tmp_path, support):
    """Of another version of this package, or of one that did not note them."""
    with RunDir(tmp_path) as run:
        run.write_config(CONFIG)
        file = tmp_path / "config.json"
        saved = json.loads(file.read_text())
        saved["resolved"]["support"] = support
        file.write_text(json.dumps(saved))
        low, _ = CONFIG.support
        with pytest.raises(ResumeError, match=f"agent.v_min: {support and support[0]} -> {low}"):
            run.check_resumable(CONFIG)
        if support is not None:
            run.check_resumable(CONFIG.with_support(support))


def test_a_run_of_another_schema_cannot_be_resumed(tmp_path):
    with RunDir(tmp_path) as run:
        run.write_config(CONFIG)
        file = tmp_path / "config.json"
        saved = json.loads(file.read_text())
        file.write_text(json.dumps({**saved, "schema": 1}))
        with pytest.raises(ResumeError, match="got schema 1, want a map with schema 2; start again"):
            run.check_resumable(CONFIG)


def test_total_updates_may_not_shrink(tmp_path):
    with RunDir(tmp_path) as run:
        run.write_config(CONFIG)
        learner = dataclasses.replace(CONFIG.learner, total_updates=5)
        with pytest.raises(ResumeError, match=r"total_updates: 200000 -> 5 \(it may only grow\)"):
            run.check_resumable(dataclasses.replace(CONFIG, learner=learner))


def test_a_damaged_config_is_named(tmp_path):
    with RunDir(tmp_path) as run:
        for text in ('{"schema": 1, "config": {"nam', "[" * 100_000, '{"schema": 1, "config": {}}'):
            (tmp_path / "config.json").write_text(text)
            with pytest.raises(ResumeError, match=r"config.json cannot be read"):
                run.saved_config()


def test_records_are_cut_to_what_a_checkpoint_vouches_for(tmp_path):
    with RunDir(tmp_path) as run:
        run.append("episodes.jsonl", {"episode": 0})
        lengths = run.record_lengths()
        run.append("episodes.jsonl", {"episode": 1})
        assert run.truncate_records(lengths) > 0
        assert run.truncate_records(lengths) == 0
    rows, problems = records.read(tmp_path / "episodes.jsonl")
    assert ([row["episode"] for row in rows], problems) == ([0], [])
    assert json.loads((tmp_path / "discarded" / "episodes.jsonl").read_text())["episode"] == 1


def test_everything_readable_of_a_damaged_record_is_read(tmp_path):
    file = tmp_path / "episodes.jsonl"
    file.write_text('{"schema": 1, "a": 1}\nnonsense\n{"schema": 9}\n[1]\n{"schema": 1, "a": 2}\n{"schema": 1, "a')
    rows, problems = records.read(file)
    assert [row["a"] for row in rows] == [1, 2]
    assert [p.split(": ", 1)[1] for p in problems] == [
        "not JSON (half-written?)",
        "schema 9, want 1",
        "schema 'list', want 1",
        "not JSON (half-written?)",
    ]


def test_a_small_file_that_unpacks_to_a_huge_line_is_not_read_on(tmp_path):
    file = tmp_path / "episodes.jsonl.gz"
    file.write_bytes(gzip.compress(b'{"schema": 1}\n' + b" " * 50_000_000))
    assert file.stat().st_size < 100_000
    rows, (problem,) = records.read(file)
    assert rows == [{"schema": 1}]
    assert "line 2: not read on; want lines shorter than 1048576 characters, and at most 4194304 of them" in problem


def test_more_lines_than_any_run_writes_are_not_read(tmp_path, monkeypatch):
    monkeypatch.setattr(records, "MAX_LINES", 2)
    (tmp_path / "episodes.jsonl").write_text('{"schema": 1}\n' * 5)
    rows, problems = records.read(tmp_path / "episodes.jsonl")
    assert (len(rows), len(problems)) == (2, 1)


def test_a_missing_record_file_is_an_error(tmp_path):
    with pytest.raises(GvzError, match="no such record file"):
        records.read(tmp_path / "episodes.jsonl")


def test_fresh_moves_an_old_run_aside(tmp_path):
    path = tmp_path / "run"
    assert move_aside(path) is None
    for _ in range(2):  # twice within a second: the names must not collide
        with RunDir(path) as run:
            run.write_config(CONFIG)
        moved = move_aside(path)
        assert moved is not None
        assert (moved / "config.json").exists()
        assert not path.exists()


def test_fresh_refuses_what_is_no_run_or_in_use(tmp_path):
    (tmp_path / "thesis.tex").write_text("precious")
    with pytest.raises(ConfigError, match="is not a run directory"):
        move_aside(tmp_path)
    with RunDir(tmp_path / "run"), pytest.raises(ResumeError, match="another running process"):
        move_aside(tmp_path / "run")


def test_fresh_moves_the_directory_that_one_is_in(tmp_path, monkeypatch):
    with RunDir(tmp_path / "run") as run:
        run.write_config(CONFIG)
    monkeypatch.chdir(run.path)
    moved = move_aside(Path())
    assert moved is not None
    assert [path for path in tmp_path.iterdir() if (path / "config.json").exists()] == [moved]


def test_fresh_says_what_it_cannot_move(tmp_path):
    (tmp_path / "file").write_text("precious")
    with pytest.raises(ResumeError, match=r"file: Not a directory; mend this"):
        move_aside(tmp_path / "file")
    assert (tmp_path / "file").read_text() == "precious"


def test_a_run_that_starts_on_a_full_disk_says_so_and_keeps_its_records(tmp_path):
    with RunDir(tmp_path) as run:
        run.write_config(CONFIG)
        before = (tmp_path / "config.json").read_bytes()
        run.append("episodes.jsonl", {"text": "x" * 500})
        with full_disk(100):
            for action in (lambda: run.write_config(CONFIG), lambda: run.truncate_records({"episodes.jsonl": 0})):
                with pytest.raises(
                    ResumeError, match=r"run directory .*: (File too large|No space left on device); mend"
                ):
                    action()
        assert (tmp_path / "config.json").read_bytes() == before
        assert len(records.read(tmp_path / "episodes.jsonl")[0]) == 1


def test_rows_wait_for_room_on_a_full_disk_and_none_is_lost_or_torn(tmp_path):
    wanted = [{"number": number, "text": "x" * 100} for number in range(100)]
    with RunDir(tmp_path) as run:
        for row in wanted[:10]:
            run.append("metrics.jsonl", row)
        whole = run.record_lengths()["metrics.jsonl"]
        with full_disk(whole + 300):
            for row in wanted[10:90]:
                run.append("metrics.jsonl", row)
            assert (tmp_path / "metrics.jsonl").stat().st_size == whole + 300, "the middle of a row"
            assert run.record_lengths()["metrics.jsonl"] > 8 * whole, "what waits is counted"
        for row in wanted[90:]:
            run.append("metrics.jsonl", row)
        assert run.record_lengths()["metrics.jsonl"] == (tmp_path / "metrics.jsonl").stat().st_size
    rows, problems = records.read(tmp_path / "metrics.jsonl")
    assert problems == []
    assert rows == [{"schema": records.SCHEMA, **row} for row in wanted]


def test_rows_that_wait_are_written_at_the_end_or_said_to_be_lost(tmp_path):
    with RunDir(tmp_path / "late") as run:
        with full_disk(0):
            run.append("metrics.jsonl", {})
        assert (tmp_path / "late" / "metrics.jsonl").stat().st_size == 0
    assert len(records.read(tmp_path / "late" / "metrics.jsonl")[0]) == 1
    run = RunDir(tmp_path / "lost")
    with full_disk(0):
        run.append("metrics.jsonl", {})
        with pytest.raises(
            GvzError, match=r"metrics.jsonl: 14 bytes of records cannot be written: File too large; mak"
        ):
            run.close()
    run.close()
    RunDir(tmp_path / "lost").close()


def test_rows_do_not_wait_without_bound(tmp_path, monkeypatch):
    monkeypatch.setattr(records, "MAX_WAITING_BYTES", 1000)
    with RunDir(tmp_path) as run, full_disk(0):
        for _ in range(71):
            run.append("metrics.jsonl", {})
        with pytest.raises(GvzError, match="1008 bytes of records cannot be written"):
            run.append("metrics.jsonl", {})
