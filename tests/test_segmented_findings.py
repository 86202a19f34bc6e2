"""What the findings say of agents on segmented frames is what their records give."""

import numpy as np

from gvz.reports.experiment_section import comparison_table
from gvz.reports.scores import estimate
from gvz.tasks import scenario_named, scenarios
from tests.score_tables import (
    PAGE,
    ROOT,
    WORDS,
    gain,
    last_updates,
    learned,
    mean_score,
    means,
    results_of,
    rows_of,
    score_cells,
    score_row,
    scores_of,
    task_sets,
)


def test_the_findings_say_what_segmented_agents_have_on_single_tasks():
    episodes = results_of("general_short").episodes

    def score(task: str, agent: str = "rainbow_segmented") -> str:
        assert len(episodes.filter(agent=agent, task=task)) == (150 if agent == "rainbow_segmented" else 50)
        return mean_score(episodes, agent=agent, task=task)

    center, gathering, dodging = "defend_the_center", "health_gathering", "dodge_projectiles"
    assert (
        f"`fuzzy_enemies+gore+stone_wall` has {score(f'{center}/fuzzy_enemies+gore+stone_wall')} instead of 54" in WORDS
    )
    water, classes = f"{gathering}/short_agent+water", "rainbow_general+classes"
    assert f"frames of classes have {score(water, classes)} there, segmented ones {score(water)}." in WORDS
    trained = [score(f"{gathering}/{name}") for name in ("supreme", "poison")]
    assert f"`supreme` and `poison`, training tasks, stand at {' and '.join(trained)}, and" in WORDS
    both = f"{gathering}/poison+supreme"
    assert f"`poison+supreme` at {score(both)} (classes: {score(both, classes)})" in WORDS
    at_random = score(f"{gathering}/complete", "random")
    assert f"`complete` has {score(f'{gathering}/complete')}; a random player has {at_random}." in WORDS
    assert f"`revenants`, whose missiles turn, has {score(f'{dodging}/revenants')}." in WORDS
    shadows, hard, *of_classes = (
        score(f"seek_and_kill/{name}", agent)
        for agent in ("rainbow_segmented", "rainbow_general+classes")
        for name in ("blue+shadows", "complete")
    )
    assert f"`blue+shadows` has {shadows} instead of 14, `complete` {hard} instead of 18." in WORDS
    assert f"Frames of classes have {' and '.join(of_classes)}." in WORDS
    files = (ROOT / "results/general_short/runs/rainbow_segmented/seek_and_kill").glob("**/episodes.jsonl.gz")
    learning = learned([row for file in files for row in rows_of(file)], 8_000, 10_000)
    assert f"training episodes had {learning:.0f} points at 8,000 to 10,000 gradient steps" in WORDS
    level_4 = [score(f"{name}/complete") for name in scenarios()]
    assert f"{', '.join(level_4[:3])} and {level_4[3]} on the four tasks `complete`" in WORDS


def test_the_findings_say_how_much_agents_of_the_gate_moved_and_what_it_gave_by_task():
    runs, variants = ROOT / "results" / "gates" / "runs", ("plain", "moved", "moved_more", "moved_most")
    moved, by_task = [], {"arachnotron": [], "mancubus+resized_agent": []}
    for variant in variants:
        folder = runs / f"rainbow_segmented+{variant}" / "dodge_projectiles"
        rows = [row for file in sorted(folder.glob("**/evaluation.jsonl.gz")) for row in rows_of(file)]
        for name, found in by_task.items():
            scores = [row["normalized_score"] for row in rows if row["task"] == f"dodge_projectiles/{name}"]
            assert len(scores) == 40
            found.append(f"{np.mean(scores):.0f}")
        last = [row for file in folder.glob("**/episodes.jsonl.gz") for row in rows_of(file)[-60:]]
        assert len(last) == 120
        moved.append(np.mean([row["reward_components"].get("moved", 0.0) / row["length_steps"] for row in last]))
    assert f"agents got {moved[0]:.0f}, {moved[1]:.3f}, {moved[2]:.3f} or {moved[3]:.3f} a decision for it" in WORDS
    assert f"with both, {moved[2] / 0.0005:.0f} and {moved[3] / 0.002:.0f} map units in five decisions" in WORDS
    assert "`arachnotron` has {}, {}, {} and {} by weight".format(*by_task["arachnotron"]) in WORDS
    assert "`mancubus+resized_agent` has {}, {}, {} and {}".format(*by_task["mancubus+resized_agent"]) in WORDS
    plain = results_of("gates").episodes.filter(agent="rainbow_segmented+plain")
    seeds = sorted(means_by_seed(plain, "dodge_projectiles", ["dodge_projectiles/arachnotron"]))
    assert "`arachnotron`, where agents had {:.0f} to {:.0f}.".format(*seeds) in WORDS
    names = [f"rainbow_segmented+{variant}" for variant in (*variants, "shift_moved")]
    steps = [n for name in names for n in last_updates(f"gates/runs/{name}/dodge_projectiles/**")]
    assert len(steps) == 9
    assert f"too, was known. 900 seconds of processor time a run, {min(steps):,} to {max(steps):,} gradient" in WORDS


