"""Which runs are one agent: those of one configuration, as far as their training and their settings are the same."""

import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import polars as pl

from gvz.reports.runs import TRAINING_SETS, Run
from gvz.run.resume import may_change
from gvz.scenarios.map_set import names_map_set
from gvz.tasks import all_scenarios

EACH = "each task alone"
"""training of agents each of which was trained on one task"""

ONE_RUN = ("run_dir", "run", "run_seed", "scenario")
"""columns of episodes that tell trained agents apart: a record file, and so its directory, may have several"""

_TELL_NOTHING = ("seed", "scenario", "training_set", "tasks", "actors.num_actors", "actors.games_per_actor")
"""fields that agents of one name may have different: chance, what they train on, and how many games there are"""


def agents_of_runs(runs: Sequence[Run], evaluated: Mapping[object, set[str]]) -> dict[str, str]:
    """Run directory -> agent: the configuration's name, and what it was trained on where that tells agents apart.

    Runs that were each trained on one task, and were evaluated on no common one, are one agent (EACH). Runs of several
    scenarios are one agent unless one of them was evaluated where another one was trained.

    Args:
        runs: of any configurations.
        evaluated: run directory -> ids of the tasks that it was evaluated on.
    """
    alone: dict[tuple[str, tuple[str, ...]], dict[str, set[str]]] = {}
    for run in runs:
        if len(run.tasks) == 1:
            played = alone.setdefault((run.name, run.scenarios), {}).setdefault(run.training, set())
            if not _is_of_a_set(run):
                played |= evaluated.get(str(run.path), set())

    def training(run: Run) -> str:
        if len(run.tasks) > 1 or _is_of_a_set(run):
            return run.training
        played = alone[run.name, run.scenarios].values()
        apart = sum(map(len, played)) == len(set().union(*played))
        return EACH if apart and len(played) > 2 else run.training  # more than default and one other

    trainings = {name: {training(run) for run in runs if run.name == name} for name in {run.name for run in runs}}
    settings, away = _telling_settings(runs), _names_away(runs, evaluated)
    words = {
        run.path: [f"trained in {' and '.join(run.scenarios)}"] * (run.name in away)
        + [training(run)] * (len(trainings[run.name]) > 1)
        + settings.get(run.path, []) * (not _is_of_a_set(run))
        for run in runs
    }
    return {
        str(run.path): f"{run.name} ({', '.join(words[run.path])})" if words[run.path] else run.name for run in runs
    }


def _names_away(runs: Sequence[Run], evaluated: Mapping[object, set[str]]) -> set[str]:
    """Names of runs of which one was evaluated in a scenario that it was not trained in, but another one was."""
    trained_in: dict[str, set[str]] = {}
    for run in runs:
        trained_in.setdefault(run.name, set()).update(run.scenarios)
    return {
        run.name
        for run in runs
        for task in evaluated.get(str(run.path), set())
        if (scenario := task.partition("/")[0]) in trained_in[run.name] and scenario not in run.scenarios
    }


def _telling_settings(runs: Sequence[Run]) -> dict[Path, list[str]]:
    """ "agent.discount 0.5": settings in which runs of one name on the same tasks differ, of each of these runs.

    Left out are settings that change nothing (`gvz.run.resume`), and numbers of actors and games. A run of an older
    version lacks some settings: those of the others are compared without it.
    """
    alike: dict[tuple[str, tuple[str, ...]], list[Run]] = {}
    for run in runs:
        alike.setdefault((run.name, run.tasks), []).append(run)
    found: dict[Path, list[str]] = {}
    for group in alike.values():
        values = [dict(_settings(run)) for run in group]
        for name in dict.fromkeys(name for of_run in values for name in of_run):
            own = {run.path: of_run[name] for run, of_run in zip(group, values, strict=True) if name in of_run}
            if len(set(own.values())) > 1:
                for path, value in own.items():
                    found.setdefault(path, []).append(f"{name} {value}")
    return found


def _settings(run: Run) -> Iterator[tuple[str, str]]:
    """Dotted names and values, in JSON, of what may tell agents of the run's scenarios apart."""
    others = all_scenarios().keys() - set(run.scenarios)
    for name, value in run.settings.items():
        if name == "env.reward_weights" and isinstance(value, list):
            yield name, json.dumps([pair for pair in value if not any(f"{one}." in str(pair) for one in others)])
        elif not (may_change(name) or name in _TELL_NOTHING):
            yield name, json.dumps(value)


