"""The table that an evaluation ends with."""

from gvz.evaluation.table import score_lines
from gvz.tasks import named_tasks


def test_each_task_has_its_mean_interval_and_episodes():
    default, blue = named_tasks("seek_and_kill")[:2]
    rows = [{"player": "p", "task": default.id, "episode": n, "score": 4.0, "normalized_score": 20.0} for n in range(3)]
    rows.append({**rows[0], "player": "somebody else", "score": 9.0})
    rows.append({**rows[0], "episode": 3, "score": 9.0})  # beyond the episodes asked for
    head, line = score_lines(rows, {"player": "p"}, [default, blue], episodes=3)
    assert head.split()[:3] == ["task", "level", "episodes"]
    assert line.split() == [default.id, "0", "3", "4.0", "[4.0,", "4.0]", "20.0", "[20.0,", "20.0]"]


def test_the_last_line_is_the_mean_over_tasks():
    default, blue = named_tasks("seek_and_kill")[:2]
    rows = [
        {"player": "p", "task": task.id, "episode": n, "score": percent / 5, "normalized_score": percent}
        for task, percent, episodes in ((default, 20.0, 4), (blue, 50.0, 1))
        for n in range(episodes)
    ]
    *_, line = score_lines(rows, {"player": "p"}, [default, blue], episodes=4)
    assert line.split() == ["mean", "of", "2", "tasks", "5", "35.0", "[35.0,", "35.0]"]
