"""What the findings say is what the records of gates and of general agents give."""

import itertools
import json
import re

import numpy as np
import pytest

from gvz.reports.experiment_section import comparison_table, result_table
from gvz.reports.scores import agent_scores, estimate
from gvz.tasks import named_tasks, scenario_named, scenarios
from tests.score_tables import (
    PAGE,
    ROOT,
    SUMMARY,
    WORDS,
    gain,
    last_updates,
    learned,
    mean_score,
    metrics_of,
    results_of,
    rows_of,
    score_cells,
    scores_of,
    task_sets,
    training_episodes,
    words_of,
)
from tests.test_average_findings import RUNS, SCENARIOS, gain_of_average


@pytest.mark.parametrize(
    ("words", "other", "words_of_other"),
    [
        ("8 tasks", "rainbow_general (8 tasks and pairs)", "8 tasks and pairs"),
        ("screen", "rainbow_general+classes", "classes"),
        ("screen", "rainbow_general+sight_loss", "loss of sight"),
    ],
)
def test_the_findings_compare_the_general_agents_as_their_records_do(words, other, words_of_other):
    episodes = results_of("general_short").episodes
    names = episodes.filter(agent=other)["scenario"].unique(maintain_order=True)
    assert len(names) > 1
    agents = {"rainbow_general (8 tasks)": words, other: words_of_other}
    for name, (agent, called) in itertools.product(names, agents.items()):
        cells = score_cells(scores_of("general_short", agent, name), name).split(" | ")[:3]  # level 4 is not shown
        assert f"| {scenario_named(name).title} | {called} | {' | '.join(cells)} |" in PAGE


def test_the_findings_say_what_anyone_reaches_on_level_4():
    agents = results_of("general_short").episodes
    script = results_of("reference/scripted.jsonl.gz").episodes
    found = []
    for episodes, agent, num_seeds in (
        (agents, "rainbow_segmented", 3),
        (agents, "rainbow_general+classes", 1),
        (script, "scripted", 1),
    ):
        rows = [episodes.filter(agent=agent, task=task.id) for task in named_tasks(level=4)]
        assert all(of_task["run_seed"].n_unique() == num_seeds for of_task in rows)
        found.append([of_task["normalized_score"].mean() for of_task in rows])
    words = ["{:.0f}, {:.0f}, {:.0f} and {:.0f}".format(*scores) for scores in found]
    means = [f"{np.mean(scores):.1f}" for scores in found]
    assert f"{words[0]} on the four tasks `complete`, {means[0]} in the mean." in WORDS
    assert f"or a reward for moving, have {words[1]}, which is {means[1]}." in WORDS
    assert f"The script has {words[2]}, which is {means[2]}. The best of the three" in WORDS
    assert f"on each task would be {np.max(found, axis=0).mean():.1f}." in WORDS


def test_the_findings_say_what_more_decisions_for_each_gradient_step_take():
    said = []
    for number in (4, 16, 64):
        folder = ROOT / "results" / "gates" / "runs" / f"rainbow_4task+decisions_{number}" / "defend_the_center"
        files = sorted(folder.glob("**/metrics.jsonl.gz"))
        assert len(files) == 2
        runs = [rows_of(file) for file in files]
        waits = [row["actors/wait_share"] for rows in runs for row in rows if "actors/wait_share" in row]
        updates = np.mean([rows[-1]["num_updates"] for rows in runs])
        decisions = np.mean([rows[-1]["actors/env_steps"] for rows in runs])
        said.append((f"{updates:,.0f}", f"{round(decisions, -3):,.0f}", f"{100 * np.mean(waits):.0f}"))
    (updates, decisions, wait), (updates_16, decisions_16, wait_16), (updates_64, *_) = said
    assert (
        f"Center took {updates_16} gradient steps with 16 decisions and {updates} with 4, but {decisions_16}" in WORDS
    )
    assert f"points against 4. The runs took {updates_64} gradient steps." in WORDS
    assert f"decisions instead of {decisions}. With 4, the actors wait" in WORDS
    assert f"{wait} percent of their time, with 16 still {wait_16}." in WORDS


def test_the_findings_say_how_long_runs_of_the_gate_of_decisions_took_by_the_clock():
    said = []
    for number in (16, 4):
        runs = (ROOT / "results" / "gates" / "runs" / f"rainbow_4task+decisions_{number}").glob("*/train4/seed_*")
        starts_and_ends = [
            (json.loads((run / "starts.jsonl").read_text()), rows_of(run / "metrics.jsonl.gz")[-1]) for run in runs
        ]
        seconds = [end["time_s"] - start["time_s"] for start, end in starts_and_ends]
        assert len(seconds) == 4
        said.append(f"{min(seconds):,.0f} to {max(seconds):,.0f}")
    assert f"had less time**: {said[0]} seconds, those with 4 had {said[1]}." in WORDS