def pooled_runs(runs: Sequence[Run], agents: Mapping[str, str], evaluated: Mapping[object, set[str]]) -> list[str]:
    """What a reader would not expect to be put together: runs of other settings or budgets, and of one seed."""
    settings, problems = _telling_settings(runs), []
    by_agent: dict[str, list[Run]] = {}
    for run in runs:
        by_agent.setdefault(agents[str(run.path)], []).append(run)
    for agent, of_agent in by_agent.items():
        problems += [
            f"{run.path}: put together with other runs of {agent}, which have another {', '.join(settings[run.path])}"
            for run in of_agent
            if _is_of_a_set(run) and run.path in settings
        ]
        problems += _of_other_networks(of_agent)
        problems += _of_other_budgets(of_agent)
        for one, other in itertools.combinations(of_agent, 2):
            both = evaluated.get(str(one.path), set()) & evaluated.get(str(other.path), set())
            if one.seed == other.seed and one.tasks == other.tasks and both:
                problems.append(
                    f"{other.path}: the same agent and training seed as {one.path}; their episodes are put together as "
                    "if they were of one run; leave one out"
                )
    return problems


def _of_other_networks(of_agent: Sequence[Run]) -> Iterator[str]:
    """Runs that learned with another segmentation network than an earlier one of this agent, if both have noted it."""
    first: dict[str, tuple[object, Run]] = {}
    for run in of_agent:
        networks = run.starts[-1].get("segmenters") if run.starts else None
        for scenario, digest in networks.items() if isinstance(networks, dict) else ():
            known, earlier = first.setdefault(scenario, (digest, run))
            if known != digest:
                yield (
                    f"{run.path}: put together with {earlier.path}, which learned with another segmentation network of "
                    f"{scenario}"
                )


def _of_other_budgets(of_agent: Sequence[Run]) -> Iterator[str]:
    """Runs that may train for longer or shorter than the first one of this agent in the same scenarios."""
    first: dict[tuple[str, ...], Run] = {}
    for run in of_agent:
        one = first.setdefault(run.scenarios, run)
        if run.budget != one.budget:
            yield f"{run.path}: put together with {one.path}, which has another budget: {one.budget}, not {run.budget}"


def _is_of_a_set(run: Run) -> bool:
    """An experiment has trained it on a training set, if only of one task, or on drawn maps."""
    scenario, training = ["", "", *run.id.split("/")][-3:-1]
    return scenario in all_scenarios() and (training in TRAINING_SETS or names_map_set(training))


def with_agents(episodes: pl.DataFrame, agents: dict[str, str]) -> pl.DataFrame:
    """Adds the columns `agent` and `final`."""
    named = pl.col("run_dir").replace_strict(agents, default=pl.col("run"), return_dtype=pl.String)
    age = pl.col("num_updates").rank("dense", descending=True)  # 1: the newest checkpoint
    num_checkpoints = pl.col("num_updates").n_unique()
    final = (age <= (num_checkpoints / 4).ceil()).over(ONE_RUN).fill_null(value=True)
    seen = pl.format(" ({})", "observes").fill_null("")  # of a player of one's own that has other than the screen
    agent = pl.concat_str(pl.coalesce(named, "player"), seen)
    beside = pl.col("run").is_null() & pl.col("run").is_not_null().any().over("agent")  # a run has this player's name
    return (
        episodes.with_columns(agent=agent, final=final)
        .with_columns(agent=pl.when(beside).then(pl.format("{} (player)", "agent")).otherwise("agent"))
        .with_columns(agent=pl.concat_str("agent", *_other_rules()))
    )


def _other_rules() -> list[pl.Expr]:
    """ " (levdoom)" for rows of an agent that played by several rules, for each kind of rule; else nothing.

    A profile is another game with another upper bound: where there are several, every agent has its own in its name.
    """

    def several(rule: str) -> pl.Expr:
        num_rules = pl.col(rule).drop_nulls().n_unique()
        return (num_rules if rule == "profile" else num_rules.over("agent")) > 1

    return [
        pl.when(several(rule))
        .then(pl.format(text, pl.col(rule).cast(pl.String).fill_null("unknown " + rule)))
        .otherwise(pl.lit(""))
        for rule, text in (("profile", " ({})"), ("action_set", " ({})"), ("frame_skip", " (frame_skip {})"))
    ]
