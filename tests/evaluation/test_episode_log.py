"""Record files of evaluations: what is there is not played again, what is half there is."""

import json
import os
from dataclasses import replace
from pathlib import Path

import pytest

import gvz
from gvz.core.env_config import EnvConfig
from gvz.core.errors import ConfigError, TaskError
from gvz.evaluation.episode_log import (
    RecordFile,
    evaluate_player,
    missing_jobs,
    play_and_record,
    read_rows,
    rows_of,
    simple_player,
    wanted_episodes,
)
from gvz.evaluation.play import Episode
from gvz.evaluation.players import IdlePlayer, RandomPlayer, SweepPlayer
from gvz.evaluation.simple import player_env
from gvz.tasks import Task, parse_task

TASK = parse_task("defend_the_center/fast_enemies")
IDLE = simple_player("idle", EnvConfig())


def row(player: str, episode: int, **fields) -> dict:
    return {**IDLE.identity, "player": player, "task": TASK.id, "episode": episode, **fields}


@pytest.fixture
def file(tmp_path):
    file = RecordFile(tmp_path / "evaluation.jsonl")
    yield file
    file.close()


def test_each_base_seed_has_episodes_of_its_own():
    wanted = wanted_episodes([TASK], 2, [0, 5])
    assert wanted == [(TASK.id, 0, 0), (TASK.id, 1, 0), (TASK.id, 0, 5), (TASK.id, 1, 5)]


def test_only_rows_of_the_same_player_rules_and_base_seed_count(file):
    for line in (
        row("idle", 0),  # as written before there were base seeds
        row("random", 1),
        row("idle", 2, profile="levdoom"),
        row("idle", 2, frame_skip=1),
        row("idle", 2, action_set="buttons"),
        row("idle", 2, observes="labels"),
        row("idle", 3, num_updates=5),
        row("idle", 1, base_seed=5),
    ):
        file.append(line)
    jobs = missing_jobs(IDLE, file, wanted_episodes([TASK], 4, [0, 5]))
    assert {job[0] for job in jobs} == {IDLE}
    assert sorted(job[1] for job in jobs) == [
        *((TASK.id, 0, 5), (TASK.id, 1, 0), (TASK.id, 2, 0), (TASK.id, 2, 5), (TASK.id, 3, 5))
    ]


def test_of_two_rows_of_one_episode_the_first_counts(file):
    for score in (1.0, 2.0):
        file.append(row("idle", 0, score=score))
    assert [one["score"] for one in rows_of(IDLE, file.rows).values()] == [1.0]


def test_a_half_written_line_is_cut_off(tmp_path):
    path = tmp_path / "evaluation.jsonl"
    file = RecordFile(path)
    file.append(row("idle", 0))
    file.append(row("idle", 1))
    file.close()
    path.write_bytes(path.read_bytes()[:-7])  # as a kill would leave it
    file = RecordFile(path)
    assert [r["episode"] for r in file.rows] == [0]
    file.append(row("idle", 1))
    file.close()
    assert [r["episode"] for r in read_rows(path)] == [0, 1]


def test_a_file_with_half_a_first_line_is_empty(tmp_path):
    path = tmp_path / "evaluation.jsonl"
    path.write_text('{"schema": 1')
    assert read_rows(path) == []
    assert path.read_bytes() == b""


@pytest.mark.parametrize("text", ["precious, on one line", "two\nlines", '{"schema": 1, "task": "x"}\nhalf'])
def test_a_last_line_that_is_no_row_of_ours_is_not_cut_off(tmp_path, text):
    path = tmp_path / "notes.txt"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"last line: got b'.*', no row of an evaluation; move the file aside"):
        RecordFile(path)
    assert path.read_text() == text


