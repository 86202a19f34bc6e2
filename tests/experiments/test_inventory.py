"""What stands on the disk: checkpoints, episodes, logs."""

import dataclasses
import fcntl
import gzip
import json
import shutil
from pathlib import Path

import pytest

from gvz.experiments import inventory as progress
from gvz.experiments.base import TrainingRun
from gvz.experiments.plan import Evaluation

RUN = TrainingRun(
    config="rainbow_4task",
    scenario="defend_the_center",
    training="train1",
    tasks=("defend_the_center/default",),
    seed=1111,
    total_updates=300,
    num_checkpoints=3,
)


def row(task: str, episode: int, **more) -> str:
    return json.dumps({"schema": 1, "task": task, "episode": episode, **more}) + "\n"


def save_policies(results: Path, *steps: int) -> Path:
    directory = progress.run_directory(results, RUN)
    for step in steps:
        (directory / "policies" / str(step)).mkdir(parents=True)
    return directory


@pytest.mark.parametrize(
    ("saved", "standing"),
    [
        ((), ()),
        ((100, 200, 300), (100, 200, 300)),
        ((150, 200, 250, 300), (150, 200, 300)),  # 150: saved late; 250: saved when the run was stopped
        ((40, 100, 104), (100,)),
        ((104, 208, 300, 400), (104, 208, 300)),
        ((304,), ()),  # a longer run's: not the end of this one
    ],
)
def test_the_first_policy_at_or_after_a_checkpoint_stands_for_it(saved, standing):
    assert progress.standing_checkpoints(RUN, saved) == standing


def test_a_run_is_done_when_trained_and_every_episode_of_every_checkpoint_is_there(tmp_path):
    evaluation = Evaluation(tasks=("a", "b"), episodes=2)
    assert progress.run_progress(tmp_path, RUN, evaluation) == progress.RunProgress(
        num_updates=0, processor_s=0.0, trained=False, missing={}, absent=3
    )
    directory = save_policies(tmp_path, 100, 200, 300)
    episodes = [(c, t, n) for c in (100, 200, 300) for t in "ab" for n in (0, 1)]
    lines = [row(t, n, num_updates=c) for c, t, n in episodes]
    (directory / "evaluation.jsonl").write_text("".join(lines[:5] + lines[4:5]) + lines[5][:20])
    (directory / "metrics.jsonl").write_text('{"num_updates": 290}\n{"num_updates": 300}\n{"num_upd')
    found = progress.run_progress(tmp_path, RUN, evaluation)
    assert (found.num_updates, found.trained) == (300, True)
    assert found.missing == {200: 3, 300: 4}  # a row twice counts once, a half-written one not
    (directory / "evaluation.jsonl").write_text("".join(lines))
    found = progress.run_progress(tmp_path, RUN, evaluation)
    assert (found.trained, found.missing) == (True, {})
    shutil.rmtree(directory / "policies")  # as in records that are kept in a repository
    assert progress.run_progress(tmp_path, RUN, evaluation) == found


def test_a_run_with_a_limit_of_processor_time_is_trained_when_its_last_row_has_it_and_its_policy_stands(tmp_path):
    run, evaluation = (
        dataclasses.replace(RUN, max_processor_s=60.0, num_checkpoints=1),
        Evaluation(tasks=("a",), episodes=2),
    )
    directory = save_policies(tmp_path, 100, 180)

    def found(num_updates: int, processor_s: float) -> progress.RunProgress:
        row = {"num_updates": num_updates, progress.PROCESSOR_S: processor_s}
        (directory / "metrics.jsonl").write_text(json.dumps(row) + "\n")
        return progress.run_progress(tmp_path, run, evaluation)

    assert not found(180, 59.9).trained
    assert found(180, 60.0).trained
    assert not found(200, 60.1).trained, "its last policy is not saved yet"
    assert found(180, 60.1) == progress.RunProgress(
        num_updates=180, processor_s=60.1, trained=True, missing={180: 2}, absent=0
    ), "only the newest policy is evaluated"
    save_policies(tmp_path, 300)
    assert found(180, 60.1).missing == {180: 2}, "the policy of 300 was saved without a checkpoint, and then discarded"
    assert found(300, 20.0).trained, "it had all its gradient steps before"


