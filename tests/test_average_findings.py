"""What the findings say of averaged parameters is what one training run plays with them and without."""

from dataclasses import replace

import numpy as np
import pytest

from gvz.reports.scores import Scores, estimate
from gvz.tasks import TaskSet, scenario_named
from tests.score_tables import PAGE, SUMMARY, WORDS, in_words, last_updates, scores_of, task_sets

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
    assert averaged.runs.keys() == last.runs.keys()
    for tasks in task_sets(scenario, training)[:2]:
        for seed in last.runs:
            assert all(len(averaged.runs[seed][task]) == len(last.runs[seed][task]) for task in tasks)
    return averaged, last


@pytest.mark.parametrize("scenario", SCENARIOS)
@pytest.mark.parametrize("agent", RUNS)
def test_the_findings_say_what_averaged_parameters_have(agent: str, scenario: str):
    both, sets = pair(agent, scenario), task_sets(scenario, RUNS[agent][2])[:2]
    title = scenario_named(scenario).title
    for scores, parameters in zip(both, ("averaged", "last"), strict=True):
        cells = " | ".join(estimate(scores, tasks).text for tasks in sets)
        assert f"| {title} | {agent} | {parameters} | {cells} |" in PAGE


def gain_of_average(agent: str, scenario: str) -> tuple[str, list[str]]:
    """What the average gives on the gate tasks: with its interval, and by run."""
    averaged, last = pair(agent, scenario)
    gate = task_sets(scenario)[1]
    gained = {
        seed: {task: by_task[task] - last.runs[seed][task] for task in gate} for seed, by_task in averaged.runs.items()
    }
    by_run = [f"{np.mean([*gained[seed].values()]):.1f}" for seed in sorted(gained)]
    return estimate(replace(averaged, runs=gained), gate).text, by_run


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
    assert f"{agent} gains {in_words(list(said))} points on the gate tasks" in WORDS
    assert f"by run {'; '.join(in_words(runs) for runs in by_run)}." in WORDS


def test_the_summary_says_what_averaged_parameters_give():
    gains = " | | | ".join(gain_of_average("Rainbow", scenario)[0] for scenario in SCENARIOS)
    assert f"in evaluation, beside segmented frames and four tasks | {gains} | yes |" in SUMMARY
