"""What the README says of committed results is what their records give."""

import json
import re
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import polars
import pytest

from gvz.evaluation.statistics import bootstrap, bootstrap_runs
from gvz.experiments.base import experiments
from gvz.reports.experiment_section import result_table
from gvz.reports.joint_section import joint_sections
from gvz.reports.scores import estimate
from gvz.tasks import LEVELS, Task, TaskSet, named_tasks, scenarios
from tests.score_tables import PAGE, ROOT, WORDS, learned, metrics_of, results_of, rows_of, scores_of, words_of


def test_the_quick_runs_are_better_than_chance_on_the_same_episodes():
    folder = ROOT / "results" / "rainbow_quick"

    def episodes(file: Path) -> tuple[np.ndarray, list[int]]:
        rows = rows_of(file)
        return np.array([row["score"] for row in rows]), sorted(row["seed"] for row in rows)

    chance, seeds = episodes(folder / "evaluation_random.jsonl.gz")
    runs = [episodes(folder / f"seed_{seed}" / "evaluation.jsonl.gz") for seed in (1111, 2222, 3333)]
    assert len(seeds) == 100
    assert all(of_run == seeds for _, of_run in runs)
    trained = bootstrap_runs([[[scores] for scores, _ in runs]], redraw=["runs"])
    assert bootstrap([chance]).high < trained.low
    readme, page = (ROOT / "README.md").read_text(), (folder / "README.md").read_text()
    by_episode = sorted(rows_of(folder / "evaluation_random.jsonl.gz"), key=lambda row: row["episode"])
    random = bootstrap([np.array([row["score"] for row in by_episode])], num_resamples=1000)  # as benchmarks.reference
    assert f"| random | {random} |" in readme
    assert f"| default | 0 | {random} |" in (ROOT / "docs" / "benchmark" / "reference-scores.md").read_text()
    assert f"| rainbow_quick, 15,000 updates | {trained} |" in readme
    for seed, (scores, _) in zip((1111, 2222, 3333), runs, strict=True):
        assert f"| {seed} | {bootstrap([scores])} | {bootstrap([100 * scores / 1100])} |" in page


def test_the_quick_comparison_says_what_its_records_give():
    """Means alone; gvz/reports has its own tests of intervals."""
    folder = ROOT / "results" / "quick_comparison"
    test_tasks = {task.id for task in named_tasks("defend_the_center", split="test")}
    readme = (folder / "README.md").read_text()
    for config in ("rainbow_quick", "dqn_quick"):
        files = sorted(folder.glob(f"runs/{config}/*/*/*/evaluation.jsonl.gz"))
        assert len(files) == 3
        rows = [row for file in files for row in rows_of(file)]
        assert len(rows) == 3 * 2 * 18 * 25
        final = [row for row in rows if row["num_updates"] == 20_000]
        (line,) = (line for line in readme.splitlines() if line.startswith(f"| {config} |"))
        said = [float(cell.split()[0]) for cell in line.split("|")[2:-1]]
        for level, value in enumerate(said[:-1]):
            tasks = {task.id for task in named_tasks("defend_the_center", level=level)}
            assert value == round(np.mean([row["normalized_score"] for row in final if row["task"] in tasks]), 1)
        assert said[-1] == round(np.mean([row["normalized_score"] for row in final if row["task"] in test_tasks]), 1)


def test_the_quick_comparison_says_what_players_that_do_not_learn_have_on_the_same_episodes():
    folder, scenario = ROOT / "results" / "quick_comparison", "defend_the_center"

    def first_episodes(player: str) -> list[dict[str, Any]]:
        played = results_of(f"reference/{player}.jsonl.gz").episodes
        return played.filter(polars.col("episode") < 25, scenario=scenario).to_dicts()

    def mean(rows: list[dict[str, Any]], tasks: list[Task]) -> float:
        ids = {task.id for task in tasks}
        return np.mean([row["normalized_score"] for row in rows if row["task"] in ids])

    levels = [named_tasks(scenario, level=level) for level in LEVELS]
    train, test = (named_tasks(scenario, split=split) for split in ("train4", "test"))
    readme, words = (folder / "README.md").read_text(), words_of("results/quick_comparison/README.md")
    for player in ("random", "sweep", "scripted"):
        rows = first_episodes(player)
        assert f"| {player} | {' | '.join(f'{mean(rows, tasks):.1f}' for tasks in (*levels, test))} |" in readme
    sweep = first_episodes("sweep")
    assert f"On the four training tasks the sweep has {mean(sweep, train):.1f}." in words
    better = {}
    for config, said in (
        ("rainbow_quick", "Rainbow has {}, {} and {} there with"),
        ("dqn_quick", "DQN {}, {} and {}."),
    ):
        runs = [rows_of(file) for file in sorted(folder.glob(f"runs/{config}/*/*/*/evaluation.jsonl.gz"))]
        final = [[row for row in rows if row["num_updates"] == 20_000] for rows in runs]
        assert said.format(*(f"{mean(rows, train):.1f}" for rows in final)) in words
        better[config] = [sum(mean(rows, tasks) > mean(sweep, tasks) for rows in final) for tasks in (train, test)]
    assert better == {"rainbow_quick": [3, 0], "dqn_quick": [1, 0]}


