"""What the findings say of agents that trained on varied maps beside segmented frames is what the records give."""

import json

import numpy as np
import pytest

from gvz.evaluation.statistics import bootstrap
from gvz.reports.scores import estimate
from gvz.tasks import named_tasks, scenario_named, scenarios
from tests.score_tables import (
    PAGE,
    ROOT,
    WORDS,
    gain,
    in_words,
    last_updates,
    learned,
    means,
    rows_of,
    score_cells,
    score_row,
    scores_of,
    segmenter,
    task_mean,
    task_sets,
)

AGENTS = {"varied maps": "general_varied", "8 tasks": "general_short"}
SCENARIOS = ("defend_the_center", "seek_and_kill")


def test_the_findings_say_what_agents_of_varied_maps_have():
    scores = {
        (name, called): scores_of(folder, "rainbow_segmented", name)
        for name in SCENARIOS
        for called, folder in AGENTS.items()
    }

    def lower(name: str, column: int) -> str:
        """By how much varied maps are below eight tasks, on a column of the table."""
        return gain(scores[name, "8 tasks"], scores[name, "varied maps"], task_sets(name)[column]).split()[0]

    def on(task: str) -> tuple[float, float]:
        """Scores of varied maps and of eight tasks."""
        varied, eight = (task_mean(scores[task.partition("/")[0], called], task) for called in AGENTS)
        return varied, eight

    steps = []
    for name in SCENARIOS:
        steps += last_updates(f"general_varied/runs/rainbow_segmented/{name}/**")
        for called in AGENTS:
            assert score_row(name, called, scores[name, called]) in WORDS
    assert "{:,} gradient steps in Defend the Center and {:,} in Seek and Kill".format(*steps) in WORDS
    center, seek = SCENARIOS
    assert f"not eight tasks, beside segmented frames | -{lower(center, 1)} | | | -{lower(seek, 1)} | no |" in WORDS
    said = "the test tasks are only {} points lower, but the gate tasks {} and level 4 {}."
    assert said.format(lower(center, 2), lower(center, 1), lower(center, 3)) in WORDS
    assert f"The test tasks are {lower(seek, 2)} points lower." in WORDS
    bricks, wall = on(f"{center}/mossy_bricks"), on(f"{center}/fuzzy_enemies+gore+stone_wall")
    assert f"`mossy_bricks` has {bricks[0]:.0f} and `fuzzy_enemies+gore+stone_wall` {wall[0]:.0f}, with eight" in WORDS
    assert f"with eight tasks {bricks[1]:.0f} and {wall[1]:.0f}." in WORDS
    of_looks = {"gore", "mossy_bricks", "stone_wall", "fuzzy_enemies"}
    tasks = [task for task in named_tasks(center) if set(task.attributes) <= of_looks]
    assert len(tasks) > 5
    for task in tasks:
        varied, eight = on(task.id)
        assert varied >= eight, task.id
    assert "no varied map has, have {:.0f}, not {:.0f}.".format(*on(f"{center}/flying_enemies")) in WORDS
    assert "`default` has {:.0f}, not {:.0f}.".format(*on(f"{seek}/default")) in WORDS


