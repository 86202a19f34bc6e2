"""The head of a report says who beats whom, and only where it can be told."""

import json

from gvz.experiments.plan import Plan
from gvz.reports.abstract import caveats, what_beats_what, what_was_run
from gvz.reports.results import read_results
from gvz.tasks import named_tasks

OFFSETS = {1111: 0.0, 2222: 1.0, 3333: 2.0}


def test_trained_agents_first_then_the_best_beside_players(tmp_path, experiments_writer):
    def score(played) -> float:
        return (60.0 if played.run.config == "rainbow_quick" else 20.0) + OFFSETS[played.run.seed] + played.episode

    experiments_writer(tmp_path, Plan(names=("quick_comparison",), scale=0.2), score)  # 5 episodes; players: 22
    scripted = tmp_path / "players" / "scripted.jsonl"
    rows = [json.loads(line) for line in scripted.read_text().splitlines()]
    scripted.write_text("".join(json.dumps({**row, "normalized_score": 90.0 + row["episode"]}) + "\n" for row in rows))
    results = read_results([tmp_path])
    (sentence,) = what_beats_what(results)
    assert sentence.startswith("Defend the Center, mean of the 7 test tasks: rainbow_quick beats dqn_quick by 40.0 [")
    assert "; rainbow_quick beats random by 41.0 [" in sentence
    assert "; rainbow_quick is behind scripted by -29.0 [" in sentence
    assert caveats(results) == ["Scale 0.2: budgets and episodes are shrunk; not comparable with published numbers."]
    assert "6 training runs of 2 agents (dqn_quick, rainbow_quick), 3 training seeds" in " ".join(what_was_run(results))


def test_what_cannot_be_told_apart_is_said(tmp_path):
    task = named_tasks("seek_and_kill")[0].id
    for player in ("random", "idle"):
        rows = [{"player": player, "task": task, "episode": n, "seed": n, "score": float(n)} for n in range(9)]
        (tmp_path / f"{player}.jsonl").write_text("".join(json.dumps({"schema": 1, **row}) + "\n" for row in rows))
    (sentence,) = what_beats_what(read_results([tmp_path]))
    assert sentence.startswith("Seek and Kill, default: no difference shown between idle and random (0.0 [")