def test_the_findings_say_how_training_went_with_more_gradient_steps_beside_segmented_frames():
    periods_s, columns, variants = ((100, 300), (300, 600), (600, 900)), [], ("4", "8", "16", "batch_64")
    for variant in variants:
        agent = f"rainbow_segmented+{variant if variant == 'batch_64' else f'decisions_{variant}'}"
        (run,) = (ROOT / "results" / "gates" / "runs" / agent / "defend_the_center" / "train8").iterdir()
        metrics = metrics_of(run)
        if variant == "16":
            wait = 100 * np.mean([row["learner/wait_share"] for row in metrics if "learner/wait_share" in row])
            assert f"with 16, the learner waits {wait:.0f} percent of its time." in WORDS
        scores = [[row["normalized_score"] for row in training_episodes(run, *period)] for period in periods_s]
        last = metrics[-1]
        counts = (f"{last['num_updates']:,}", f"{round(last['actors/env_steps'], -3):,}")
        columns.append((*counts, *(f"{np.mean(found):.1f}" for found in scores)))
    titles = ("gradient steps", "decisions", *(f"training episodes, {low} to {high} s" for low, high in periods_s))
    for title, cells in zip(titles, zip(*columns, strict=True), strict=True):
        assert f"| {title} | {' | '.join(cells)} |" in PAGE
    for row in (2, 3):
        assert max(columns, key=lambda column: float(column[row])) == columns[0], (
            "4 decisions are ahead for 600 seconds"
        )


def test_the_findings_say_what_seven_minutes_of_a_gpu_gave():
    agents = {
        "rainbow_general (8 tasks)": ("`rainbow_general`, 2 cores", "general_short"),
        "rainbow_general_gpu": ("`rainbow_general_gpu`, 16 cores and a GPU", "general_gpu"),
        "rainbow_segmented": ("`rainbow_segmented`, 2 cores", "general_short"),
    }
    name = "seek_and_kill"
    shadows = {}
    for agent, (called, folder) in agents.items():
        assert f"| {called} | {score_cells(scores_of(folder, agent, name), name)} |" in WORDS
        shadows[agent] = mean_score(results_of(folder).episodes, agent=agent, task=f"{name}/blue+shadows")
    said = f"`blue+shadows` has {shadows['rainbow_general_gpu']} (segmented frames: {shadows['rainbow_segmented']})."
    assert said in WORDS
    (file,) = (ROOT / "results" / "general_gpu").glob("runs/**/metrics.jsonl.gz")
    rows = rows_of(file)
    readme, last = words_of("results/general_gpu/README.md"), rows[-1]
    counts = f"{last['num_updates']:,} gradient steps", f"{last['actors/env_steps']:,} decisions"
    assert f"{counts[0]}, {counts[1]}, training seed 1111" in readme
    assert f"{counts[0]} and {counts[1]}; one seed" in WORDS
    updates, decisions, learner_waits, actors_wait = (
        np.median([row[key] for row in rows])
        for key in ("learner/updates_per_s", "actors/decisions_per_s", "learner/wait_share", "actors/wait_share")
    )
    assert f"the learner made {updates:.0f} gradient steps a second" in readme
    assert f"took {decisions:,.0f} decisions a second (medians)" in readme
    assert learner_waits < 0.01, "it never waited"
    assert round(actors_wait, 1) == 0.3, "a third of their time"
    assert f"used {last['run/processor_s']:,.0f} seconds of processor time" in readme


def test_the_findings_say_what_the_first_loss_of_sight_gave():
    agents = {"rainbow_general+plain": "none", "rainbow_general+sight_loss": "first form"}
    for name, (agent, called) in itertools.product(("defend_the_center", "seek_and_kill"), agents.items()):
        scores = scores_of("gates", agent, name)
        cells = " | ".join(estimate(scores, tasks).text for tasks in task_sets(name)[:2])
        (line,) = [
            line for line in PAGE.splitlines() if line.startswith(f"| {scenario_named(name).title} | {called} |")
        ]
        assert line.endswith(f" | {cells} |")