def test_the_gap_of_procedural_maps_is_what_its_records_give():
    folder, kept = ROOT / "results" / "procedural_gap", ([], [])
    readme, page = (file.read_text() for file in (folder / "README.md", ROOT / "docs" / "benchmark" / "drawn-maps.md"))
    for title, maps in (("10 maps", "-10"), ("100 maps", "-100"), ("1,000 maps", "-1000"), ("unlimited", "")):
        training = f"procedural-train{maps}"
        file = folder / "runs" / "rainbow_quick" / "health_gathering" / training / "seed_1111" / "evaluation.jsonl.gz"
        rows = rows_of(file)
        scores = [
            np.array([row["normalized_score"] for row in rows if row["task"] == f"health_gathering/{task}"])
            for task in (training, "procedural-test")
        ]
        assert [len(found) for found in scores] == [100, 100]
        on_them, on_test = (bootstrap([found]) for found in scores)
        gap = on_them.value - on_test.value
        assert f"| {title} | {on_them} | {on_test} | {gap:.1f} |" in readme
        for values, found in zip(kept, (on_them, on_test), strict=True):
            values.append(f"{found.value:.1f}")
    for title, values in zip(("score on them", "score on test maps"), kept, strict=True):
        assert f"| {title} | {' | '.join(values)} |" in page


def test_the_joint_run_says_what_its_records_give():
    folder = ROOT / "results" / "rainbow_all"
    rows, readme = rows_of(folder / "evaluation.jsonl.gz"), (folder / "README.md").read_text()
    last = metrics_of(folder)[-1]
    updates, decisions = f"{last['num_updates']:,} gradient steps", f"{round(last['actors/env_steps'], -3):,} decisions"
    assert f"{updates}, {decisions}, 48 minutes" in readme
    assert f"{last['run/processor_s']:,.0f} seconds of processor time" in readme
    for split, episodes, title in (("train4", 20, "4 training tasks"), ("test", 50, "7 test tasks")):
        means = []
        for scenario in scenarios():
            tasks = [task.id for task in named_tasks(scenario, split=split)]
            scores = [[row["normalized_score"] for row in rows if row["task"] == task] for task in tasks]
            assert [len(found) for found in scores] == [episodes] * len(tasks)
            means.append(np.mean(scores))
        cells = " | ".join(f"{value:.1f}" for value in (*means, np.mean(means)))
        assert f"| {title} each, {episodes} episodes a task | {cells} |" in readme
        if split == "train4":
            assert "are learned to {:.1f} and {:.1f} percent.".format(*means[1:3]) in WORDS
    report = (folder / "report" / "report.md").read_text()
    assert "P_norm, 43.6 [42.8, 44.4]" in readme
    alone = {}
    for name in ("defend_the_center", "seek_and_kill"):
        four = {task.id for task in named_tasks(name, split="train4")}
        files = (ROOT / "results/general_short/runs/rainbow_general" / name).glob("train8/*/evaluation.jsonl.gz")
        scores = [row["normalized_score"] for file in files for row in rows_of(file) if row["task"] in four]
        assert len(scores) == 3 * 4 * 50
        alone[name] = f"{np.mean(scores):.1f}"
    said = "(`rainbow_general`, eight training tasks) have {defend_the_center} and {seek_and_kill} on the same tasks"
    assert said.format(**alone) in WORDS
    sweep = results_of("reference/sweep.jsonl.gz").episodes
    of_scenarios = sweep.filter(polars.col("task").is_in([task.id for task in named_tasks(split="test")]))
    nothing = of_scenarios.group_by("scenario").agg(polars.col("normalized_score").mean())["normalized_score"].mean()
    assert f"the sweep has {nothing:.1f}." in WORDS
    assert f"The sweep, which looks at nothing, has {nothing:.1f}." in " ".join(readme.split())
    assert "| rainbow_all | 47.7 [46.8, 48.8] | 41.4 [40.2, 42.7] |" in report


