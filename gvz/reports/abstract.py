"""The head of a report: what was run, with which budget, who has more points, and what the numbers cannot show."""

import itertools
from collections.abc import Sequence

import numpy as np
import polars as pl

from gvz.evaluation.simple import SIMPLE_PLAYERS
from gvz.evaluation.statistics import Estimate, difference
from gvz.experiments.inventory import run_directory, run_progress
from gvz.experiments.plan import Evaluation
from gvz.reports.document import count
from gvz.reports.results import PlannedExperiment, Results
from gvz.reports.scenario_section import agents_of, played_tasks
from gvz.reports.scores import Scores, agent_scores, estimate_groups, redraw
from gvz.tasks import all_scenarios, named_tasks, scenario_named

ENOUGH_SEEDS = 10
"""training seeds with which a 95% interval holds the true mean in some 90 of 100 cases (docs/REPORTS.md)"""
ENOUGH_EPISODES = 10
"""of a task, for an interval over episodes"""
MOST_NAMES = 3
"""of runs or files in a sentence; the others are counted"""


def what_was_run(results: Results) -> list[str]:
    """Sentences on runs, budgets and episodes."""
    sentences = []
    for asked in results.asked:
        e = asked.experiment
        sentences.append(
            f"Experiment “{e.title}”: {count(len(e.runs()), 'run')} of {e.budget} asked for"
            + (f", at scale {asked.scale:g} of the full experiment." if asked.scale < 1 else ".")
        )
    if results.runs:
        steps = sorted({run.total_updates for run in results.runs})
        budget = f"{steps[0]:,}" if len(steps) == 1 else f"{steps[0]:,} to {steps[-1]:,}"
        if any(run.config.get("max_processor_s") is not None for run in results.runs):
            budget = f"at most {budget}"
        seeds = {run.seed for run in results.runs}
        agents = sorted(set(results.agents.values()))
        sentences.append(
            f"{count(len(results.runs), 'training run')} of {count(len(agents), 'agent')} ({', '.join(agents)}), "
            f"{count(len(seeds), 'training seed')}, {budget} gradient steps each."
        )
    tasks = results.episodes["task"].n_unique()
    players = results.episodes.filter(pl.col("run").is_null())["player"].unique().sort().to_list()
    kinds = {
        "players that do not learn": [player for player in players if player in SIMPLE_PLAYERS],
        "players that no run here has trained": [player for player in players if player not in SIMPLE_PLAYERS],
    }
    beside = "; ".join(f"{kind}: {', '.join(names)}" for kind, names in kinds.items() if names)
    beside = f", among them {beside}" if beside else ""
    sentences.append(f"{count(len(results.episodes), 'evaluation episode')} on {count(tasks, 'task')}{beside}.")
    return sentences


def who_has_more(results: Results) -> list[str]:
    """For each scenario the trained agents in order, each compared with the next on the tasks that all of them played;
    then the best of them with the players that do not learn. Agents without a seed that played all of these are left
    out and named.
    """
    sentences = []
    for name in all_scenarios():
        episodes = results.episodes.filter(scenario=name).drop_nulls("normalized_score")
        scores = {agent: agent_scores(episodes, agent) for agent in agents_of(episodes)}
        tasks = _common_tasks(name, episodes, scores)
        left_out = [agent for agent, one in scores.items() if not one.complete_seeds(tasks)]
        scores = {agent: one for agent, one in scores.items() if agent not in left_out}
        if len(scores) < 2 or not tasks:
            continue
        means = {
            agent: np.mean([[np.mean(c) for c in run] for run in one.cells(tasks)]) for agent, one in scores.items()
        }
        trained = scores.keys() & set(episodes.drop_nulls("run")["agent"])
        order = sorted(means, key=lambda agent: (agent not in trained, -means[agent]))
        learners, players = order[: len(trained)], order[len(trained) :]
        pairs = list(itertools.pairwise(learners or players))
        pairs += [(learners[0], player) for player in players] if learners else []
        compared = [_comparison(scores, one, other, tasks) for one, other in pairs]
        over = f"{scenario_named(name).title}, {_described(name, tasks)}"
        without = f" Left out, because they lack some of these tasks: {', '.join(left_out)}." if left_out else ""
        sentences.append(f"{over}: {'; '.join(compared)}.{without}")
    return sentences


def _common_tasks(scenario: str, episodes: pl.DataFrame, scores: dict[str, Scores]) -> list[str]:
    """The test tasks if two agents have them, among them a trained one if there are any; else all the tasks that all
    agents have.
    """
    test = [task.id for task in named_tasks(scenario, split="test")]
    trained = set(episodes.drop_nulls("run")["agent"])
    have_test = {agent for agent, one in scores.items() if one.complete_seeds(test)}
    if len(have_test) > 1 and (not trained or trained & have_test):
        return test
    return [task.id for task in played_tasks(episodes) if all(one.complete_seeds([task.id]) for one in scores.values())]


