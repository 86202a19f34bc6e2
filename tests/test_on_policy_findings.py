"""What the findings say of PPO on segmented frames is what its records give."""

import json
from pathlib import Path

import numpy as np
import pytest

from gvz.reports.scores import Scores
from gvz.tasks import scenario_named, scenarios
from tests.score_tables import (
    PAGE,
    ROOT,
    SUMMARY,
    WORDS,
    gain,
    in_words,
    means,
    metrics_of,
    score_row,
    scores_of,
    task_mean,
    task_sets,
    training_episodes,
)

FOLDER = ROOT / "results" / "general_on_policy"
SCENARIOS = json.loads((FOLDER / "plan.json").read_text())["experiments"]["general_on_policy"]
RUNS = {"Rainbow": "general/runs/rainbow_segmented/{}/train8", "PPO": "general_on_policy/runs/ppo_segmented/{}/train8"}
SEEDS = {1: "one seed", 2: "two seeds", 3: "three seeds"}


def runs_of(agent: str, scenario: str) -> list[Path]:
    """Directories of an agent's runs, the smallest seed first."""
    return sorted((ROOT / "results" / RUNS[agent].format(scenario)).iterdir())


def gains(scenario: str) -> list[str]:
    """What PPO has less what Rainbow has, on each of `task_sets`."""
    rainbow, ppo = both(scenario)
    return [gain(ppo, rainbow, tasks) for tasks in task_sets(scenario)]


def both(scenario: str) -> tuple[Scores, Scores]:
    """Rainbow's scores and PPO's."""
    return scores_of("general", "rainbow_segmented", scenario), scores_of(FOLDER.name, "ppo_segmented", scenario)


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_the_findings_say_what_ppo_has_beside_segmented_frames(scenario):
    title = scenario_named(scenario).title
    rainbow, ppo = both(scenario)
    assert score_row(scenario, f"Rainbow, {SEEDS[len(rainbow.runs)]}", rainbow) in PAGE
    assert score_row(scenario, "PPO, one seed", ppo) in PAGE
    assert f"| {title} | PPO minus Rainbow | {' | '.join(gains(scenario))} |" in PAGE


def test_the_findings_say_what_ppo_has_in_the_mean_of_the_scenarios():
    rainbow, ppo = (means({name: both(name)[agent] for name in scenarios()}) for agent in (0, 1))
    assert f"| mean | Rainbow, three seeds | {' | '.join(rainbow)} |" in PAGE
    assert f"| mean | PPO, one seed | {' | '.join(ppo)} |" in PAGE


def test_the_summary_says_what_ppo_gives_on_the_gate_tasks():
    cells = " | ".join(gains(name)[1].split()[0] for name in SCENARIOS)
    assert f"not Rainbow, beside segmented frames | {cells} | no |" in SUMMARY


def test_the_findings_say_how_many_gradient_steps_and_decisions_ppo_had():
    last = [metrics_of(run)[-1] for name in SCENARIOS for run in runs_of("PPO", name)]
    updates, steps = ([row[key] for row in last] for key in ("num_updates", "actors/env_steps"))
    low, high = (end(steps) / 1e6 for end in (min, max))
    assert f"{min(updates):,} to {max(updates):,} gradient steps and {low:.1f} to {high:.1f} million decisions" in WORDS


def of_training(agent: str, scenario: str, low_s: float, high_s: float) -> list[tuple[float, float]]:
    """Mean score and kills of the training episodes that ended within these seconds, of each run."""
    means = []
    for run in runs_of(agent, scenario):
        found = training_episodes(run, low_s, high_s)
        assert len({row["lane"] for row in found}) == 16
        kills = [row["reward_components"].get("kill", 0.0) for row in found]
        means.append((float(np.mean([row["normalized_score"] for row in found])), float(np.mean(kills))))
    return means


