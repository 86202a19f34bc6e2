"""What the findings say of training on compositions of attributes is what its records give."""

import re
from pathlib import Path

import numpy as np
import polars as pl

from gvz.evaluation.episode_log import read_rows
from gvz.evaluation.zoo import run_directory
from gvz.reports.scores import agent_scores, estimate
from gvz.tasks import Task, named_tasks, parse_task, scenarios
from tests.score_tables import (
    ROOT,
    WORDS,
    gain,
    in_words,
    last_updates,
    means,
    of_first_seed,
    results_of,
    rows_of,
    score_row,
    scores_of,
    task_sets,
    words_of,
)

AGENT = "rainbow_segmented"


def test_the_findings_say_what_compositions_of_attributes_gave():
    folders = {"8 tasks": "general_short", "compositions": "general_compositions"}
    scores = {
        (name, called): scores_of(folder, AGENT, name) for name in scenarios() for called, folder in folders.items()
    }
    for (name, called), of_agent in scores.items():
        assert score_row(name, called, of_agent) in WORDS
    for called in folders:
        *cells, on_level_4 = means({name: scores[name, called] for name in scenarios()})
        assert f"| mean | {called} | {' | '.join(cells)} | {on_level_4} |" in WORDS
    assert f"has {on_level_4} there after the same time" in WORDS

    gate, hardest = (
        [gain(scores[one, "compositions"], scores[one, "8 tasks"], task_sets(one)[column]) for one in scenarios()]
        for column in (1, 3)
    )
    where = "no; level 4 gains with time: `--training-set compositions`"
    assert f"as tasks, too, beside segmented frames | {' | '.join(gate)} | {where} |" in WORDS
    assert f"level 4 gains {hardest[0]} points**, though the run" in WORDS
    assert f"The gate tasks show {gate[0]}." in WORDS
    assert f"the gate tasks lose**: {gate[2]} and {gate[3]}. On level 4 no gain is shown: {hardest[2]} and" in WORDS
    assert f"is shown: {hardest[2]} and {hardest[3]}." in WORDS
    hard = results_of("general_compositions").episodes.filter(task="seek_and_kill/complete")
    found = [hard.filter(run_seed=seed)["normalized_score"].mean() for seed in (1111, 2222)]
    assert "have {:.1f} and {:.1f} on `complete`.".format(*found) in WORDS


def test_the_findings_say_what_compositions_gave_with_more_time():
    short, longer, _ = rows = (
        ("compositions", "900 s", "general_compositions"),
        ("compositions", "2,700 s", "general_compositions_long"),
        ("8 tasks", "5,400 s", "general"),
    )
    of_seed = {
        (name, row): agent_scores(of_first_seed(results_of(row[2]).episodes).filter(scenario=name), AGENT)
        for name in scenarios()
        for row in rows
    }
    for (name, (called, seconds, _)), of_agent in of_seed.items():
        assert score_row(name, f"{called} | {seconds}", of_agent) in WORDS
    for row in rows:
        *cells, on_level_4 = means({name: of_seed[name, row] for name in scenarios()})
        assert f"| mean | {row[0]} | {row[1]} | {' | '.join(cells)} | {on_level_4} |" in WORDS
        if row == longer:
            assert f"mean of the scenarios level 4 has {on_level_4}.**" in WORDS

    def gains(column: int) -> str:
        def mean(name: str, row: tuple[str, str, str]) -> float:
            return float(estimate(of_seed[name, row], task_sets(name)[column]).text.split()[0])

        return in_words([f"{mean(name, longer) - mean(name, short):.1f}" for name in scenarios()])

    assert f"the test tasks gain {gains(2)} points" in WORDS
    assert f"and level 4 gains {gains(3)}." in WORDS


def test_the_findings_say_what_three_seeds_of_compositions_have_beside_eight_tasks_with_twice_the_time():
    gains: list[list[str]] = []
    for name in scenarios():
        both = [scores_of(folder, AGENT, name) for folder in ("general_compositions_long", "general")]
        assert {len(scores.runs) for scores in both} == {3}
        gains.append([gain(*both, tasks) for tasks in task_sets(name)])
    trained, gate, test, hardest = map(list, zip(*gains, strict=True))
    on_level_4 = f"On level 4 they are better by {in_words(hardest)}."
    assert f"with half the time**: by {in_words(test)} points. {on_level_4}" in WORDS
    assert f"no difference is shown**: {in_words(trained)} points. On the gate tasks the" in WORDS
    assert f"the differences are {in_words(gate)}." in WORDS
    assert f"not eight tasks for 5,400 s | {' | '.join(gate)} |" in WORDS