def test_the_findings_say_what_six_times_the_time_on_varied_maps_gave():
    readme = (ROOT / "results" / "general_varied_long" / "README.md").read_text()
    runs = {"8 tasks": "general/runs/rainbow_segmented/{}/train8"}
    runs["varied maps"] = "general_varied_long/runs/rainbow_segmented/{}/varied"
    steps, trained, waits, minutes = [], {}, [], []
    for name in scenarios():
        title = scenario_named(name).title
        for called, run in runs.items():
            of_first, *_ = sorted((ROOT / "results" / run.format(name)).glob("seed_*"))
            episodes = rows_of(of_first / "episodes.jsonl.gz")
            for first in (10_000, 40_000, 80_000):
                trained[name, called, first] = learned(episodes, first, first + 10_000)
            cells = " | ".join(f"{trained[name, called, first]:.1f}" for first in (10_000, 40_000, 80_000))
            assert f"| {title} | {called} | {cells} |" in WORDS
        run = ROOT / "results" / runs["varied maps"].format(name) / "seed_1111"
        first, *_, last = rows = rows_of(run / "metrics.jsonl.gz")
        waits.append(np.median([row["learner/wait_share"] for row in rows]))
        minutes.append((last["time_s"] - json.loads((run / "starts.jsonl").read_text())["time_s"]) / 60)
        assert len({row["lane"] for row in rows_of(run / "episodes.jsonl.gz")}) == 16
        steps.append(last["num_updates"])
        rate = (steps[-1] - first["num_updates"]) / (last["time_s"] - first["time_s"])
        counts = f"{steps[-1]:,} | {last['actors/env_steps']:,} | {last['run/processor_s']:,.0f} s | {rate:.1f}"
        assert f"| {title} | {counts} |" in readme
    assert f"({min(steps):,} to {max(steps):,} gradient steps)" in WORDS
    assert "four cores and 16 games each" in " ".join(readme.split())
    assert f"Ctrl-C ended these {np.mean(minutes):.0f} minutes after they had" in readme
    assert f"ended {np.mean(minutes):.0f} minutes after it had begun" in WORDS
    assert f"waited for decisions for {100 * np.mean(waits):.0f} percent" in readme

    def lower(name: str) -> float:
        return trained[name, "8 tasks", 80_000] - trained[name, "varied maps", 80_000]

    center, seek = SCENARIOS
    assert all(lower(name) <= 0 for name in ("dodge_projectiles", "health_gathering"))
    gained = trained[seek, "varied maps", 80_000] - trained[seek, "varied maps", 40_000]
    said = f"stand {lower(center):.0f} and {lower(seek):.0f} points lower, and Seek and Kill gains only {gained:.0f}"
    assert f"{said} points" in WORDS


def test_the_findings_say_what_networks_of_eight_tasks_find_on_varied_maps():
    file = ROOT / "results" / "gates" / "segmenters" / "varied_maps.json"
    found = json.loads(file.read_text())["average_precision"]
    for task in ("default", "varied"):
        cells = (", ".join(f"{value:.2f}" for value in found[f"{name}/{task}"].values()) for name in scenarios())
        assert f"| `{task}` | {' | '.join(cells)} |" in PAGE


def test_the_findings_say_what_a_network_gave_that_has_seen_varied_maps():
    folder, name = ROOT / "results" / "gates" / "segmenters" / "seek_and_kill_varied", "seek_and_kill"
    scores: dict[str, list[float]] = {}
    for row in rows_of(folder / "evaluation.jsonl.gz"):
        scores.setdefault(row["task"], []).append(row["normalized_score"])
    assert {len(of_task) for of_task in scores.values()} == {20}
    sets = task_sets(name)[:2]
    trained, gate = (bootstrap([np.array(scores[task]) for task in tasks]) for tasks in sets)
    others = (estimate(scores_of("general_varied", "rainbow_segmented", name), tasks).estimate for tasks in sets)
    found = " and ".join(f"{one.value:.1f}" for one in others if one)
    said = f"has {trained} on the training tasks and {gate} on the gate tasks, where the agent on the network of eight"
    assert f"{said} tasks has {found}." in WORDS


def test_the_findings_say_what_the_networks_of_varied_maps_find():
    unseen = json.loads((ROOT / "results" / "gates" / "segmenters" / "varied_networks.json").read_text())
    steps, of_eight = [], []
    for name in scenarios():
        found = unseen["average_precision"][f"{name}/varied"]
        for thing in found["varied"]:
            for called, key, directory in (("eight tasks", "eight_tasks", "."), ("varied maps", "varied", "varied")):
                network = segmenter(f"{directory}/{name}")
                of_gate = network["average_precision"].values()
                gate = ", ".join(f"{of_task[thing]:.2f}" for of_task in of_gate if thing in of_task)
                title = scenario_named(name).title
                assert f"| {title} | {thing} | {called} | {found[key][thing]:.2f} | {gate} |" in PAGE
                seconds = 700 if (name, called) == ("dodge_projectiles", "eight tasks") else 1500
                assert network["processor_s"] // 10 == seconds // 10
            assert network["tints_and_patches"] == (name == "health_gathering")
        steps.append(f"{network['gradient_steps']:,}")
        of_eight.append(f"{segmenter(name)['gradient_steps']:,}")
    assert f"made {in_words(steps)} gradient steps in the 1,500 seconds" in WORDS
    assert f"and fewer gradient steps: {in_words(of_eight)}." in WORDS