def test_the_hour_of_the_main_job_says_what_its_records_give():
    folder = ROOT / "results" / "rainbow_4task"
    page, guide = words_of("results/rainbow_4task/README.md"), words_of("docs/how-to/train.md")
    last = metrics_of(folder / "seed_1111")[-1]
    updates, decisions = f"{last['num_updates']:,} gradient steps", f"{round(last['actors/env_steps'], -3):,} decisions"
    assert f"{updates}, {decisions} and {last['run/processor_s']:,.0f} seconds of processor time" in page
    said = []
    for split, title in (("train4", "4 training tasks"), ("test", "7 test tasks")):
        tasks = [task.id for task in named_tasks("defend_the_center", split=split)]
        found = [("rainbow_4task", "rainbow_4task"), ("reference/random.jsonl.gz", "random")]
        said.append([estimate(scores_of(*one, "defend_the_center"), tasks).text for one in found])
        assert f"| {title} | {' | '.join(said[-1])} |" in page
    (trained, _), (unseen, chance) = said
    assert f"after {updates}, it has {trained} on its four training tasks and {unseen} on the" in guide
    assert f"(random: {chance.split()[0]};" in guide
    rows, learning = rows_of(folder / "seed_1111" / "episodes.jsonl.gz"), []
    for low, high in ((0, 5_000), (15_000, 20_000), (40_000, 44_091)):
        learning.append(f"{learned(rows, low, high):.0f}")
    assert (
        "{} percent of the bound in the first 5,000 gradient steps, {} at 15,000 to 20,000, and {} in the last 4,090."
    ).format(*learning) in page
    assert round(2 * 200_000 / last["num_updates"]) == 2 * 4.5
    (readme,) = re.findall("200,000 gradient steps, about (.*?) hours", (ROOT / "README.md").read_text())
    assert f"whole job take {readme} hours" in page
    assert f"`rainbow_4task` needs some {readme} hours" in guide


def test_the_guide_says_how_long_experiments_train_at_the_measured_rates():
    guide = (ROOT / "docs" / "how-to" / "reproduce-an-experiment.md").read_text()
    assert "15,000 gradient steps\nafter 279 seconds" in (ROOT / "results" / "rainbow_quick" / "README.md").read_text()
    per_hour = metrics_of(ROOT / "results" / "rainbow_4task" / "seed_1111")[-1]["num_updates"]
    thesis = ("rainbow_evaluation", "algorithm_comparison", "training_set_size", "training_difficulty")
    runs = {name: {run.id: run.total_updates for run in experiments()[name].runs()} for name in experiments()}
    together = dict(run for name in thesis for run in runs[name].items())
    for title, updates in {**{f"`{name}`": runs[name] for name in thesis}, "the last four together": together}.items():
        assert f"| {title} | {float(f'{sum(updates.values()) / per_hour:.2g}'):,.0f} hours |" in guide
    minutes = sum(runs["quick_comparison"].values()) / 15_000 * 279 / 60
    assert f"| `quick_comparison` | {round(minutes, -1):.0f} minutes |" in guide


@pytest.mark.parametrize(
    ("folder", "split", "num_episodes"),
    [
        ("general_short", None, 50),
        ("general_train4", None, 50),
        ("general_train4_long", None, 50),
        ("general_train4_two_hours", None, 50),
        ("general_varied", None, 50),
        ("general_varied_network", None, 50),
        ("general_compositions", None, 50),
        ("general_compositions_long", None, 50),
        ("general", None, 100),
        ("general_on_policy", None, 100),
        ("general_on_policy_average", None, 100),
        ("gates", "gate", 20),
    ],
)
def test_every_run_has_all_episodes_of_its_evaluation(folder: str, split: TaskSet | None, num_episodes: int):
    files = list((ROOT / "results" / folder).glob("runs/**/evaluation.jsonl.gz"))
    assert files
    for file in files:
        config = json.loads((file.parent / "config.json").read_text())["config"]
        assert config["run_dir"] is None, f"{file}: a path of the machine that trained it"
        trained = config["tasks"]
        wanted = {task.id for task in named_tasks(trained[0].partition("/")[0], split=split)}
        rows = rows_of(file)
        wanted |= set(trained) if split == "gate" else set()
        assert Counter(row["task"] for row in rows) == dict.fromkeys(wanted, num_episodes), file