@pytest.mark.parametrize("fields", [{}, {"task": [], "episode": 1}, {"task": "x", "episode": "1"}])
def test_a_row_without_task_or_episode_is_refused(tmp_path, fields):
    path = tmp_path / "evaluation.jsonl"
    path.write_text(json.dumps({"schema": 1, **IDLE.identity, **fields}) + "\n")
    with pytest.raises(ConfigError, match=r"row 1: got task, episode and base seed \(.*\): no row of an evaluation"):
        RecordFile(path)


def test_a_device_is_no_record_file(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (Path("/dev/zero"), tmp_path / "pipe"):  # the first would be read without an end
        with pytest.raises(ConfigError, match=f"--out: {path} is no regular file"):
            RecordFile(path)


def test_rows_can_be_thrown_away():
    file = RecordFile(Path(os.devnull))
    assert file.rows == []
    file.close()


@pytest.mark.parametrize("line", ["nonsense", json.dumps({"schema": 99})])
def test_a_file_of_something_else_is_refused_and_left_alone(tmp_path, line):
    path = tmp_path / "evaluation.jsonl"
    path.write_text(f"{line}\n")
    with pytest.raises(ConfigError, match=r"line 1: .*move the file aside or give another with --out"):
        RecordFile(path)
    assert path.read_text() == f"{line}\n"


def test_two_processes_cannot_write_one_file(tmp_path):
    file = RecordFile(tmp_path / "evaluation.jsonl")
    with pytest.raises(ConfigError, match=r"evaluation\.jsonl is being written by another process"):
        RecordFile(tmp_path / "evaluation.jsonl")
    file.close()
    RecordFile(tmp_path / "evaluation.jsonl").close()


def test_a_place_that_cannot_be_written_is_an_error(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="cannot be written: "):
        RecordFile(tmp_path / "file" / "evaluation.jsonl")


@pytest.mark.engine
def test_an_evaluation_goes_on_where_it_was_left(tmp_path):
    path = tmp_path / "evaluation.jsonl"
    wanted = wanted_episodes([TASK], 2)
    file = RecordFile(path)
    rows = play_and_record({IDLE: file}, missing_jobs(IDLE, file, wanted), num_workers=1)
    first = next(rows)
    assert read_rows(path) == [first], "a row is on disk before it is told of"
    rows.close()
    file.close()
    file = RecordFile(path)
    jobs = missing_jobs(IDLE, file, wanted)
    assert jobs == [(IDLE, Episode(TASK.id, 1 - first["episode"]))]
    list(play_and_record({IDLE: file}, jobs, num_workers=0))
    assert missing_jobs(IDLE, file, wanted) == []
    assert {r["episode"] for r in read_rows(path)} == {0, 1}
    file.close()


@pytest.mark.engine
def test_anybody_s_player_is_evaluated_by_the_same_protocol(tmp_path):
    path, env = tmp_path / "rows.jsonl", player_env("random", EnvConfig())
    mine = evaluate_player(RandomPlayer, [TASK.id], path, name="mine", episodes=2, env=env)
    assert [(r["player"], r["task"], r["episode"]) for r in mine] == [("mine", TASK.id, 0), ("mine", TASK.id, 1)]
    file = RecordFile(path)
    random = simple_player("random", EnvConfig())
    jobs = missing_jobs(random, file, wanted_episodes([TASK], 2))
    theirs = sorted(play_and_record({random: file}, jobs, num_workers=0), key=lambda r: r["episode"])
    file.close()
    assert [{**r, "player": "mine"} for r in theirs] == mine
    # nothing is left to play: IdlePlayer would fail, since this action set has no idle action
    assert evaluate_player(IdlePlayer, [TASK], path, name="mine", episodes=2, env=env) == mine
    assert len(read_rows(path)) == 4


@pytest.mark.engine
def test_an_evaluation_says_which_episodes_it_does_not_play_again(tmp_path, capsys):
    path, env = tmp_path / "rows.jsonl", player_env("random", EnvConfig())

    def play(name: str, episodes: int) -> str:
        evaluate_player(RandomPlayer, [TASK], path, name=name, episodes=episodes, env=env)
        return capsys.readouterr().err

    def said(held: int, wanted: int) -> str:
        return f"{path}: holds {held} of these {wanted} episodes of 'mine', which are not played again; another player "

    assert play("mine", 1) == ""
    assert play("mine", 1) == said(1, 1) + "needs another name\n"
    assert play("mine", 2) == said(1, 2) + "needs another name\n"
    assert play("other", 1) == ""


@pytest.mark.engine
def test_rows_say_what_else_than_the_screen_a_player_observes(tmp_path):
    def play(**env) -> list[dict]:
        return evaluate_player(RandomPlayer, [TASK], path, name="mine", episodes=1, env=EnvConfig(**env))

    path = tmp_path / "rows.jsonl"
    (screen,), (classes,) = play(), play(frames="classes")
    assert classes == {**screen, "observes": "classes"}
    assert play(frames="segmented", segmenter="train4", sight=True) == [
        {**screen, "observes": "segmented train4, sight"}
    ]
    assert play(buffers=("labels", "depth"))[0]["observes"] == "labels, depth"
    assert (play(), play(frames="classes")) == ([screen], [classes])
    assert len(read_rows(path)) == 4


@pytest.mark.engine
def test_actions_are_never_repeated_by_chance_in_an_evaluation(tmp_path):
    task, env = "dodge_projectiles/default", player_env("sweep", EnvConfig())
    plain, sticky = (
        evaluate_player(SweepPlayer, [task], tmp_path / name, name="mine", episodes=1, env=one)
        for name, one in (("plain", env), ("sticky", replace(env, repeat_action_probability=0.9)))
    )
    assert plain == sticky


def test_a_task_that_other_processes_do_not_know_is_refused(tmp_path):
    changed = Task(replace(TASK.scenario, timeouts={"thesis": 100, "levdoom": 100}))
    elsewhere = Task(replace(TASK.scenario, id="elsewhere"))
    for task, message in ((changed, "differs from that in gvz/scenarios"), (elsewhere, "is not in gvz/scenarios")):
        with pytest.raises(TaskError, match=message):
            evaluate_player(RandomPlayer, [task], tmp_path / "rows.jsonl", name="mine")
        with pytest.raises(TaskError, match=message):
            gvz.make_vec([TASK, task])


def test_a_compressed_file_is_not_written_to(tmp_path):
    with pytest.raises(ConfigError, match=r"rows\.jsonl\.gz, want a name without \.gz"):
        RecordFile(tmp_path / "rows.jsonl.gz")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("tasks", [["nowhere/default"], "nowhere/default"])
def test_a_player_is_not_evaluated_on_an_unknown_task_also_if_it_is_named_alone(tmp_path, tasks):
    with pytest.raises(TaskError, match="unknown scenario 'nowhere'"):
        evaluate_player(RandomPlayer, tasks, tmp_path / "rows.jsonl", name="mine")


@pytest.mark.parametrize(
    ("tasks", "options", "message"),
    [
        ([TASK], {"name": "random"}, r"name: got 'random', want a name of its own, not random, idle, sweep, scripted"),
        ([TASK], {"name": " "}, "name: got ' ', want a name of its own"),
        ([TASK], {"name": "mine", "episodes": 0}, "got 0 episodes, base_seed 0; want 1 or more"),
        ([TASK], {"name": "mine", "base_seed": -1}, "got 100 episodes, base_seed -1; .* a seed of 0 to"),
        ([], {"name": "mine"}, "tasks: got none, want at least one"),
    ],
)
def test_an_evaluation_that_gives_no_rows_of_a_player_is_refused(tmp_path, tasks, options, message):
    """Rows named "random" would be those of random play in a report."""
    with pytest.raises(ConfigError, match=message):
        evaluate_player(RandomPlayer, tasks, tmp_path / "rows.jsonl", **options)
    assert list(tmp_path.iterdir()) == []