def test_the_findings_say_what_the_gates_records_give():
    results = results_of("gates")
    world, reward, sight, ammo, defend, colour, augmented, *later = results.asked
    titles = {scenario_named(name).title for name in scenarios()}
    for trained, title in ((False, "gate tasks"), (True, "training tasks")):
        for gate in (world, reward, sight, ammo, defend, colour, *later):
            with_records = [
                row
                for row in result_table(results, gate, trained=trained).rows
                if row[0].text in titles and {cell.text for cell in row[2:]} != {"-"}
            ]
            for scenario, _, *cells in with_records:
                words = title if len(with_records) == 1 else scenario.text
                if len(cells) == 1:
                    continue  # test_average_findings.py
                assert f"| {words} | {' | '.join(cell.text for cell in cells)} |" in PAGE
        _, _, *cells = result_table(results, augmented, trained=trained).rows[1]
        assert [cell.text for cell in cells[:1]] == ["-"], "its run is that of general_sight_loss"
        assert f" | {' | '.join(cell.text for cell in cells[1:])} |" in PAGE
    for _, compared, more, _ in comparison_table(results, world).rows[:2]:
        value, _, interval = more.text.partition(" ")
        assert compared.text == "8 tasks against 4 tasks"
        assert value in PAGE
        assert interval in PAGE
    pooled = {row[0].text: row[2].text for row in comparison_table(results, sight).rows[:3]}
    assert list(pooled) == ["Dodge Projectiles", "Health Gathering", "Defend the Center"]
    assert all(more in PAGE for more in pooled.values())


def test_the_findings_say_how_training_went_on_in_the_gates_of_the_replay_and_the_horizon():

    def scores_of_training(variant: str) -> np.ndarray:
        """Of each run: the mean score of episodes at 6,000 to 8,000 gradient steps, and in the last 2,000."""
        runs = (ROOT / "results" / "gates" / "runs" / f"rainbow_segmented+{variant}").glob("**/episodes.jsonl.gz")
        found = []
        for file in runs:
            rows = rows_of(file)
            end = max(row["num_updates"] for row in rows)
            found.append((learned(rows, 6_000, 8_000), learned(rows, end - 2_000, end + 1)))
        return np.array(found)

    small, large = scores_of_training("replay_100k"), scores_of_training("replay_400k")
    assert len(small) == len(large) == 2
    (early, late), (early_of_large, late_of_large) = small.mean(axis=0), large.mean(axis=0)
    falls = [*(small[:, 0] - small[:, 1]), *(large[:, 0] - large[:, 1])]
    assert f"had {early:.0f} points with a replay of 100,000" in WORDS
    assert f"those of the last 2,000 steps had {late:.0f}." in WORDS
    assert f"they had {early_of_large:.0f} and {late_of_large:.0f} (means over both seeds)" in WORDS
    assert f"they fall with either, by {min(falls):.0f} to {max(falls):.0f} points a run" in WORDS
    assert f"had {early:.0f} points at 6,000 to 8,000 gradient steps and {late:.0f} in the last 2,000" in WORDS
    means = [scores_of_training(variant).mean(axis=0) for variant in ("discount_95", "game_variables", "both")]
    words = (
        f"{early:.0f} and {late:.0f} ({name})"
        for (early, late), name in zip(means, ("discount", "game variables", "both"), strict=True)
    )
    assert f"Now they have {', '.join(words)}" in WORDS


def test_the_summary_of_the_findings_has_the_gains_of_the_gates():
    named = set(re.findall(r"-?\d+\.\d \[-?\d+\.\d, -?\d+\.\d\]", SUMMARY))
    results = results_of("gates")
    folders = ("general_short", "general", "general_compositions", "general_compositions_long")
    gains = {row[2].text for gate in results.asked for row in comparison_table(results, gate).rows}
    of_segmented, of_training_sets = [], set[str]()
    for name in scenarios():
        gate_tasks = task_sets(name)[1]
        short, long, composed, composed_long = (scores_of(folder, "rainbow_segmented", name) for folder in folders)
        of_segmented.append(gain(short, scores_of("general_short", "rainbow_general (8 tasks)", name), gate_tasks))
        four = scores_of("general_train4", "rainbow_segmented+train4_network", name)
        for pair in ((composed, short), (short, four), (long, short), (composed_long, long)):
            of_training_sets.add(gain(*pair, gate_tasks))
    agents = ("rainbow_segmented+longer_network", "rainbow_segmented")
    both = [scores_of("general_short", agent, "seek_and_kill") for agent in agents]
    of_network = gain(*both, task_sets("seek_and_kill")[1])
    assert len(named) > 10
    of_average = {gain_of_average(agent, name)[0] for agent in RUNS for name in SCENARIOS}
    assert named <= gains | {*of_segmented, of_network} | of_training_sets | of_average
    assert f"game variables | {' | '.join(of_segmented)} | in `rainbow_segmented` |" in SUMMARY


