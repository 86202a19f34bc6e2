"""What the findings say of PPO on segmented frames is what its records give."""

import numpy as np

from gvz.evaluation.statistics import difference
from gvz.reports.scores import agent_scores, estimate_groups
from tests.score_tables import metrics_of, score_cells, task_sets, training_episodes
from tests.test_results import ROOT, results_of

CENTER = "defend_the_center"
PERIODS_S = ((300, 600), (900, 1_500), (2_400, 3_000), (4_800, 5_400))
RUNS = {
    "Rainbow, seed 1111": f"general/runs/rainbow_segmented/{CENTER}/train8/seed_1111",
    "Rainbow, seed 2222": f"general/runs/rainbow_segmented/{CENTER}/train8/seed_2222",
    "PPO, seed 1111": f"general_on_policy/runs/ppo_segmented/{CENTER}/train8/seed_1111",
}


def test_the_findings_say_what_ppo_has_beside_segmented_frames():
    page = (ROOT / "docs" / "FINDINGS.md").read_text()
    words = " ".join(page.split())
    rainbow, ppo = (
        agent_scores(results_of(folder).episodes.filter(scenario=CENTER), agent)
        for folder, agent in (("general", "rainbow_segmented"), ("general_on_policy", "ppo_segmented"))
    )
    assert f"| Rainbow, two seeds | {score_cells(rainbow, CENTER)} |" in page
    assert f"| PPO, one seed | {score_cells(ppo, CENTER)} |" in page
    gains = [
        estimate_groups([(scores, tasks) for scores in (ppo, rainbow)], difference).text for tasks in task_sets(CENTER)
    ]
    said = "the differences are {}, {} and {} points on training, gate and test tasks, on level 4 {}."
    assert said.format(*gains) in words
    summary = page.partition("## In short")[2].partition("\n## ")[0]
    assert f"not Rainbow, beside segmented frames | {gains[1].split()[0]} | | | | no |" in summary
    last = metrics_of(ROOT / "results" / RUNS["PPO, seed 1111"])[-1]
    assert f"{last['num_updates']:,} gradient steps and {round(last['actors/env_steps'], -4):,} decisions" in words


def test_the_findings_say_how_ppo_learned_beside_segmented_frames():
    page = (ROOT / "docs" / "FINDINGS.md").read_text()
    for title, run in RUNS.items():
        cells = []
        for low_s, high_s in PERIODS_S:
            found = training_episodes(ROOT / "results" / run, low_s, high_s)
            assert len({row["lane"] for row in found}) == 16
            scores, kills = (
                np.mean([row["normalized_score"] for row in found]),
                np.mean([row["reward_components"]["kill"] for row in found]),
            )
            cells.append(f"{scores:.1f}, {kills:.1f}")
        assert f"| {title} | {' | '.join(cells)} |" in page