def test_the_findings_say_what_90_minutes_on_varied_maps_gave_with_a_network_of_them():
    network, plain = "rainbow_segmented+varied_network", "rainbow_segmented"
    runs = {"varied maps": f"general_varied_network/runs/{network}", "eight tasks": f"general_varied_long/runs/{plain}"}
    folders = {"varied maps": ("general_varied_network", network), "8 tasks": ("general", plain)}
    steps, of_eight = [], []
    for name in scenarios():
        title = scenario_named(name).title
        for called, run in runs.items():
            episodes = rows_of(ROOT / f"results/{run}/{name}/varied/seed_1111/episodes.jsonl.gz")
            cells = (f"{learned(episodes, first, first + 10_000):.1f}" for first in (10_000, 40_000, 80_000))
            assert f"| {title} | {called} | {' | '.join(cells)} |" in PAGE
            assert len({row["lane"] for row in episodes}) == {"varied maps": 8, "eight tasks": 16}[called]
        steps += last_updates(f"general_varied_network/runs/{network}/{name}/varied/*")
        of_eight += last_updates(f"general/runs/{plain}/{name}/train8/*")
        for row, folder, agent in (
            ("varied maps | varied maps | 5,400 s", "general_varied_network", network),
            ("varied maps | eight tasks | 900 s", "general_varied", plain),
            ("8 tasks | eight tasks | 5,400 s", "general", plain),
        ):
            if folder == "general_varied" and name not in SCENARIOS:
                continue
            assert f"| {title} | {row} | {score_cells(scores_of(folder, agent, name), name)} |" in PAGE
    varied, eight = ({name: scores_of(*of, name) for name in scenarios()} for of in folders.values())
    of_varied, of_eight_tasks = means(varied), means(eight)
    assert f"| mean | varied maps | varied maps | 5,400 s | {' | '.join(of_varied)} |" in PAGE
    assert f"| mean | 8 tasks | eight tasks | 5,400 s | {' | '.join(of_eight_tasks)} |" in PAGE
    assert f"agents have {of_varied[2]} on the test tasks; those of eight tasks have {of_eight_tasks[2]}." in WORDS
    compositions = {name: scores_of("general_compositions_long", plain, name) for name in scenarios()}
    assert f"have {means(compositions)[2]} in the mean on the test tasks, after 2,700 seconds." in WORDS
    gains = [[gain(varied[name], eight[name], task_sets(name)[column]) for name in scenarios()] for column in (2, 1)]
    for said, of_column in zip(("differences are {} points, in", "On the gate tasks they are {}."), gains, strict=True):
        assert said.format(in_words(of_column)) in WORDS
    lower = (of_gate.split()[0] for of_gate in gains[1])
    assert "not eight tasks and their networks | {} | {} | {} | {} | no |".format(*lower) in WORDS
    kits = varied["health_gathering"]
    changes_rules = {"poison", "supreme", "short_agent"}
    tasks = [task for task in named_tasks("health_gathering") if not changes_rules & set(task.attributes)]
    assert len(tasks) > 10
    assert {f"{task_mean(kits, task.id):.0f}" for task in tasks} == {"100"}
    for task in ("city", "flames", "flaming_skulls", "barons", "cacodemons"):
        assert f"{task_mean(varied['dodge_projectiles'], f'dodge_projectiles/{task}'):.0f}" == "100"
    short = scores_of("general_varied", plain, SCENARIOS[0])
    of_gate_and_test = [
        score_cells(scores, SCENARIOS[0]).split(" | ")[column].split()[0]
        for scores in (varied[SCENARIOS[0]], short)
        for column in (1, 2)
    ]
    assert "have {} and {}, not {} and {} as after 900 seconds".format(*of_gate_and_test) in WORDS
    wall = task_mean(short, "defend_the_center/fuzzy_enemies+gore+stone_wall")
    assert f"on the network of eight tasks, the latter had {wall:.0f}." in WORDS
    assert f"{min(steps):,} to {max(steps):,} gradient steps, 8 games at once" in WORDS
    assert f"16 games at once and {min(of_eight):,} to {max(of_eight):,} gradient steps." in WORDS