def test_the_findings_say_how_far_apart_two_seeds_of_one_agent_lie():
    episodes, apart = results_of("gates").episodes, {"rainbow": (0.0, ""), "pqn": (0.0, "")}
    for name, agent in episodes.select("scenario", "agent").unique().rows():
        scores = agent_scores(episodes.filter(scenario=name), agent)
        means = [np.mean([found.mean() for found in run]) for run in scores.cells(task_sets(name)[1])]
        algorithm = agent.partition("_")[0]
        if algorithm in apart and means:
            apart[algorithm] = max(apart[algorithm], (float(max(means) - min(means)), f"{agent} {name}"))
    (of_rainbow, shots), (of_pqn, plain) = apart.values()
    assert (shots, plain) == ("rainbow_quick+shots_cost seek_and_kill", "pqn_quick+plain health_gathering")
    of_shots = "(findings/rewards-and-hyperparameters.md#free-shots-in-seek-and-kill-yes)"
    assert f"the seed alone can lie [{of_rainbow:.0f} points apart]{of_shots} on the" in WORDS
    of_replay = "(findings/algorithms-and-budgets.md#replay-or-on-policy-learning-replay)"
    assert f"two runs of PQN [{of_pqn:.0f} points]{of_replay}." in WORDS
    assert f"On the gate tasks the two with the price lie {of_rainbow:.0f} points apart." in WORDS


def test_the_findings_say_when_agents_of_the_gate_of_sight_survived():
    ended_s = []
    for variant in ("plain", "height_pool", "augmented", "height_pool_augmented"):
        folder = ROOT / "results" / "gates" / "runs" / f"rainbow_quick+{variant}" / "health_gathering" / "train8"
        for run in sorted(folder.iterdir()):
            survived = [row["num_updates"] for row in rows_of(run / "episodes.jsonl.gz") if row["truncated"]]
            assert bool(survived) == (variant != "height_pool_augmented"), "no episode of training reached the time-out"
            updates, spent_s = ([row[key] for row in metrics_of(run)] for key in ("num_updates", "run/processor_s"))
            ended_s += [f"{np.interp(survived[9], updates, spent_s):.0f}"] if survived else []
    words = "after {} and {} seconds (plain), {} and {} (pooled), {} and {} (augmented)."
    assert words.format(*ended_s) in WORDS


def test_the_findings_say_what_the_thesis_reward_gave_for_walking_and_how_often_an_agent_shot():
    moved, of_first = [], {}
    for seed in (1111, 2222):
        run = ROOT / "results" / "gates" / "runs" / "rainbow_quick+thesis" / "seek_and_kill" / "train8" / f"seed_{seed}"
        last = rows_of(run / "episodes.jsonl.gz")[-60:]
        rewards = np.array([row["reward_components"]["moved"] for row in last])
        steps = np.array([row["length_steps"] for row in last])
        moved.append((f"{np.mean(rewards / steps):.2f}", f"{rewards.mean():.0f}"))
    (a_decision, episode), (a_decision_of_other, other) = moved
    assert a_decision == a_decision_of_other
    assert f"both runs with the thesis's weights got {a_decision} a decision for walking. Over an episode this" in WORDS
    assert f"as much as the reward of {episode} and {other} kills." in WORDS
    played = results_of("gates").episodes.filter(agent="rainbow_quick+thesis", run_seed=1111)
    for task in task_sets("seek_and_kill")[0]:
        rows = played.filter(task=task)
        of_first[task] = (-10 * rows["reward/ammo_spent"].mean(), rows["player_kills"].mean())
    *_, (shots, _) = hardly = sorted(of_first.values())[:4]
    said = f"it had at most {shots:.2f} shots and {max(kills for _, kills in hardly):.2f} own kills an episode there."
    assert said in WORDS


def test_the_findings_say_what_pairs_of_attributes_gave():
    episodes, names = results_of("general_short").episodes, ("health_gathering", "seek_and_kill")
    agents = [f"rainbow_general ({words})" for words in ("8 tasks and pairs", "8 tasks")]
    gains = []
    for name in names:
        both = [scores_of("general_short", agent, name) for agent in agents]
        gains.append([gain(*both, tasks) for tasks in task_sets(name)])
    (_, gate, test, _), (trained, gate_of_other, test_of_other, _) = gains
    assert f"the gate tasks lose, and the test tasks gain**: {gate} and {test} points." in WORDS
    assert f"is shown**: {gate_of_other} points on the gate tasks and {test_of_other} on the test tasks." in WORDS
    assert f"The training tasks lose: {trained}." in WORDS
    for task in ("health_gathering/short_agent+water", "health_gathering/obstacles+slime+stimpacks"):
        found = [mean_score(episodes, agent=agent, task=task) for agent in agents]
        called = re.escape(task.partition("/")[2])
        assert re.search(f"`{called}` (has )?{' instead of '.join(found)}", WORDS)
    runs = ROOT / "results" / "general_short" / "runs" / "rainbow_general"
    steps = [metrics_of(runs / name / "pairs" / "seed_1111")[-1]["num_updates"] for name in names]
    assert "One seed, {:,} and {:,} gradient steps, 24".format(*steps) in WORDS