def test_the_page_of_the_gates_says_how_many_runs_are_missing():
    folder = ROOT / "results" / "gates"
    page = words_of("results/gates/README.md")
    (command,) = re.findall("gvz experiment run (.*?) --results", page)
    missing = {}
    for gate in re.findall(r"gate_\w+", command):
        there = [(folder / "runs" / run.id).exists() for run in experiments()[gate].runs()]
        if not all(there):
            missing[gate] = (f"{there.count(False)}", f"{len(there)}")
    said = re.findall(r"(\d+) of the (\d+) (?:runs )?of `(gate_\w+)`", page)
    assert {gate: (absent, runs) for absent, runs, gate in said} == missing


def test_the_page_of_the_general_agents_says_what_their_records_give(tmp_path):
    folder = ROOT / "results" / "general_short"
    page, results = (folder / "README.md").read_text(), results_of("general_short")
    asked = results.asked[0]
    rows = result_table(results, asked).rows
    ours = rows[-2]  # the mean over the scenarios; the thesis's is below it
    for title, _, score in rows:
        (line,) = [line for line in page.splitlines() if line.startswith(f"| {title.text} |")]
        assert score.text in line
    (section,) = joint_sections(results, tmp_path)
    report = (folder / "report" / "report.md").read_text()
    for table in section.blocks[0].tables:
        rows_of_ours = [row for row in table.rows if row[0].text not in ("scripted", "sweep")]
        assert len(rows_of_ours) == 6
        assert all(f"| {' | '.join(cell.text for cell in row)} |" in report for row in rows_of_ours)
    means = {agent.text: mean.text for agent, *_, mean in section.blocks[0].tables[0].rows}
    for text in ((ROOT / "README.md").read_text(), PAGE):
        value, _, interval = means["rainbow_segmented"].partition(" ")
        assert re.search(rf"{re.escape(value)}%? {re.escape(interval)}", text)
    assert means["rainbow_general (8 tasks)"] == ours[2].text
    assert ours[2].estimate is not None
    assert ours[2].estimate.low > 41.84, "the thesis's best mean over the scenarios"
    for row in section.blocks[0].tables[1].rows:
        if row[-1].estimate is None:  # an agent that some scenarios lack
            continue
        assert f"| {' | '.join(cell.text for cell in row)} |" in page


def test_the_readme_says_how_fast_the_records_are():
    def medians(name: str, rate: str) -> dict[str, float]:
        rows = json.loads((ROOT / "results" / "performance" / f"{name}.json").read_text())["rows"]
        return {row["name"]: row[rate]["median"] for row in rows if row["kind"] == "rates"}

    def row(record: str, label: str) -> str:
        decisions = medians(record, "decisions_per_s")

        def fastest(group: str) -> str:
            best = max(value for name, value in decisions.items() if name.startswith(group))
            return f"{float(f'{best:.3g}'):,.0f}"

        ours, levdoom = fastest("actor pool"), f"{fastest('LevDoom 320x240')} ({fastest('LevDoom 256x144')}"
        return f"| decisions/s, random play{label} | {ours} | EnvPool {fastest('EnvPool')}, LevDoom {levdoom} "

    updates = medians("learner_update", "updates_per_s")
    readme = (ROOT / "README.md").read_text()
    assert (
        f"| gradient steps/s of 32 samples | {updates['learner, 1 to a call']:.1f} | Tianshou's Rainbow "
        f"{updates['Tianshou']:.1f}, Dopamine's {updates['Dopamine']:.1f} |"
    ) in readme
    assert row("actors", "") in readme
    assert row("actors_tuned", "; here with the tuned engine, others with their own") in readme