def test_the_findings_say_what_further_seeds_of_compositions_gave_with_more_time():
    episodes = results_of("general_compositions_long").episodes
    further = episodes.filter(episodes["run_seed"] != 1111)
    runs = further.select("scenario", "run_seed").unique().rows()
    assert WORDS.count("| 2222 |") + WORDS.count("| 3333 |") == len(runs) > 0
    for name, seed in runs:
        of_agent = agent_scores(further.filter(scenario=name, run_seed=seed), AGENT)
        assert score_row(name, str(seed), of_agent) in WORDS
    *_, on_test, on_level_4 = means({name: scores_of("general_compositions_long", AGENT, name) for name in scenarios()})
    assert f"With all seeds the mean is {on_level_4} on level 4 and {on_test} on the test tasks." in WORDS
    assert episodes.select("scenario", "run_seed").unique().height == 3 * len(scenarios())
    assert f"and {on_level_4} after three times the time, with three seeds." in WORDS
    percent, interval = on_test.split(" ", 1)
    assert f"for 45 minutes, such agents have {percent}% {interval} (three seeds). " in words_of("README.md")
    guide = words_of("docs/how-to/train.md")
    assert f"Such agents have {percent}% of the bound on the 28 test tasks." in guide
    for folder, words in (("general_short", "after 15 minutes"), ("general", "after 90.")):
        eight = {name: scores_of(folder, AGENT, name) for name in scenarios()}
        assert re.search(rf"\[{means(eight)[2].split()[0]}%\]\([^)]*\) {words}", guide)


def test_the_pages_say_how_near_the_test_tasks_are_to_compositions():
    sets = {name: [set(task.attributes) for task in named_tasks(name, split="compositions")] for name in scenarios()}
    test = named_tasks(split="test")
    assert not set(test) & set(named_tasks(split="compositions"))

    def near(task: Task) -> bool:
        mine = set(task.attributes)
        return any(len(mine - one) <= 1 and len(one - mine) <= 1 for one in sets[task.scenario.id])

    parts = [task.id for task in test if any(set(task.attributes) < one for one in sets[task.scenario.id])]
    assert f"attributes of {len(parts)} of the {len(test)} test tasks stand together in one of them" in WORDS
    assert f"and {sum(map(near, test))} of the {len(test)} become one if one" in WORDS
    near_ones = f"attributes of {len(parts)} of the {len(test)} test tasks stand together in one of"
    assert f"{near_ones} them, and {sum(map(near, test))} become one" in words_of("docs/BENCHMARK.md")
    assert f"{near_ones} these" in words_of("README.md")

    def scores(folder: str) -> list[str]:
        """On these tasks, and on the others."""
        mine = results_of(folder).episodes.filter(agent=AGENT).filter(pl.col("task").is_in([*ids]))
        return [f"{part['normalized_score'].mean():.1f}" for part in (mine.filter(is_part), mine.filter(~is_part))]

    ids, is_part = [task.id for task in test], pl.col("task").is_in(parts)
    some, others = scores("general_compositions_long")
    assert f"With three seeds the {len(parts)} have {some} and the other nine {others};" in WORDS
    assert "eight tasks have {} and {} after 5,400 seconds (means over tasks).".format(*scores("general")) in WORDS


def test_the_findings_say_how_long_agents_of_compositions_learned():
    for folder, runs, words in (
        ("general", "*/*/seed_1111", "{:,} to {:,} gradient steps. The training seed is 1111. Intervals"),
        ("general_compositions", "*/*/*", "{:,} to {:,} gradient steps (eight tasks:"),
        ("general_short", "*/train8/*", "gradient steps (eight tasks: {:,} to {:,})"),
        (
            "general_compositions_long",
            "*/*/seed_1111",
            "{:,} to {:,} gradient steps ([records](../../results/general_compositions_long",
        ),
        ("general_compositions_long", "*/*/seed_[23]*", "2,700 seconds, with {:,} to {:,} gradient steps:"),
    ):
        steps = last_updates(f"{folder}/runs/{AGENT}/{runs}")
        assert words.format(steps[0], steps[-1]) in WORDS


def test_the_findings_say_what_trained_agents_have_on_level_4_without_one_attribute():
    played: dict[str, list[float]] = {}
    for row in rows_of(ROOT / "results" / "zoo" / "without_one_attribute.jsonl.gz"):
        played.setdefault(row["task"], []).append(row["normalized_score"])
    assert {len(found) for found in played.values()} == {15}
    for name, scenario in scenarios().items():
        missing: dict[str, float] = {}
        for attribute in scenario.complete:
            rest = "+".join(other for other in scenario.complete if other != attribute)
            missing[attribute] = float(np.mean(played.pop(parse_task(f"{name}/{rest}").id)))
        cells = ", ".join(
            f"`{one}` {missing[one]:.0f}" for one in sorted(missing, key=missing.__getitem__, reverse=True)
        )
        of_zoo = read_rows(run_directory(Path(f"zoo:{name}")) / "evaluation.jsonl")
        whole = [row["normalized_score"] for row in of_zoo if row["task"] == f"{name}/complete"]
        assert len(whole) == 100
        assert f"| {scenario.title} | {np.mean(whole):.0f} | {cells} |" in WORDS
    assert not played