def test_the_findings_say_how_ppo_learned_beside_segmented_frames():
    first = {
        agent: in_words([f"{max(of_training(agent, name, 300, 600))[0]:.1f}" for name in SCENARIOS]) for agent in RUNS
    }
    assert f"of the seconds 300 to 600 have {first['PPO']}, with Rainbow at most {first['Rainbow']}." in WORDS
    ((score, kills),) = of_training("PPO", "defend_the_center", 4_800, 5_400)
    scores, of_rainbow = map(sorted, zip(*of_training("Rainbow", "defend_the_center", 4_800, 5_400), strict=True))
    ours = f"Training episodes of the last 600 seconds have {score:.1f} with {kills:.1f} kills"
    theirs = f"those of Rainbow {scores[0]:.1f} to {scores[-1]:.1f} with {of_rainbow[0]:.1f} to {of_rainbow[-1]:.1f}."
    assert f"{ours}, {theirs}" in WORDS


@pytest.mark.parametrize(
    ("task", "said"),
    [
        ("health_gathering/short_agent+water", "`{}`, with {:.0f} instead of {:.0f}"),
        ("seek_and_kill/mixed_enemies+red", "`{}` {:.0f} instead of {:.0f}"),
        ("seek_and_kill/blue+mixed_enemies+resized_enemies", "`{}` {:.0f} instead of {:.0f}"),
        ("seek_and_kill/complete", "`{}` {:.0f} instead of {:.0f}"),
    ],
)
def test_the_findings_say_where_ppo_is_better_or_worse_than_rainbow(task, said):
    scenario, _, name = task.partition("/")
    had, has = (task_mean(scores, task) for scores in both(scenario))
    assert said.format(name, has, had) in WORDS


def test_the_findings_say_what_ppo_gains_in_health_gathering():
    assert f"**In Health Gathering it has {gains('health_gathering')[1]} points more on the gate tasks.**" in WORDS


def test_the_findings_say_what_a_longer_horizon_and_more_entropy_gave_ppo():
    name, variants = "defend_the_center", ("plain", "discount_99", "entropy_03", "both")
    trained, gate, *_ = task_sets(name)
    plain, *others = (scores_of("gates", f"ppo_segmented+{variant}", name) for variant in variants)
    (_, of_entropy, of_both), (_, costs, gains_in_training) = (
        [gain(scores, plain, tasks) for scores in others] for tasks in (gate, trained)
    )
    assert f"the training tasks gain {gains_in_training} points. On the gate tasks no gain is shown" in WORDS
    assert f"is shown with both**: {of_both} points." in WORDS
    assert costs == "-2.5 [-4.2, -0.9]"
    assert f"alone gives {of_entropy} there, and costs the training tasks 2.5 [0.9, 4.2]." in WORDS
    columns, decisions = [], []
    for variant in variants:
        (run,) = (ROOT / "results" / "gates" / "runs" / f"ppo_segmented+{variant}" / name / "train8").iterdir()
        found = training_episodes(run, 600, 900)
        decisions.append(metrics_of(run)[-1]["actors/env_steps"])
        score = np.mean([row["normalized_score"] for row in found])
        bullets = -10 * np.mean([row["reward_components"]["ammo_spent"] for row in found])
        columns.append((f"{score:.1f}", f"{100 * np.mean([row['truncated'] for row in found]):.0f}", f"{bullets:.1f}"))
    assert f"{round(min(decisions), -3):,} to {round(max(decisions), -3):,} decisions" in WORDS
    titles = (
        "training episodes, 600 to 900 s",
        "percent of these that reach the time-out",
        "bullets spent in one of them, of 26",
    )
    for title, cells in zip(titles, zip(*columns, strict=True), strict=True):
        assert f"| {title} | {' | '.join(cells)} |" in PAGE
    timed_out = [
        100 * np.mean([row["truncated"] for row in training_episodes(runs_of(agent, name)[0], 4_800, 5_400)])
        for agent in ("PPO", "Rainbow")
    ]
    assert f"core, {timed_out[0]:.0f} percent of its training episodes reached the time-out." in WORDS
    assert f"the same discount, had {timed_out[1]:.0f} percent" in WORDS
