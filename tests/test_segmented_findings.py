"""What the findings say of agents on segmented frames is what their records give."""

import itertools

import numpy as np

from gvz.reports.experiment_section import comparison_table
from gvz.reports.scores import agent_scores, estimate
from gvz.tasks import named_tasks, scenarios
from tests.score_tables import (
    PAGE,
    ROOT,
    WORDS,
    gain,
    last_updates,
    learned,
    mean_score,
    of_first_seed,
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
    assert f"`gore+mossy_bricks` {score(f'{center}/gore+mossy_bricks')} instead of 81" in WORDS
    assert (
        f"`fuzzy_enemies+gore+stone_wall` has {score(f'{center}/fuzzy_enemies+gore+stone_wall')} instead of 54" in WORDS
    )
    assert f"`complete` {score(f'{center}/complete')} instead of 47" in WORDS
    assert f"on `short_agent+water`, where agents have {score(f'{gathering}/short_agent+water')} instead of" in WORDS
    water, classes = f"{gathering}/short_agent+water", "rainbow_general+classes"
    assert f"frames of classes have {score(water, classes)} there, segmented ones {score(water)}." in WORDS
    assert f"`poison+stimpacks` has {score(f'{gathering}/poison+stimpacks')} instead of 73." in WORDS
    of_gate = estimate(scores_of("general_short", "rainbow_segmented", gathering), task_sets(gathering)[1]).text
    assert f"**Health Gathering has {of_gate} instead of 80.2" in WORDS
    trained = [score(f"{gathering}/{name}") for name in ("supreme", "poison")]
    assert f"`supreme` and `poison`, training tasks, stand at {' and '.join(trained)}, and" in WORDS
    both = f"{gathering}/poison+supreme"
    assert f"`poison+supreme` at {score(both)} (classes: {score(both, classes)})" in WORDS
    at_random = score(f"{gathering}/complete", "random")
    assert f"`complete` has {score(f'{gathering}/complete')}; a random player has {at_random}." in WORDS
    arachnotron, complete = (score(f"{dodging}/{name}") for name in ("arachnotron+city", "complete"))
    assert f"`arachnotron+city` has {arachnotron} and `complete` {complete}, where the sweep" in WORDS
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
        for name, means in by_task.items():
            scores = [row["normalized_score"] for row in rows if row["task"] == f"dodge_projectiles/{name}"]
            assert len(scores) == 40
            means.append(f"{np.mean(scores):.0f}")
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
    assert f"new enemies do. 900 seconds of processor time a run, {min(steps):,} to {max(steps):,} gradient" in WORDS


def test_the_findings_say_what_shifted_frames_gave():
    episodes, said = results_of("gates").episodes, []
    for task in ("arachnotron", "mancubus+resized_agent"):
        for variant in ("shift", "moved_most"):
            rows = episodes.filter(agent=f"rainbow_segmented+{variant}", task=f"dodge_projectiles/{task}")
            assert len(rows) == 40
            said.append(f"{rows['normalized_score'].mean():.0f}")
    assert "`arachnotron` has {} instead of {}, `mancubus+resized_agent` {} instead of {}.".format(*said) in WORDS
    trained_tasks, gate_tasks, *_ = task_sets("dodge_projectiles")
    in_zoo = episodes.filter(episodes["task"].is_in(gate_tasks), agent="rainbow_segmented+shift", run_seed=2222)
    assert f"is in the zoo, rounded: seed 2222, which has {in_zoo['normalized_score'].mean():.1f} there (20" in WORDS
    longer = results_of("general").episodes.filter(agent="rainbow_segmented")
    of_seeds = (
        longer.filter(longer["task"].is_in(gate_tasks)).select("run_seed", "normalized_score").group_by("run_seed")
    )
    assert (
        f"one has {of_seeds.mean()['normalized_score'].max():.1f} (100 episodes), but its policy was not kept." in WORDS
    )
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
    assert f"[-3.9, -0.4] on the gate tasks and {plain - everywhere:.0f} on the training tasks. The hypothesis" in WORDS
    assert f"the training tasks lose {plain - vertical:.0f} point, but the gate tasks lose no less" in WORDS
    (gate,) = [asked for asked in results_of("gates").asked if asked.experiment.name == "gate_shift"]
    gains = [row[2].text for row in comparison_table(results_of("gates"), gate).rows]
    assert all(gain in WORDS for gain in gains[:5])


def test_the_findings_say_what_pairs_gave_beside_segmented_frames():
    episodes = results_of("gates").episodes

    def means(task: str) -> list[float]:
        """Of the agent of pairs, and of each of the agents of eight tasks."""
        runs = (("8 tasks and pairs", 1111), ("8 tasks", 1111), ("8 tasks", 2222))
        found = [
            episodes.filter(agent=f"rainbow_segmented ({words})", run_seed=seed, task=task) for words, seed in runs
        ]
        assert [len(rows) for rows in found] == [20, 20, 20]
        return [float(rows["normalized_score"].mean()) for rows in found]

    said = []
    for task in ("dodge_projectiles/arachnotron", "health_gathering/short_agent+water"):
        pairs, *eight = means(task)
        said += [f"{pairs:.0f}", f"{np.mean(eight):.0f}"]
    assert "`arachnotron` has {} instead of {}, and `short_agent+water` {} instead of {}.".format(*said) in WORDS
    said = [f"{score:.0f}" for task in ("supreme", "poison") for score in means(f"health_gathering/{task}")]
    assert (
        "`supreme` has {}, where the two agents of eight tasks have {} and {}, and `poison` has {}, where they have {} "
        "and {}."
    ).format(*said) in WORDS
    pairs, eight = ([task.id for task in named_tasks("health_gathering", split=s)] for s in ("pairs", "train8"))
    rare = [sum("poison" in task or "supreme" in task for task in tasks) for tasks in (pairs, eight)]
    assert (rare, len(pairs)) == ([11, 2], 24)
    (gate,) = [asked for asked in results_of("gates").asked if asked.experiment.name == "gate_pairs"]
    gains = [row[2].text for row in comparison_table(results_of("gates"), gate).rows]
    assert all(gain in WORDS for gain in gains[1:3])


def test_the_findings_say_what_six_times_the_time_gave():
    steps = last_updates("general/runs/rainbow_segmented/**")
    of_frames = "of [segmented frames](segmented-frames.md#segmented-frames-yes)"
    assert f"{of_frames}, {steps[0]:,} to {steps[-1]:,} gradient steps." in WORDS
    agents = {"rainbow_general+sight_loss": "loss of sight", "rainbow_segmented": "segmented"}
    long = results_of("general").episodes
    runs = sorted(long.filter(long["agent"].is_in(agents)).select("scenario", "agent", "run_seed").unique().rows())
    assert {name for name, *_ in runs} == set(scenarios())
    for name, agent, seed in runs:
        scores = agent_scores(long.filter(scenario=name, run_seed=seed), agent)
        called = agents[agent] if seed == 1111 else f"{agents[agent]}, seed {seed}"
        assert score_row(name, f"{called} | 5,400 s", scores) in PAGE
    for name, agent in {(name, agent) for name, agent, _ in runs}:
        assert score_row(name, f"{agents[agent]} | 900 s", scores_of("general_short", agent, name)) in PAGE


def means_by_seed(episodes, name: str, tasks: list[str]) -> list[float]:
    """Mean over the tasks, of each training seed."""
    mine = episodes.filter(scenario=name)
    rows = [[mine.filter(run_seed=seed, task=task) for task in tasks] for seed in sorted(mine["run_seed"].unique())]
    return [float(np.mean([found["normalized_score"].mean() for found in of_seed])) for of_seed in rows]


def test_the_findings_say_what_the_first_seeds_of_segmented_agents_gained_in_six_times_the_time():
    short, long = (results_of(f).episodes.filter(agent="rainbow_segmented") for f in ("general_short", "general"))
    long, gains = of_first_seed(long), {}
    compared = ("defend_the_center", "dodge_projectiles", "health_gathering", "seek_and_kill")
    for name, split in itertools.product(compared, ("train8", "gate", "test")):
        tasks = [task.id for task in named_tasks(name, split=split)]
        before, (after,) = means_by_seed(short, name, tasks), means_by_seed(long, name, tasks)
        assert len(before) == 3
        shown = (name, split) not in (*((one, "gate") for one in compared[1:3]), ("seek_and_kill", "test"))
        assert (after > max(before)) == shown
        gains[name, split] = f"{after - np.mean(before):.1f}"
    seeds_below = {}
    for name in compared:
        before, (after,) = (means_by_seed(episodes, name, [f"{name}/complete"]) for episodes in (short, long))
        seeds_below[name] = sum(of_seed < after for of_seed in before)
    outside = {name: count for name, count in seeds_below.items() if count in (0, 3)}
    assert outside == {"health_gathering": 0}, "level 4: the other three are within the ranges"
    center, dodging, _, kill = ([gains[name, split] for split in ("train8", "gate", "test")] for name in compared)
    assert (
        f"In Defend the Center they gain {' and '.join(center[:2])} points, in Seek and Kill {' and '.join(kill[:2])}."
        in WORDS
    )
    assert f"test tasks gain {center[2]} points in Defend the Center and {dodging[2]} in Dodge" in WORDS


def test_the_findings_say_what_all_segmented_agents_gained_in_six_times_the_time():
    short, long = (results_of(f).episodes.filter(agent="rainbow_segmented") for f in ("general_short", "general"))
    of_both = []
    for name in ("defend_the_center", "seek_and_kill", "dodge_projectiles", "health_gathering"):
        both = [scores_of(folder, "rainbow_segmented", name) for folder in ("general", "general_short")]
        of_both += [gain(*both, tasks) for tasks in task_sets(name)]
    assert (
        f"beside segmented frames | {of_both[1]} | {of_both[9]} | {of_both[13]} | {of_both[5]} | as you like" in WORDS
    )
    together = {
        name: {2: "both", 3: "all three"}[long.filter(scenario=name)["run_seed"].n_unique()] for name in scenarios()
    }
    assert (
        "{} together have {} points more than 900 seconds on the training tasks, {} on the gate tasks and {} on the "
        "test tasks; on level 4 {}."
    ).format(together["defend_the_center"], *of_both[:4]) in WORDS
    assert (
        "{} together have {}, {} and {} points more, and on level 4 {}.".format(
            together["seek_and_kill"], *of_both[4:8]
        )
        in WORDS
    )
    assert f"no gain is shown on the gate tasks**: all three seeds together have {of_both[9]} points." in WORDS
    before = np.mean(means_by_seed(short, "dodge_projectiles", task_sets("dodge_projectiles")[0]))
    assert f"The training tasks had {before:.1f} before, and gain {of_both[8]} points; the test" in WORDS
    assert f"points; the test tasks gain {of_both[10]}." in WORDS
    assert f"All three seeds of Dodge Projectiles together have {of_both[11]} points more." in WORDS
    assert (
        f"gate tasks lose**: all three seeds together have {of_both[13]} points, and each is below all three" in WORDS
    )
    assert f"On training and test tasks no gain is shown: {of_both[12]} and {of_both[14]}." in WORDS
    assert f"those of Health Gathering below ({of_both[15]} points)" in WORDS
    for tasks in task_sets("health_gathering")[1::2]:
        before, after = (means_by_seed(episodes, "health_gathering", tasks) for episodes in (short, long))
        assert max(after) < min(before)


def test_the_findings_say_what_single_tasks_gained_in_six_times_the_time():
    short, long = (results_of(f).episodes.filter(agent="rainbow_segmented") for f in ("general_short", "general"))
    said, gathering, dodging = [], "health_gathering", "dodge_projectiles"
    tasks = [f"{gathering}/short_agent", f"{gathering}/short_agent+water"]
    assert not {*tasks} & {*task_sets(gathering)[0]}
    tasks += [f"{gathering}/poison+stimpacks", f"{dodging}/arachnotron", f"{dodging}/mancubus+resized_agent"]
    for task in tasks:
        of_task = [one.filter(task=task) for one in (long, short)]
        seeds = [of_task[0].filter(run_seed=seed)["normalized_score"].mean() for seed in (1111, 2222, 3333)]
        said += [f"{score:.0f}" for score in (*seeds, of_task[1]["normalized_score"].mean())]
    words = "`short_agent` has {}, {} and {} instead of {}, and `short_agent+water` {}, {} and {} instead of {}."
    assert words.format(*said[:8]) in WORDS
    assert "`poison+stimpacks` loses, too: {}, {} and {} instead of {}.".format(*said[8:12]) in WORDS
    words = "`arachnotron` has {}, {} and {} instead of {}, `mancubus+resized_agent` {}, {} and {} instead of {}."
    assert words.format(*said[12:]) in WORDS
    said = []
    for task in ("seek_and_kill/blue+shadows", "seek_and_kill/blue+mixed_enemies+resized_enemies"):
        of_task = [one.filter(task=task)["normalized_score"].mean() for one in (of_first_seed(long), short)]
        said += [f"{score:.0f}" for score in of_task]
    assert (
        "`blue+shadows` has {} instead of {}, and `blue+mixed_enemies+resized_enemies` {} instead of {}.".format(*said)
        in WORDS
    )


def test_the_findings_say_what_single_tasks_gained_with_a_loss_of_sight_in_six_times_the_time():
    said = []
    for task in (
        "seek_and_kill/blue+shadows",
        "seek_and_kill/complete",
        "defend_the_center/fast_enemies",
        "defend_the_center/mossy_bricks",
    ):
        for folder in ("general_short", "general"):
            said.append(mean_score(results_of(folder).episodes, agent="rainbow_general+sight_loss", task=task))
    shadows, complete, fast, bricks = zip(said[::2], said[1::2], strict=True)
    assert "`blue+shadows` falls from {} to {}, and level 4 stays at {}.".format(*shadows, complete[0]) in WORDS
    assert complete[0] == complete[1]
    assert "falls from {} to {}, `mossy_bricks` rises from {} to {}.".format(*fast, *bricks) in WORDS


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