def test_the_page_of_the_tuned_engine_says_what_its_records_give():
    page = words_of("docs/ENGINE.md")
    equal, speed = (
        json.loads((ROOT / "results" / "engine" / f"{name}.json").read_text()) for name in ("equality", "speed")
    )
    assert not equal["differing"]
    assert f"**{equal['decisions']:,} decisions, and none differs**" in page
    ends = equal["episode_ends"]
    all_ends = f"{ends['inside']:,} of these {ends['deaths'] + ends['timeouts']:,} ends came within a decision."
    assert f"{ends['deaths']} episodes ended with the player's death and {ends['timeouts']:,} with a time-out" in page
    assert all_ends in page
    for part, title in (("bare", "`make_action` and `get_state`"), ("environment", "`gvz.make`, all of it")):
        for engine, called in (("stock", "released"), ("tuned", "tuned")):
            rate, *us = (speed[part][engine][key] for key in ("decisions_per_core_s", "engine_us", "python_us"))
            cells = " | ".join(f"{found['median']:g}" for found in us)
            assert f"| {title} | {called} | {rate['median']:,.0f} | {cells} |" in page
        gain = speed[part]["gain_decisions_per_core_s"]
        assert f"**{gain['median']:.2f}** [{gain['min']:.2f}, {gain['max']:.2f}] times" in page


def test_pages_say_what_a_gpu_gave():
    record = json.loads((ROOT / "results" / "performance" / "gpu_gpu.json").read_text())
    rows = {row["name"]: row for row in record["rows"]}
    cores, device = (rows[f"the run, actors.inference {where}"] for where in ("actors", "device"))
    alone = [row["updates_per_s"]["median"] for name, row in rows.items() if name.startswith("learner, ")]
    updates = [run["updates_per_s"]["median"] for run in (cores, device)]
    guide = words_of("docs/how-to/train.md")
    assert f"`rainbow_4task` makes {updates[0]:.0f} gradient steps a second" in guide
    assert f"chooses the actions, too, and it makes {updates[1]:.0f} ([measured]" in guide
    assert f"The learner alone makes up to {float(f'{max(alone):.3g}'):,.0f}." in guide
    first = [
        rows[f"from the command to the first gradient step, actors.inference {where}"] for where in ("actors", "device")
    ]
    assert (
        "step came after {:.0f} seconds, with `--actors.inference device` after {:.0f}.".format(
            *(row["median"] for row in first)
        )
        in guide
    )
    readme = words_of("README.md")
    decisions = [round(run["decisions_per_s"]["median"], -1) for run in (cores, device)]
    assert (
        f"makes {updates[0]:.0f} gradient steps and plays {decisions[0]:,.0f} decisions a second, with "
        f"`--actors.inference device` {updates[1]:.0f} and {decisions[1]:,.0f} ("
    ) in readme
    log = (ROOT / "results" / "general_gpu" / "compilation.txt").read_text()
    act, train_step = (
        [float(s) for s in re.findall(rf"jit\({name}\) in ([\d.]+) sec", log)] for name in ("act", "train_step")
    )
    acting, learning = sum(act), sum(train_step)
    assert f"it was {acting + learning:.0f} of 180 seconds" in guide
    page = words_of("results/general_gpu/README.md")
    assert f"for five batch sizes ({acting:.0f} s), then the gradient step ({learning:.0f} s)" in page
    assert (len(act), len(train_step)) == (5, 1)


def test_the_findings_say_how_many_games_and_steps_gates_of_training_sets_had():
    def runs(gate: str) -> dict[tuple[str, str, int], Path]:
        of_gate = {(run.training, run.scenario, run.seed): run.id for run in experiments()[gate].runs()}
        directories = {key: ROOT / "results/gates/runs" / run_id for key, run_id in of_gate.items()}
        return {key: directory for key, directory in directories.items() if directory.exists()}

    def games(directory: Path) -> int:
        return len({row["lane"] for row in rows_of(directory / "episodes.jsonl.gz")})

    world, pairs = runs("gate_world"), runs("gate_pairs")
    last = [metrics_of(directory)[-1] for directory in world.values()]
    steps = sorted(row["num_updates"] for row in last)
    decisions = sorted(round(row["actors/env_steps"], -3) for row in last)
    said = f"{steps[0]:,} to {steps[-1]:,} gradient steps and {decisions[0]:,} to {decisions[-1]:,} decisions"
    assert f"{said}; 8 games at once with eight tasks, otherwise 4" in WORDS
    assert {(training == "train8", games(run)) for (training, *_), run in world.items()} == {(True, 8), (False, 4)}
    of_pairs = {scenario: games(run) for (training, scenario, _), run in pairs.items() if training == "pairs"}
    assert of_pairs == {"dodge_projectiles": 42, "health_gathering": 48}
    of_eight = [games(run) for (training, *_), run in pairs.items() if training == "train8"]
    assert sorted(of_eight) == [8, 16, 16, 16]
    assert "and 42 and 48 games at once; eight tasks had 16, and 8 in one run of Health Gathering." in WORDS
