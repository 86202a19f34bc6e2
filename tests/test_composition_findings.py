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
    PAGE,
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


ROWS = (
    ("8 tasks", "900 s", "general_short"),
    ("compositions", "900 s", "general_compositions"),
    ("8 tasks", "5,400 s", "general"),
    ("compositions", "2,700 s", "general_compositions_long"),
)
"""trained on, processor time, records"""


def test_the_findings_say_what_compositions_of_attributes_gave():
    table = []
    for name in scenarios():
        table += [score_row(name, f"{called} | {time}", scores_of(of, AGENT, name)) for called, time, of in ROWS]
    for called, time, of in ROWS:
        cells = " | ".join(means({name: scores_of(of, AGENT, name) for name in scenarios()}))
        table.append(f"| mean | {called} | {time} | {cells} |")
    assert "\n".join(table) in PAGE


def test_the_findings_say_what_compositions_gave_after_900_seconds():
    gate, hardest = (
        [
            gain(*(scores_of(of, AGENT, name) for of in ("general_compositions", "general_short")), sets[column])
            for name, sets in ((name, task_sets(name)) for name in scenarios())
        ]
        for column in (1, 3)
    )
    where = "no; level 4 gains with time: `--training-set compositions`"
    assert f"as tasks, too, beside segmented frames | {' | '.join(gate)} | {where} |" in WORDS
    assert f"After 900 seconds the gate tasks have {in_words(gate)} points more than with eight tasks." in WORDS
    assert f"Level 4 gains {hardest[0]} points in Defend the Center; elsewhere" in WORDS
    assert all(" [-" in found for found in hardest[1:]), "no gain is shown"


def test_the_findings_say_what_compositions_gave_with_more_time():
    def gains(column: int) -> str:
        found = []
        for name in scenarios():
            short, longer = (
                estimate(
                    agent_scores(of_first_seed(results_of(of).episodes).filter(scenario=name), AGENT),
                    task_sets(name)[column],
                )
                for of in ("general_compositions", "general_compositions_long")
            )
            before, after = (float(one.text.split()[0]) for one in (short, longer))
            found.append(f"{after - before:.1f}")
        return in_words(found)

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


def test_pages_say_what_compositions_have_in_the_mean():
    episodes = results_of("general_compositions_long").episodes
    assert episodes.select("scenario", "run_seed").unique().height == 3 * len(scenarios())
    on_test = means({name: scores_of("general_compositions_long", AGENT, name) for name in scenarios()})[2]
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
        ("general_compositions", "*/*/*", "{:,} to {:,} gradient steps (eight tasks:"),
        ("general_short", "*/train8/*", "gradient steps (eight tasks: {:,} to {:,})"),
        ("general_compositions_long", "*/*/*", "`general_compositions_long`: {:,} to {:,} gradient steps."),
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
