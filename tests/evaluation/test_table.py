"""The table that an evaluation ends with."""

from gvz.evaluation.table import score_lines, score_rows
from gvz.tasks import named_tasks


def test_each_task_has_its_mean_interval_and_episodes():
    default, blue = named_tasks("defend_the_center")[:2]
    rows = [{"player": "p", "task": default.id, "episode": n, "score": 4.0, "normalized_score": 20.0} for n in range(3)]
    head, line = score_lines(score_rows(rows, [default, blue]))
    assert head.split()[-3:] == ["episodes", "level", "task"]
    assert line.split() == ["4.0", "[4.0,", "4.0]", "20.0", "[20.0,", "20.0]", "3", "0", default.id]
    assert line.index(default.id) == head.index("task")


def test_rows_of_earlier_versions_have_what_follows_from_their_score():
    (default, *_) = named_tasks("defend_the_center")
    rows = [{"player": "p", "task": default.id, "episode": n, "score": 110.0} for n in (0, 1)]
    (row,) = score_rows(rows, [default])
    assert (row["episodes"], row["score"], row["normalized_score"]) == (2, 110.0, 10.0)
    (row,) = score_rows([{**rows[0], "profile": "levdoom", "score": 210.0}], [default])
    assert row["normalized_score"] == 10.0, "of 2100 frames"
    (kills, *_) = named_tasks("seek_and_kill")
    (row,) = score_rows([{**rows[0], "task": kills.id, "score": 15.0}], [kills])
    assert (row["player_kills"], row["score"], row["normalized_score"]) == (None, 15.0, 75.0)


def test_own_kills_stand_beside_a_score_that_is_kills():
    default, blue = named_tasks("seek_and_kill")[:2]
    (gore,) = named_tasks("defend_the_center", level=0)
    rows = [
        {"player": "p", "task": t.id, "episode": 0, "score": 8.0, "normalized_score": 40.0, "player_kills": own}
        for t, own in ((default, 3.0), (blue, 6.0), (gore, 7.0))
    ]
    found = score_rows(rows, [default, blue])
    head, first, _, last = score_lines(found)
    assert head.split()[8:10] == ["own", "kills"]
    assert first.split()[6:9] == ["3.0", "[3.0,", "3.0]"]
    assert last.split()[3:6] == ["4.5", "[4.5,", "4.5]"]
    assert found[0]["player_kills_high"] == 3.0
    older = {"player": "p", "task": default.id, "episode": 1, "score": 8.0, "normalized_score": 40.0}
    assert score_rows([*rows, older], [default])[0]["player_kills"] is None
    mixed = score_rows(rows, [default, gore])
    assert [one["player_kills"] is None for one in mixed] == [False, True, True]
    _, first, second, _ = score_lines(mixed)
    assert first.index(default.id) == second.index(gore.id)


def test_the_last_line_is_the_mean_over_tasks():
    default, blue = named_tasks("defend_the_center")[:2]
    rows = [
        {"player": "p", "task": task.id, "episode": n, "score": percent / 5, "normalized_score": percent}
        for task, percent, episodes in ((default, 20.0, 4), (blue, 50.0, 1))
        for n in range(episodes)
    ]
    found = score_rows(rows, [default, blue])
    assert score_lines(found)[-1].split() == ["35.0", "[35.0,", "35.0]", "5", "mean", "of", "2", "tasks"]
    row = found[-1]
    assert (row["task"], row["level"], row["score"], row["normalized_score"]) == (None, None, None, 35.0)


def test_a_score_as_json_has_the_ends_of_its_intervals():
    (default, *_) = named_tasks("defend_the_center")
    rows = [{"player": "p", "task": default.id, "episode": n, "score": n, "normalized_score": 10 * n} for n in range(9)]
    (row,) = score_rows(rows, [default])
    assert (row["task"], row["level"], row["episodes"]) == (default.id, 0, 9)
    assert row["score_low"] < row["score"] == 4.0 < row["score_high"]
    assert row["normalized_score_low"] < row["normalized_score"] == 40.0 < row["normalized_score_high"]
    assert (row["player_kills"], row["player_kills_low"], row["player_kills_high"]) == (None, None, None)
