"""What the findings say of four training tasks is what the records of these agents and their networks give."""

import gzip
import json

import pytest

from gvz.evaluation.statistics import difference, mean_over_scenarios
from gvz.reports.scores import Scores, agent_scores, estimate, estimate_groups
from gvz.tasks import named_tasks, scenario_named, scenarios
from tests.test_results import ROOT, results_of

AGENTS = {
    "4 tasks": ("general_train4", "rainbow_segmented+train4_network"),
    "8 tasks": ("general_short", "rainbow_segmented"),
}


@pytest.fixture(scope="module")
def page() -> str:
    return " ".join((ROOT / "docs" / "FINDINGS.md").read_text().split())


@pytest.fixture(scope="module")
def scores() -> dict[tuple[str, str], Scores]:
    return {
        (name, called): agent_scores(results_of(folder).episodes.filter(scenario=name), agent)
        for name in scenarios()
        for called, (folder, agent) in AGENTS.items()
    }


def task_sets(scenario: str) -> list[list[str]]:
    """Ids of the four training tasks, of the gate tasks, of the test tasks, and of level 4."""
    splits = (named_tasks(scenario, split="train4"), *(named_tasks(scenario, split=one) for one in ("gate", "test")))
    return [[task.id for task in tasks] for tasks in (*splits, named_tasks(scenario, level=4))]


def test_the_findings_say_what_agents_of_four_training_tasks_have(page: str, scores: dict[tuple[str, str], Scores]):
    for (name, called), of_agent in scores.items():
        cells = " | ".join(estimate(of_agent, tasks).text for tasks in task_sets(name))
        assert f"| {scenario_named(name).title} | {called} | {cells} |" in page
    for called in AGENTS:
        groups = [[(scores[name, called], task_sets(name)[column]) for name in scenarios()] for column in range(4)]
        means = [estimate_groups(group, mean_over_scenarios).text for group in groups]
        assert f"| mean | {called} | {' | '.join(means)} |" in page
    gains = [
        estimate_groups([(scores[name, called], task_sets(name)[1]) for called in reversed(AGENTS)], difference).text
        for name in scenarios()
    ]
    assert f"not four, beside segmented frames | {' | '.join(gains)} | yes |" in page


def test_the_findings_say_what_networks_of_four_training_tasks_find(page: str):
    for name in scenarios():
        four, eight = (
            json.loads((ROOT / "gvz" / "segmenters" / folder / f"{name}.json").read_text())["average_precision"]
            for folder in ("train4", "")
        )
        assert list(four) == list(eight)
        for task, found in four.items():
            for kind, value in found.items():
                assert f"| `{task}` | {kind} | {value:.2f} | {eight[task][kind]:.2f} |" in page


def test_the_findings_say_how_long_agents_of_four_training_tasks_learned(page: str):
    files = (ROOT / "results" / "general_train4").glob("runs/**/metrics.jsonl.gz")
    steps = sorted(json.loads(gzip.decompress(file.read_bytes()).splitlines()[-1])["num_updates"] for file in files)
    assert f"{steps[0]:,} to {steps[-1]:,} gradient steps on four tasks" in page
