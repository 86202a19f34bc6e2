"""The table that an evaluation ends with."""

from gvz.evaluation.metrics import Estimate
from gvz.evaluation.table import Score, score_lines, score_row, scores
from gvz.tasks import named_tasks


def test_each_task_has_its_mean_interval_and_episodes():
    default, blue = named_tasks("seek_and_kill")[:2]
    rows = [{"player": "p", "task": default.id, "episode": n, "score": 4.0, "normalized_score": 20.0} for n in range(3)]
    rows.append({**rows[0], "player": "somebody else", "score": 9.0})
    rows.append({**rows[0], "episode": 3, "score": 9.0})  # beyond the episodes asked for
    head, line = score_lines(scores(rows, {"player": "p"}, [default, blue], episodes=3))
    assert head.split()[-3:] == ["episodes", "level", "task"]
    assert line.split() == ["4.0", "[4.0,", "4.0]", "20.0", "[20.0,", "20.0]", "3", "0", default.id]
    assert line.index(default.id) == head.index("task")


def test_the_last_line_is_the_mean_over_tasks():
    default, blue = named_tasks("seek_and_kill")[:2]
    rows = [
        {"player": "p", "task": task.id, "episode": n, "score": percent / 5, "normalized_score": percent}
        for task, percent, episodes in ((default, 20.0, 4), (blue, 50.0, 1))
        for n in range(episodes)
    ]
    found = scores(rows, {"player": "p"}, [default, blue], episodes=4)
    assert score_lines(found)[-1].split() == ["35.0", "[35.0,", "35.0]", "5", "mean", "of", "2", "tasks"]
    row = score_row(found[-1])
    assert (row["task"], row["level"], row["score"], row["normalized_score"]) == (None, None, None, 35.0)


def test_a_score_as_json_has_the_ends_of_its_intervals():
    (default, *_) = named_tasks("seek_and_kill")
    score, percent = Estimate(value=4.0, low=3.0, high=5.5), Estimate(value=20.0, low=15.0, high=27.5)
    row = score_row(Score(task=default, episodes=3, score=score, percent=percent))
    assert (row["task"], row["level"], row["episodes"]) == (default.id, 0, 3)
    assert (row["score"], row["score_low"], row["score_high"]) == (4.0, 3.0, 5.5)
    assert (row["normalized_score"], row["normalized_score_low"], row["normalized_score_high"]) == (20.0, 15.0, 27.5)