def test_the_newest_row_of_metrics_is_found_however_many_tasks_it_has(tmp_path):
    tasks = {f"replay/share/seek_and_kill/task_{number}": 1 / 3_000 for number in range(3_000)}
    rows = [{"num_updates": updates, **tasks, progress.PROCESSOR_S: updates / 2} for updates in (100, 200)]
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows) + '{"num_updates": 3')
    assert (progress.last_update(tmp_path), progress.last_processor_s(tmp_path)) == (200, 100.0)


def test_a_finished_run_whose_records_are_compressed_is_as_far_as_they_say():
    """Of the committed results."""
    directory = Path(__file__).parents[2] / "results/quick_comparison/runs/dqn_quick/defend_the_center/train4/seed_1111"
    assert not (directory / "metrics.jsonl").exists()
    assert progress.last_update(directory) == 20_000


def test_an_end_line_that_a_full_disk_has_cut_is_no_end(tmp_path):
    line = f"{progress.END_MARK}130 after 12 s"
    for length in range(len(line)):
        (tmp_path / "one.log").write_text(f"launching\n{line[:length]}")
        assert progress.exit_code(tmp_path / "one.log") is None or length == len(line)
    (tmp_path / "one.log").write_text(f"launching\n{line}\n")
    assert progress.exit_code(tmp_path / "one.log") == 130


def test_episodes_of_another_base_seed_do_not_count(tmp_path):
    directory = save_policies(tmp_path, 100, 200, 300)
    (directory / "evaluation.jsonl").write_text(row("a", 0, num_updates=100, base_seed=7))
    found = progress.run_progress(tmp_path, RUN, Evaluation(tasks=("a",), episodes=1))
    assert found.missing == {100: 1, 200: 1, 300: 1}


def test_compressed_records_count(tmp_path):
    file = progress.player_file(tmp_path, "random")
    evaluation = Evaluation(tasks=("a",), episodes=3)
    assert progress.missing_player_episodes(file, evaluation) == 3
    file.parent.mkdir()
    file.with_name("random.jsonl.gz").write_bytes(gzip.compress((row("a", 0) + row("a", 1) + "[]\n{\n").encode()))
    assert progress.missing_player_episodes(file, evaluation) == 1


def test_a_job_s_state_is_read_from_its_lock_its_results_and_its_log(tmp_path):
    log = progress.log_file(tmp_path, "a/b")
    assert progress.job_state(tmp_path, "a/b", done=False, begun=False) == "waiting"
    log.parent.mkdir(parents=True)
    log.write_text("# python\nlaunching\nerror: the disk is full\n# ended with exit code 2 after 3 s\n")
    assert progress.job_state(tmp_path, "a/b", done=False, begun=True) == "failed"
    assert progress.last_words(log) == ["launching", "error: the disk is full"]
    assert progress.job_state(tmp_path, "a/b", done=True, begun=True) == "done"
    log.write_text("# ended with exit code 130 after 3 s\n")
    assert progress.job_state(tmp_path, "a/b", done=False, begun=False) == "stopped", "before it saved anything"
    for code in (129, 143):  # a terminal that was closed, and `kill`
        log.write_text(f"# ended with exit code {code} after 3 s\n")
        assert progress.job_state(tmp_path, "a/b", done=False, begun=True) == "stopped"
    log.write_text("killed in the midd")
    assert progress.job_state(tmp_path, "a/b", done=False, begun=True) == "stopped"
    with log.open("a") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        assert progress.job_state(tmp_path, "a/b", done=False, begun=True) == "running"
    assert progress.job_state(tmp_path, "a/b", done=False, begun=True) == "stopped"