def test_the_findings_say_what_varied_maps_gave_beside_the_eight_tasks():
    trainings = ("8 tasks", "8 tasks, also on varied maps")
    agent, gains, on_eight = "rainbow_segmented+varied_network", [], []
    for name in ("defend_the_center", "health_gathering"):
        eight, varied = (scores_of("gates", f"{agent} ({called})", name) for called in trainings)
        on_eight.append(gain(varied, eight, task_sets(name)[0]))
        gains.append(gain(varied, eight, task_sets(name)[1]))
    assert "have {} points more in Defend the Center and {} in Health Gathering.**".format(*gains) in WORDS
    assert "no difference is shown, either**: {} and {} points.".format(*on_eight) in WORDS
    lower = [of_scenario.split()[0] for of_scenario in gains]
    assert "both on networks of varied maps | {} | | {} | | no: `--training-set train8_varied` |".format(*lower) in PAGE
    means_of = [
        f"{task_mean(scores, f'health_gathering/{task}'):.0f}"
        for task in ("short_agent+water", "poison")
        for scores in (varied, eight)
    ]
    said = "`short_agent+water` has {}, not {}, and `poison`, a training task, {}, not {}."
    assert said.format(*means_of) in WORDS
    steps = last_updates(f"gates/runs/{agent}/*/*/*")
    assert f"{steps[0]:,} to {steps[-1]:,} gradient steps; 16 games" in WORDS
    for training, games in (("train8", 16), ("train8_varied", 28)):
        for run in (ROOT / "results/gates/runs" / agent).glob(f"*/{training}/*"):
            assert len({row["lane"] for row in rows_of(run / "episodes.jsonl.gz")}) == games


@pytest.mark.parametrize(
    ("name", "tasks", "said"),
    [
        ("defend_the_center", "default mossy_bricks stone_wall", "have {0}, with eight tasks {1}."),
        ("defend_the_center", "flying_enemies", "`flying_enemies` has {0}, not {1},"),
        ("defend_the_center", "fast_enemies+flying_enemies", "`fast_enemies+flying_enemies` {0}, not {1}, and"),
        (
            "defend_the_center",
            "fast_enemies+gore+resized_enemies",
            "the test task `fast_enemies+gore+resized_enemies` {0}, not {1}.",
        ),
        ("defend_the_center", "gore+resized_enemies", "`gore+resized_enemies` has {0}, not {1}, and"),
        ("defend_the_center", "fuzzy_enemies+gore+stone_wall", "where looks alone change, {0}, not {1}."),
        ("defend_the_center", "gore+mossy_bricks", "`gore+mossy_bricks` has {0}, with eight tasks {1}."),
        ("dodge_projectiles", "mancubus", "training, has {0}, not {1}, and"),
        ("dodge_projectiles", "arachnotron+city", "`arachnotron+city` {0}, not {1}."),
        ("dodge_projectiles", "arachnotron", "`arachnotron` has {0}, not {1}."),
        ("health_gathering", "short_agent", "whose eyes are lower, has {0}, not {1}, and"),
        ("health_gathering", "short_agent+water", "`short_agent+water` {0}, not {1}."),
        ("health_gathering", "water", "`water` has {0}, not {1}."),
        ("health_gathering", "poison", "`poison` has {0}, not {1},"),
        ("health_gathering", "poison+stimpacks", "`poison+stimpacks` {0}, not {1},"),
        ("health_gathering", "poison+resized_kits+shaded_kits", "`poison+resized_kits+shaded_kits` {0}, not {1}, and"),
        ("health_gathering", "supreme", "`supreme` {0}, not {1}."),
        ("seek_and_kill", "obstacles invulnerable mixed_enemies", "have {0}, with eight tasks {1}."),
        ("seek_and_kill", "red", "and the agent has not, has {0}, not {1}, and"),
        ("seek_and_kill", "red+resized_enemies", "`red+resized_enemies` has {0}, not {1}, and"),
        ("seek_and_kill", "mixed_enemies+red", "`mixed_enemies+red` {0}, not {1}."),
        ("seek_and_kill", "default blue", "`default` and `blue` have {0}, with eight tasks {1}."),
        ("seek_and_kill", "blue+shadows", "`blue+shadows` has {0}, not {1}, although"),
        ("seek_and_kill", "blue shadows", "although each alone has {0}, with eight tasks {1}."),
    ],
)
def test_the_findings_say_how_an_agent_of_varied_maps_plays_single_tasks(name: str, tasks: str, said: str):
    both = (("general_varied_network", "rainbow_segmented+varied_network"), ("general", "rainbow_segmented"))
    found = []
    for folder, agent in both:
        scores = scores_of(folder, agent, name)
        found.append(in_words([f"{task_mean(scores, f'{name}/{task}'):.0f}" for task in tasks.split()]))
    assert said.format(*found) in WORDS
