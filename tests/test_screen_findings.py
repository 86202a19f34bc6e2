"""What the findings say of agents on the screen, and of how many games agents had at once, is what the records give."""

import numpy as np
import polars as pl
import pytest

from gvz.experiments.base import experiment_named
from gvz.reports.scores import estimate
from gvz.tasks import scenario_named, scenarios
from tests.score_tables import (
    PAGE,
    ROOT,
    WORDS,
    last_updates,
    learned,
    mean_score,
    means,
    metrics_of,
    results_of,
    rows_of,
    score_cells,
    scores_of,
    task_sets,
)

SCREEN, CLASSES, SIGHT = "rainbow_general (8 tasks)", "rainbow_general+classes", "rainbow_general+sight_loss"


def on(agent: str, task: str, **chosen: int) -> str:
    return mean_score(results_of("general_short").episodes, agent=agent, task=task, **chosen)


@pytest.mark.parametrize("name", scenarios())
def test_the_findings_say_what_agents_on_the_screen_have_beside_players_that_do_not_learn(name: str):
    players = [
        estimate(scores_of(f"reference/{player}.jsonl.gz", player, name), task_sets(name)[2]).text.split()[0]
        for player in ("random", "sweep", "scripted")
    ]
    ours = score_cells(scores_of("general_short", SCREEN, name), name)
    thesis = experiment_named("general_short").published["thesis"][name][0]
    assert f"| {scenario_named(name).title} | {ours} | {' | '.join(players)} | {thesis:.2f} |" in PAGE


def test_the_findings_say_what_agents_on_the_screen_have_on_single_tasks():
    blue, shadows, both = (on(SCREEN, f"seek_and_kill/{task}") for task in ("blue", "shadows", "blue+shadows"))
    assert (
        f"Seek and Kill has {blue} on `blue` and {shadows} on `shadows`, which it was trained on, and {both} on"
        in WORDS
    )
    first = {"run_seed": 1111}
    complete = on(SCREEN, "dodge_projectiles/complete", **first)
    assert f"and {complete} on `complete`, which has one attribute of every group." in WORDS
    hard = ("poison+resized_kits+shaded_kits", "lava+short_agent+supreme", "complete")
    scores = sorted(int(on(SCREEN, f"health_gathering/{task}", **first)) for task in hard)
    assert f"or `complete` have {scores[0]} to {scores[-1]}." in WORDS
    slime = on(SCREEN, "health_gathering/obstacles+slime", **first)
    assert f"`obstacles+slime` has {slime}, but" in WORDS
    shadows, walls = (
        [on(agent, task) for agent in (CLASSES, SCREEN)]
        for task in ("seek_and_kill/blue+shadows", "defend_the_center/fuzzy_enemies+gore+stone_wall")
    )
    assert "`blue+shadows` has {} with classes and {} with the screen, `fuzzy".format(*shadows) in WORDS
    assert "`fuzzy_enemies+gore+stone_wall` {} and {}.".format(*walls) in WORDS