def test_the_findings_say_what_shifted_frames_gave():
    episodes, said = results_of("gates").episodes, []
    for task in ("arachnotron", "mancubus+resized_agent"):
        for variant in ("shift", "moved_most"):
            rows = episodes.filter(agent=f"rainbow_segmented+{variant}", task=f"dodge_projectiles/{task}")
            assert len(rows) == 40
            said.append(f"{rows['normalized_score'].mean():.0f}")
    assert "`arachnotron` has {} instead of {}, `mancubus+resized_agent` {} instead of {}.".format(*said) in WORDS
    trained_tasks, gate_tasks, *_ = task_sets("dodge_projectiles")
    shifted = scores_of("general_short", "rainbow_segmented", "dodge_projectiles")
    assert f"agents with shifts have {score_cells(shifted, 'dodge_projectiles').split(' | ')[2]}, three" in WORDS
    on_gate, trained, on_gate_more, trained_more = (
        episodes.filter(episodes["task"].is_in(tasks), agent=f"rainbow_segmented+{variant}")["normalized_score"].mean()
        for variant in ("shift", "shift_moved")
        for tasks in (gate_tasks, trained_tasks)
    )
    assert f"0.002 has {on_gate:.1f} on the gate tasks and {trained:.1f} on the training tasks." in WORDS
    assert f"0.005 has {on_gate_more:.1f} and {trained_more:.1f}. It has one seed" in WORDS
    of_tasks = episodes.filter(episodes["task"].is_in(task_sets("defend_the_center")[0]))
    plain, everywhere, vertical = (
        of_tasks.filter(agent=f"rainbow_segmented+{name}")["normalized_score"].mean()
        for name in ("moved_most", "shift", "vertical")
    )
    assert f"[-3.9, -0.4] on the gate tasks and {plain - everywhere:.0f} on the training tasks. **In Health" in WORDS
    assert f"On the training tasks they lose {plain - vertical:.0f} point." in WORDS
    (gate,) = [asked for asked in results_of("gates").asked if asked.experiment.name == "gate_shift"]
    gains = [row[2].text for row in comparison_table(results_of("gates"), gate).rows]
    assert all(gain in WORDS for gain in gains[:5])


def test_the_findings_say_what_pairs_gave_beside_segmented_frames():
    (gate,) = [asked for asked in results_of("gates").asked if asked.experiment.name == "gate_pairs"]
    of_dodging, of_gathering = [row[2].text for row in comparison_table(results_of("gates"), gate).rows][1:3]
    said = f"either scenario**: {of_dodging} points in Dodge Projectiles and {of_gathering} in Health Gathering."
    assert said in WORDS


def test_the_findings_say_what_agents_on_segmented_frames_have():
    scores = {name: scores_of("general_short", "rainbow_segmented", name) for name in scenarios()}
    rows = [f"| {scenario_named(name).title} | {score_cells(found, name)} |" for name, found in scores.items()]
    assert "\n".join([*rows, f"| mean | {' | '.join(means(scores))} |"]) in PAGE


def test_the_findings_say_what_six_times_the_time_gave_with_a_loss_of_sight():
    agent = "rainbow_general+sight_loss"
    for name in ("defend_the_center", "seek_and_kill"):
        for seconds, folder in (("900 s", "general_short"), ("5,400 s", "general")):
            assert score_row(name, seconds, scores_of(folder, agent, name)) in PAGE
    first, last = last_updates(f"general/runs/{agent}/**")
    assert f"with 5,400 seconds, {first:,} and {last:,} gradient steps, 100 episodes a task. One seed;" in WORDS


def means_by_seed(episodes, name: str, tasks: list[str]) -> list[float]:
    """Mean over the tasks, of each training seed."""
    mine = episodes.filter(scenario=name)
    rows = [[mine.filter(run_seed=seed, task=task) for task in tasks] for seed in sorted(mine["run_seed"].unique())]
    return [float(np.mean([found["normalized_score"].mean() for found in of_seed])) for of_seed in rows]


