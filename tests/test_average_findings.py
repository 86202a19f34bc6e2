"""What the findings say of averaged parameters is what one training run plays with them and without."""

from dataclasses import replace

import numpy as np
import pytest

from gvz.reports.scores import Scores, estimate
from gvz.tasks import TaskSet, scenario_named
from tests.score_tables import (
    PAGE,
    ROOT,
    SUMMARY,
    WORDS,
    in_words,
    last_updates,
    score_cells,
    scores_of,
    task_sets,
    training_episodes,
)

RUNS: dict[str, tuple[str, str, TaskSet]] = {
    "Rainbow": ("general_train4", "rainbow_segmented+train4_network", "train4"),
    "PPO": ("gates", "ppo_segmented+average", "train8"),
}
"""agent -> where its runs are under results/, their name, what they trained on"""
SCENARIOS = ("defend_the_center", "seek_and_kill")
LAST = "+last_parameters"


def pair(agent: str, scenario: str) -> tuple[Scores, Scores]:
    """Scores of the same runs with averaged parameters and with the last ones, on the same episodes."""
    folder, name, training = RUNS[agent]
    averaged, last = scores_of(folder, name, scenario), scores_of("last_parameters", name + LAST, scenario)
    check_pair(averaged, last, task_sets(scenario, training)[:2])
    return averaged, last


def long_pair(scenario: str) -> tuple[Scores, Scores]:
    """The `pair` of PPO's long run."""
    averaged, last = (
        scores_of("general_on_policy_average", f"ppo_segmented+average{what}", scenario) for what in ("", LAST)
    )
    check_pair(averaged, last, task_sets(scenario)[:2])
    return averaged, last


def check_pair(averaged: Scores, last: Scores, sets: list[list[str]]) -> None:
    assert averaged.runs.keys() == last.runs.keys()
    for tasks in sets:
        for seed in last.runs:
            assert all(len(averaged.runs[seed][task]) == len(last.runs[seed][task]) for task in tasks)


@pytest.mark.parametrize("scenario", SCENARIOS)
@pytest.mark.parametrize("agent", RUNS)
def test_the_findings_say_what_averaged_parameters_have(agent: str, scenario: str):
    both, sets = pair(agent, scenario), task_sets(scenario, RUNS[agent][2])[:2]
    title = scenario_named(scenario).title
    for scores, parameters in zip(both, ("averaged", "last"), strict=True):
        cells = " | ".join(estimate(scores, tasks).text for tasks in sets)
        assert f"| {title} | {agent} | {parameters} | {cells} |" in PAGE


def gains_of(averaged: Scores, last: Scores, tasks: list[str]) -> Scores:
    """What the average gives in each episode."""
    gained = {
        seed: {task: by_task[task] - last.runs[seed][task] for task in tasks} for seed, by_task in averaged.runs.items()
    }
    return replace(averaged, runs=gained)


def gain_of_average(agent: str, scenario: str) -> tuple[str, list[str]]:
    """What the average gives on the gate tasks: with its interval, and by run."""
    gate = task_sets(scenario)[1]
    gained = gains_of(*pair(agent, scenario), gate)
    by_run = [f"{np.mean([*gained.runs[seed].values()]):.1f}" for seed in sorted(gained.runs)]
    return estimate(gained, gate).text, by_run


def test_the_findings_say_how_many_gradient_steps_the_runs_had():
    for folder, name, training in RUNS.values():
        steps = [n for one in SCENARIOS for n in last_updates(f"{folder}/runs/{name}/{one}/{training}/*")]
        assert f": {min(steps):,} to {max(steps):,} gradient steps, " in WORDS


def test_the_findings_say_what_ppo_loses_on_the_training_tasks():
    averaged, last = pair("PPO", "seek_and_kill")
    tasks = task_sets("seek_and_kill")[0]
    lost = [last.runs[seed][task].mean() - averaged.runs[seed][task].mean() for seed in last.runs for task in tasks]
    assert f"On the training tasks of Seek and Kill it loses {np.mean(lost):.1f} points." in WORDS


@pytest.mark.parametrize("agent", RUNS)
def test_the_findings_say_what_each_run_gains(agent: str):
    said, by_run = zip(*(gain_of_average(agent, scenario) for scenario in SCENARIOS), strict=True)
    assert f"{agent} gains {in_words(list(said))} points on the gate tasks**" in WORDS
    assert f"by run {'; '.join(in_words(runs) for runs in by_run)}." in WORDS


def test_the_summary_says_what_averaged_parameters_give():
    gains = " | | | ".join(gain_of_average("Rainbow", scenario)[0] for scenario in SCENARIOS)
    assert f"in evaluation, beside segmented frames and four tasks | {gains} | yes |" in SUMMARY


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_the_findings_say_what_averaged_parameters_give_after_six_times_the_time(scenario: str):
    title = scenario_named(scenario).title
    averaged, last = long_pair(scenario)
    sets = task_sets(scenario)[:2]
    gained = " | ".join(estimate(gains_of(averaged, last, tasks), tasks).text for tasks in sets)
    lasts = " | ".join(estimate(last, tasks).text for tasks in sets)
    assert f"| {title} | averaged | {score_cells(averaged, scenario)} |" in PAGE
    assert f"| {title} | last | {lasts} | | |" in PAGE
    assert f"| {title} | averaged minus last | {gained} | | |" in PAGE


def test_the_findings_say_how_many_gradient_steps_the_long_runs_had():
    ours, earlier = (
        [last_updates(f"{folder}/runs/{name}/{scenario}/train8/*")[0] for scenario in SCENARIOS]
        for folder, name in (
            ("general_on_policy_average", "ppo_segmented+average"),
            ("general_on_policy", "ppo_segmented"),
        )
    )
    assert f"one seed (2222), {in_words([f'{n:,}' for n in ours])} gradient steps" in WORDS
    assert f"seed 1111 had {in_words([f'{n:,}' for n in earlier])} in this processor time" in WORDS


def test_the_findings_say_how_ppo_s_second_seed_learned():
    run = ROOT / "results/general_on_policy_average/runs/ppo_segmented+average/defend_the_center/train8/seed_2222"
    first, *others = (
        f"{np.mean([row['normalized_score'] for row in training_episodes(run, low_s, high_s)]):.1f} in "
        f"{what}{low_s:,} to {high_s:,}"
        for low_s, high_s, what in (
            (300, 600, "the seconds "),
            (900, 1_500, ""),
            (2_400, 3_000, ""),
            (4_800, 5_400, ""),
        )
    )
    assert f"its training episodes have {in_words([first, *others])}." in WORDS


def test_the_findings_say_what_ppo_s_first_seed_has_without_an_average():
    (defend, *_), (training, gate, test, _) = (
        [
            score.split()[0]
            for score in score_cells(scores_of("general_on_policy", "ppo_segmented", scenario), scenario).split(" | ")
        ]
        for scenario in SCENARIOS
    )
    assert f"seed 1111 have {defend} on the training tasks, so the" in WORDS
    seek = f"{training} on the training tasks and {gate} on the gate tasks, and {test} on the test tasks."
    assert f"seed 1111 have {seek}" in WORDS
    *_, test, hardest = score_cells(long_pair("seek_and_kill")[0], "seek_and_kill").split(" | ")
    said = f"has {test.split()[0]} on the test tasks and {hardest.split()[0]} on level 4."
    assert f"with averaged parameters, {said}" in WORDS
