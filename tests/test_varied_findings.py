"""What the findings say of agents that trained on varied maps beside segmented frames is what the records give."""

import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np

from gvz.evaluation.statistics import difference
from gvz.reports.scores import agent_scores, estimate, estimate_groups
from gvz.tasks import named_tasks, scenario_named, scenarios
from tests.score_tables import score_cells, task_sets
from tests.test_results import ROOT, results_of

AGENTS = {"varied maps": "general_varied", "8 tasks": "general_short"}
SCENARIOS = ("defend_the_center", "seek_and_kill")


def rows_of(file: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in gzip.decompress(file.read_bytes()).splitlines()]


def test_the_findings_say_what_agents_of_varied_maps_have():
    page = " ".join((ROOT / "docs" / "FINDINGS.md").read_text().split())
    scores = {
        (name, called): agent_scores(results_of(folder).episodes.filter(scenario=name), "rainbow_segmented")
        for name in SCENARIOS
        for called, folder in AGENTS.items()
    }

    def lower(name: str, column: int) -> str:
        """By how much varied maps are below eight tasks, on a column of the table."""
        tasks = task_sets(name)[column]
        found = estimate_groups([(scores[name, called], tasks) for called in AGENTS], difference).estimate
        assert found
        return f"{-found.value:.1f}"

    def on(task: str) -> tuple[float, float]:
        """Scores of varied maps and of eight tasks."""
        name = task.partition("/")[0]
        found = [estimate(scores[name, called], [task]).estimate for called in AGENTS]
        varied, eight = (one.value for one in found if one)
        return varied, eight

    steps = []
    for name in SCENARIOS:
        (file,) = (ROOT / "results" / "general_varied" / "runs" / "rainbow_segmented" / name).glob(
            "**/metrics.jsonl.gz"
        )
        steps.append(rows_of(file)[-1]["num_updates"])
        for called in AGENTS:
            cells = score_cells(scores[name, called], name)
            assert f"| {scenario_named(name).title} | {called} | {cells} |" in page
    assert "{:,} gradient steps in Defend the Center and {:,} in Seek and Kill".format(*steps) in page
    center, seek = SCENARIOS
    assert f"not eight tasks, beside segmented frames | -{lower(center, 1)} | | | -{lower(seek, 1)} | no |" in page
    said = "the test tasks are only {} points lower, but the gate tasks {} and level 4 {}."
    assert said.format(lower(center, 2), lower(center, 1), lower(center, 3)) in page
    assert f"The test tasks are {lower(seek, 2)} points lower." in page
    bricks, wall = on(f"{center}/mossy_bricks"), on(f"{center}/fuzzy_enemies+gore+stone_wall")
    assert f"`mossy_bricks` has {bricks[0]:.0f} and `fuzzy_enemies+gore+stone_wall` {wall[0]:.0f}, with eight" in page
    assert f"with eight tasks {bricks[1]:.0f} and {wall[1]:.0f}." in page
    of_looks = {"gore", "mossy_bricks", "stone_wall", "fuzzy_enemies"}
    tasks = [task for task in named_tasks(center) if set(task.attributes) <= of_looks]
    assert len(tasks) > 5
    for task in tasks:
        varied, eight = on(task.id)
        assert varied >= eight, task.id
    assert "no varied map has, have {:.0f}, not {:.0f}.".format(*on(f"{center}/flying_enemies")) in page
    assert "`default` has {:.0f}, not {:.0f}.".format(*on(f"{seek}/default")) in page


def test_the_findings_say_what_six_times_the_time_on_varied_maps_gave():
    page = " ".join((ROOT / "docs" / "FINDINGS.md").read_text().split())
    readme = (ROOT / "results" / "general_varied_long" / "README.md").read_text()
    runs = {"8 tasks": "general/runs/rainbow_segmented/{}/train8/seed_1111"}
    runs["varied maps"] = "general_varied_long/runs/rainbow_segmented/{}/varied/seed_1111"
    steps, means = [], {}
    for name in scenarios():
        title = scenario_named(name).title
        for called, run in runs.items():
            episodes = rows_of(ROOT / "results" / run.format(name) / "episodes.jsonl.gz")
            for first in (10_000, 40_000, 80_000):
                found = [row["normalized_score"] for row in episodes if first <= row["num_updates"] < first + 10_000]
                means[name, called, first] = float(np.mean(found))
            cells = " | ".join(f"{means[name, called, first]:.1f}" for first in (10_000, 40_000, 80_000))
            assert f"| {title} | {called} | {cells} |" in page
        first, *_, last = rows_of(ROOT / "results" / runs["varied maps"].format(name) / "metrics.jsonl.gz")
        steps.append(last["num_updates"])
        rate = (steps[-1] - first["num_updates"]) / (last["time_s"] - first["time_s"])
        counts = f"{steps[-1]:,} | {last['actors/env_steps']:,} | {last['run/processor_s']:,.0f} s | {rate:.1f}"
        assert f"| {title} | {counts} |" in readme
    assert f"({min(steps):,} to {max(steps):,} gradient steps)" in page

    def lower(name: str) -> float:
        return means[name, "8 tasks", 80_000] - means[name, "varied maps", 80_000]

    learned, (center, seek) = ("dodge_projectiles", "health_gathering"), SCENARIOS
    assert all(lower(name) <= 0 for name in learned)
    gain = means[seek, "varied maps", 80_000] - means[seek, "varied maps", 40_000]
    said = (
        f"stand {lower(center):.0f} and {lower(seek):.0f} points lower, and Seek and Kill gains only {gain:.0f} points"
    )
    assert said in page


def test_the_findings_say_what_networks_of_eight_tasks_find_on_varied_maps():
    page = (ROOT / "docs" / "FINDINGS.md").read_text()
    file = ROOT / "results" / "gates" / "segmenters" / "varied_maps.json"
    found = json.loads(file.read_text())["average_precision"]
    for task in ("default", "varied"):
        cells = (", ".join(f"{value:.2f}" for value in found[f"{name}/{task}"].values()) for name in scenarios())
        assert f"| `{task}` | {' | '.join(cells)} |" in page