def test_the_findings_say_what_segmented_agents_gained_in_six_times_the_time():
    folders, agent = ("general", "general_short"), "rainbow_segmented"
    gains, rows = {}, []
    for name in scenarios():
        both = [scores_of(folder, agent, name) for folder in folders]
        gains[name] = [gain(*both, tasks) for tasks in task_sets(name)]
        rows.append(f"| {scenario_named(name).title} | {' | '.join(gains[name])} |")
    assert "\n".join(rows) in PAGE
    on_test = " and ".join(gains[name][2].split()[0] for name in ("defend_the_center", "dodge_projectiles"))
    assert f"gain {on_test} points in Defend the Center and Dodge Projectiles, and nothing" in WORDS
    assert f"beside segmented frames | {' | '.join(found[1] for found in gains.values())} | as you like" in WORDS
    steps = last_updates(f"general/runs/{agent}/**")
    assert f"instead of 900, {steps[0]:,} to {steps[-1]:,} gradient steps, three seeds, 100 episodes" in WORDS
    long, short = (results_of(folder).episodes.filter(agent=agent) for folder in folders)
    for tasks in task_sets("health_gathering")[1::2]:
        before, after = (means_by_seed(episodes, "health_gathering", tasks) for episodes in (short, long))
        assert max(after) < min(before), "each seed is below all three of 900 seconds"
    seeds = means_by_seed(long, "dodge_projectiles", task_sets("dodge_projectiles")[1])
    assert "they have {:.1f}, {:.1f} and {:.1f} on the gate tasks.".format(*seeds) in WORDS


def test_the_findings_say_what_single_tasks_gained_in_six_times_the_time():
    short, long = (results_of(f).episodes.filter(agent="rainbow_segmented") for f in ("general_short", "general"))
    said, gathering, dodging = [], "health_gathering", "dodge_projectiles"
    tasks = [f"{gathering}/short_agent", f"{gathering}/short_agent+water"]
    assert not {*tasks} & {*task_sets(gathering)[0]}
    tasks += [f"{gathering}/poison+stimpacks", f"{dodging}/arachnotron"]
    for task in tasks:
        of_task = [one.filter(task=task) for one in (long, short)]
        seeds = [of_task[0].filter(run_seed=seed)["normalized_score"].mean() for seed in (1111, 2222, 3333)]
        said += [f"{score:.0f}" for score in (*seeds, of_task[1]["normalized_score"].mean())]
    words = "`short_agent` has {}, {} and {} instead of {}, and `short_agent+water` {}, {} and {} instead of {}."
    assert words.format(*said[:8]) in WORDS
    assert "`poison+stimpacks` loses, too: {}, {} and {} instead of {}.".format(*said[8:12]) in WORDS
    assert "`arachnotron` has {}, {} and {} instead of {}.".format(*said[12:]) in WORDS


def test_the_findings_say_how_segmented_agents_learned_in_six_times_the_time():
    learning = []
    for name in ("defend_the_center", "seek_and_kill", "dodge_projectiles", "health_gathering"):
        file, *_ = sorted((ROOT / f"results/general/runs/rainbow_segmented/{name}").glob("**/episodes.jsonl.gz"))
        rows = rows_of(file)
        last = rows[-1]["num_updates"]
        for low, high in ((30_000, 40_000), (60_000, 70_000), (last - 10_000, last + 1)):
            learning.append(f"{learned(rows, low, high):.0f}")
    assert (
        "{} points at 30,000 to 40,000 gradient steps, {} at 60,000 to 70,000, and {} in the last 10,000. "
        "Seek and Kill had {}, {} and {}, Dodge Projectiles {}, {} and {}, and Health Gathering {}, {} and {}."
    ).format(*learning) in WORDS


def test_the_findings_say_what_agents_have_whose_network_learned_longer():
    name = "seek_and_kill"
    agents = ("rainbow_segmented", "rainbow_segmented+longer_network")
    used, longer = (scores_of("general_short", agent, name) for agent in agents)
    for called, scores in (("the network that is used", used), ("the one that learned longer", longer)):
        assert f"| {called} | {score_cells(scores, name)} |" in WORDS
    _, gate_tasks, *_ = task_sets(name)
    more = gain(longer, used, gate_tasks)
    assert f"The difference on the gate tasks is {more} points." in WORDS
    assert f"beside segmented frames | | | | {more} | no |" in WORDS


def test_the_findings_say_what_a_longer_horizon_gave_in_health_gathering():
    episodes = results_of("gates").episodes

    def score(variant: str, name: str) -> str:
        chosen = {"agent": f"rainbow_segmented+{variant}", "task": f"health_gathering/{name}"}
        assert len(episodes.filter(**chosen)) == 40
        return mean_score(episodes, **chosen)

    assert f"`poison+stimpacks` has {score('far', 'poison+stimpacks')} instead of" in WORDS
    assert f"instead of {score('near', 'poison+stimpacks')}, and `poison` {score('far', 'poison')} instead of" in WORDS
    assert f"instead of {score('near', 'poison')}. `supreme` has {score('far', 'supreme')} instead of" in WORDS
    assert f"instead of {score('near', 'supreme')}." in WORDS
    name, short = "health_gathering", results_of("general_short").episodes.filter(agent="rainbow_segmented")
    scores = scores_of("general_short", "rainbow_segmented", name)
    assert f"With 0.98 they have {estimate(scores, task_sets(name)[1]).text} (`general_segmented`)." in WORDS
    in_gate, in_short = (
        dict(rows.filter(scenario=name).select("run_seed", "params").unique().rows())
        for rows in (episodes.filter(agent="rainbow_segmented+far"), short)
    )
    assert in_gate.items() < in_short.items(), "the same runs, and a third seed"