def _described(scenario: str, tasks: Sequence[str]) -> str:
    if set(tasks) == {task.id for task in named_tasks(scenario, split="test")}:
        return f"mean of the {len(tasks)} test tasks"
    if len(tasks) == 1:
        return tasks[0].partition("/")[2]
    return f"mean of the {len(tasks)} tasks that all played"


def _comparison(scores: dict[str, Scores], one: str, other: str, tasks: Sequence[str]) -> str:
    if single := [agent for agent in (one, other) if _has_single_episodes(scores[agent], tasks)]:
        return f"{one} and {other} cannot be compared ({' and '.join(single)}: one episode of a task)"
    gain = estimate_groups([(scores[one], tasks), (scores[other], tasks)], difference).estimate
    assert gain is not None, "all have these tasks"
    if gain.low <= 0 <= gain.high:
        return f"no difference shown between {one} and {other} ({gain} points)"
    if gain.value < 0:
        gain = Estimate(value=-gain.value, low=-gain.high, high=-gain.low)
        return f"{one} has {gain} points fewer than {other}"
    return f"{one} has {gain} points more than {other}"


def _has_single_episodes(scores: Scores, tasks: Sequence[str]) -> bool:
    """Its interval would be over episodes, but there is no more than one of a task."""
    fewest = min(len(cell) for run in scores.cells(tasks) for cell in run)
    return fewest < 2 and redraw(scores, tasks) == "episodes"


def caveats(results: Results) -> list[str]:
    """What the numbers cannot show."""
    found = []
    if small := sorted({asked.scale for asked in results.asked if asked.scale < 1}):
        found.append(
            f"Scale {small[0]:g}: budgets, episodes and grid are shrunk. This shows that the pipeline works, and "
            "nothing of what the agents can do at full size."
            if small[0] < 0.1
            else f"Scale {small[0]:g}: budgets and episodes are shrunk; not comparable with published numbers."
        )
    if few := sorted(agent for agent, seeds in _training_seeds(results).items() if len(seeds) < ENOUGH_SEEDS):
        found.append(
            f"Fewer than {ENOUGH_SEEDS} training seeds of {', '.join(few)}: intervals over so few are too short, and "
            "differences between agents may be differences between seeds."
        )
    by_cell = results.episodes.filter("final").drop_nulls("normalized_score").group_by("agent", "run_seed", "task")
    different = by_cell.agg(pl.col("episode").n_unique())  # several checkpoints play the same ones
    if few := sorted(set(different.filter(pl.col("episode") < ENOUGH_EPISODES)["agent"])):
        found.append(
            f"Fewer than {ENOUGH_EPISODES} evaluation episodes of some task by {', '.join(few)}: intervals over so few "
            "are too short."
        )
    unfinished = [run.id for run in results.runs if not run.ended]
    if unfinished:
        found.append(f"Not trained to the end (or without metrics): {', '.join(unfinished)}.")
    for asked in results.asked:
        found += _incomplete(results, asked)
    return found


def _training_seeds(results: Results) -> dict[str, set[int]]:
    """Those of each trained agent that were evaluated, whether their run directories are there or not; of an agent
    without any evaluation, those of its runs.
    """
    evaluated = results.episodes.drop_nulls("run")
    found, places = set(evaluated.select("agent", "run_seed").rows()), set(evaluated["run_dir"])
    others = {(results.agents[str(run.path)], run.seed) for run in results.runs if str(run.path) not in places}
    agents = {agent for agent, _ in found}
    found |= {(agent, seed) for agent, seed in others if agent not in agents}
    return {agent: {seed for one, seed in found if one == agent} for agent, _ in found}


def _incomplete(results: Results, asked: PlannedExperiment) -> list[str]:
    """Which of an experiment's runs are absent, and which of those that have ended lack evaluation episodes."""
    experiment, planned = asked.experiment, asked.experiment.runs()
    ended = {str(run.path): run.ended for run in results.runs}
    absent, lacking, num_wanted = 0, {}, 0
    for run in planned:
        directory = str(run_directory(asked.results, run))
        if directory not in ended:
            absent += 1
        elif ended[directory]:
            evaluation = Evaluation(tasks=experiment.evaluation_tasks(run), episodes=experiment.episodes)
            if num := run_progress(asked.results, run, evaluation).lacking(evaluation):
                lacking[run.id] = num
                num_wanted += len(evaluation.tasks) * evaluation.episodes * run.num_checkpoints
    found = []
    if absent:
        found.append(f"{experiment.title}: {absent} of {len(planned)} runs are not there yet.")
    if lacking:
        more = f" and {len(lacking) - MOST_NAMES} more" if len(lacking) > MOST_NAMES else ""
        found.append(
            f"{experiment.title}: {len(lacking)} of {len(planned)} runs lack {sum(lacking.values()):,} of their "
            f"{num_wanted:,} evaluation episodes: {', '.join(list(lacking)[:MOST_NAMES])}{more}."
        )
    return found