def test_the_findings_say_what_a_loss_of_sight_gave():
    def with_and_without(task: str) -> list[str]:
        return [on(agent, task) for agent in (SIGHT, SCREEN)]

    shaded, stimpacks = (
        with_and_without(f"health_gathering/{task}") for task in ("shaded_kits", "shaded_kits+stimpacks")
    )
    assert (
        "`shaded_kits` {} instead of {}, `shaded_kits+stimpacks` {} instead of {}.".format(*shaded, *stimpacks) in WORDS
    )
    shadows, gore = (
        [on(agent, task) for agent in (SIGHT, SCREEN, CLASSES)]
        for task in ("seek_and_kill/blue+shadows", "defend_the_center/gore")
    )
    assert "`blue+shadows` has {} with it, {} without it and {} with classes;".format(*shadows) in WORDS
    assert "`gore`, a training task, has {}, {} and {}.".format(*gore) in WORDS
    kills = [
        results_of("general_short").episodes.filter(pl.col("task").is_in(task_sets("seek_and_kill")[2]), agent=agent)
        for agent in (SIGHT, SCREEN)
    ]
    own = [f"{rows['player_kills'].mean():.1f}" for rows in kills]
    assert "own kills on the test tasks are {} an episode instead of {}.".format(*own) in WORDS
    of_gates = [
        means({name: scores_of("general_short", agent, name) for name in scenarios()})[1].split()[0]
        for agent in ("rainbow_segmented", SIGHT, SCREEN)
    ]
    assert "on the gate tasks {}, {} and {}.".format(*of_gates) in WORDS
    run = ROOT / "results/general_short/runs" / SIGHT / "seek_and_kill/train8/seed_1111"
    learning = learned(rows_of(run / "episodes.jsonl.gz"), 17_000, 18_000)
    assert f"a loss of sight they had {learning:.0f} at 17,000 to 18,000." in WORDS
    norms: dict[str, list[float]] = {}
    for agent in ("sight_loss", "plain"):
        runs = sorted((ROOT / "results/gates/runs" / f"rainbow_general+{agent}" / "seek_and_kill/train8").iterdir())
        of_runs = ([row["learner/grad_norm"] for row in metrics_of(one) if "learner/grad_norm" in row] for one in runs)
        norms[agent] = [float(np.median(found)) for found in of_runs]
    first, second = (f"{norm:.1f}" for norm in norms["sight_loss"])
    (plain,) = {f"{norm:.2f}" for norm in norms["plain"]}
    assert f"the gradient was {first} and {second} instead of {plain} (medians of a run)" in WORDS
    (center,), (kill,) = (
        last_updates(f"general_short/runs/{SIGHT}/{name}/*/*") for name in ("defend_the_center", "seek_and_kill")
    )
    assert f"it left time for {kill:,} and {center:,} instead of 21,100 to 25,800." in WORDS


def test_the_findings_say_where_agents_that_are_compared_had_other_numbers_of_games():
    def games(runs: str) -> list[int]:
        """By seed."""
        directories = sorted((ROOT / "results").glob(f"{runs}/seed_*"))
        assert directories
        return [len({row["lane"] for row in rows_of(run / "episodes.jsonl.gz")}) for run in directories]

    for name in scenarios():
        screen = games(f"general_short/runs/rainbow_general/{name}/train8")
        assert screen == ([16, 16, 8] if name == "seek_and_kill" else [8, 8, 8])
    assert "8 games at once, 16 in Seek and Kill with seeds 1111 and 2222; training seeds" in WORDS
    pairs = [
        games(f"general_short/runs/rainbow_general/{name}/pairs") for name in ("health_gathering", "seek_and_kill")
    ]
    assert pairs == [[24], [21]]
    assert "24 and 21 games at once (eight tasks: three seeds with 8 games, and 16 in two runs of Seek" in WORDS
    dodging, center, gathering = (
        "gates/runs/rainbow_segmented+{}/" + f"{name}/train8"
        for name in ("dodge_projectiles", "defend_the_center", "health_gathering")
    )
    assert games(dodging.format("plain")) == [8, 16]
    assert games(dodging.format("sticky_50")) == [8]
    for variant in ("moved", "moved_more", "moved_most", "shift", "vertical"):
        assert games(dodging.format(variant)) == [16, 16]
    assert games(dodging.format("shift_moved")) == [16]
    assert "16 games at once, but 8 with a weight of 0 and seed 1111;" in WORDS
    assert "seeds 1111 and 2222, with 8 and 16 games at once; sticky actions have 1111 alone, with 8 games." in WORDS
    for variant in ("moved_most", "shift", "vertical"):
        assert games(center.format(variant)) == [16, 16]
    assert (games(gathering.format("moved_most")), games(gathering.format("shift"))) == ([8, 16], [16, 16])
    assert "All had 16 games at once, but plain of Health Gathering with seed 1111 had 8." in WORDS
    (of_gpu,) = games("general_gpu/runs/rainbow_general_gpu/seek_and_kill/train8")
    (run,) = (ROOT / "results/general_gpu/runs").glob("*/*/*/*")
    assert (
        f"one seed, {of_gpu} games at once, {metrics_of(run)[-1]['run/processor_s']:,.0f} seconds of processor time"
        in WORDS
    )