def test_the_findings_say_what_classes_and_the_screen_have_on_single_tasks():
    episodes = results_of("general_short").episodes
    agents = ("rainbow_general+classes", "rainbow_general (8 tasks)")

    def scores(task: str) -> list[str]:
        """With classes and with the screen."""
        return [mean_score(episodes, agent=agent, task=task) for agent in agents]

    shaded, sized = (
        scores(f"health_gathering/{task}") for task in ("shaded_kits+stimpacks", "poison+resized_kits+shaded_kits")
    )
    assert "`shaded_kits+stimpacks` has {} with classes and {} with the screen".format(*shaded) in WORDS
    assert "`poison+resized_kits+shaded_kits` {} and {}.".format(*sized) in WORDS


def test_the_findings_say_how_many_games_ran_at_once():

    def games(runs: str) -> set[int]:
        files = list((ROOT / "results").glob(f"{runs}/**/episodes.jsonl.gz"))
        assert files
        rows = (rows_of(file) for file in files)
        return {len({row["lane"] for row in episodes if "lane" in row}) for episodes in rows}

    assert games("general_short/runs/rainbow_segmented/*/train8") == {16}
    steps = last_updates("general_short/runs/rainbow_segmented/*/train8/*")
    assert len(steps) == 12
    assert f"({steps[0]:,} to {steps[-1]:,} gradient steps, 16 games at once)" in WORDS
    assert f"(eight tasks: {steps[0]:,} to {steps[-1]:,}, with 16 games)" in WORDS
    assert games("general_short/runs/rainbow_general+sight_loss") == {8}
    assert "with a weight of 0.1. One seed with 8 games at once" in WORDS
    readme = (ROOT / "results" / "general" / "README.md").read_text()
    assert games("general/runs/rainbow_general+sight_loss") == {8}
    assert games("general/runs/rainbow_segmented") == {16}
    assert "had 8 games at once, and act on the screen alone" in readme
    assert "`rainbow_segmented`, with 16 games at once." in readme
    on_policy = [games(f"gates/runs/{name}_quick+plain/*_*") for name in ("ppo", "pqn")]
    rainbow = [games(f"gates/runs/rainbow_quick+plain/{name}") for name in ("dodge_projectiles", "health_gathering")]
    assert [*on_policy, *rainbow] == [{8}] * 4
    assert "20 episodes a task; 8 games at once. The runs of Rainbow are those of" in WORDS


def test_the_findings_say_how_many_decisions_replay_and_on_policy_agents_took():

    def decisions(agent: str, scenario: str) -> str:
        files = list((ROOT / "results" / "gates" / "runs" / f"{agent}+plain" / scenario).rglob("metrics.jsonl.gz"))
        taken = [rows_of(file)[-1]["actors/env_steps"] for file in files]
        assert len(taken) == 2
        return f"{round(sum(taken) / 2, -3):,.0f}"

    pqn, ppo, rainbow = (
        [decisions(f"{name}_quick", scenario) for scenario in ("dodge_projectiles", "health_gathering")]
        for name in ("pqn", "ppo", "rainbow")
    )
    assert f"PQN took {pqn[0]} of them in Dodge Projectiles and {pqn[1]} in Health Gathering" in WORDS
    assert f"PPO {ppo[0]} and {ppo[1]}, Rainbow {rainbow[0]} and {rainbow[1]}." in WORDS


@pytest.mark.parametrize("name", scenarios())
def test_agents_on_segmented_frames_that_are_compared_have_the_same_settings(name):
    found = {}
    for file in (ROOT / "results").glob(f"general*/runs/rainbow_segmented*/{name}/**/config.json"):
        config = json.loads(file.read_text())["config"]
        rewards = {component: weight for component, weight in config["env"]["reward_weights"] if name in component}
        seen = {key: value for key, value in config["env"].items() if key not in ("reward_weights", "segmenter")}
        settings = (rewards, seen, *(config[part] for part in ("agent", "replay", "learner")))
        found.setdefault(json.dumps(settings, sort_keys=True), []).append(file.relative_to(ROOT))
    assert len(found) == 1, found.values()
