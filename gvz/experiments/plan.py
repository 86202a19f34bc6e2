"""The plan of a results directory: experiments, scale and scenarios, and the runs that follow; plan.json keeps it."""

import dataclasses
import itertools
import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from gvz.core import records
from gvz.core.errors import ConfigError, TaskError
from gvz.core.files import written_whole
from gvz.evaluation.simple import SimplePlayerName
from gvz.experiments.base import Experiment, TrainingRun, experiment_named
from gvz.experiments.scale import CHECK_BELOW, scaled
from gvz.tasks import scenario_named

PLAN_SCHEMA = 2

Item = TypeVar("Item")


@dataclass(frozen=True, kw_only=True, slots=True)
class Evaluation:
    """Which episodes are played: 0 .. episodes - 1 of each task."""

    tasks: tuple[str, ...] = ()
    episodes: int = 0

    def joined(self, tasks: Sequence[str], episodes: int) -> "Evaluation":
        """All tasks of both, each with the larger number of episodes."""
        return Evaluation(tasks=tuple(dict.fromkeys((*self.tasks, *tasks))), episodes=max(self.episodes, episodes))


@dataclass(frozen=True, kw_only=True, slots=True)
class Plan:
    """The experiments of one results directory."""

    asked: Mapping[str, tuple[str, ...] | None]
    """experiment -> only these of its scenarios; None: all (at the smallest scales: the first)"""
    scale: float = 1.0

    def __post_init__(self) -> None:
        for scenario in itertools.chain.from_iterable(filter(None, self.asked.values())):
            scenario_named(scenario)
        self.experiments()
        self.runs()

    @classmethod
    def of(cls, *names: str, scale: float = 1.0, scenarios: tuple[str, ...] | None = None) -> "Plan":
        """Experiments by name, all with the same choice of scenarios."""
        return cls(asked=dict.fromkeys(names, scenarios), scale=scale)

    def experiments(self) -> tuple[Experiment, ...]:
        """The experiments, at the plan's scale and with its scenarios alone.

        Raises:
            ConfigError: an unknown experiment, none, a bad scale, or an experiment without any of the scenarios.
        """
        if not self.asked:
            raise ConfigError("experiments: got none, want at least one name; `gvz experiment list` shows them")
        found = []
        for name, scenarios in self.asked.items():
            full = experiment_named(name)
            experiment = scaled(full, self.scale)
            if scenarios is not None:
                chosen = tuple(s for s in full.scenarios if s in scenarios)
                if not chosen:
                    raise ConfigError(
                        f"--scenario: got {', '.join(scenarios)}, but {name} has {', '.join(full.scenarios)}"
                    )
                experiment = dataclasses.replace(experiment, scenarios=chosen)
            found.append(experiment)
        return tuple(found)

    def runs(self) -> tuple[TrainingRun, ...]:
        """Every run of every experiment, each once.

        Raises:
            ConfigError: two experiments want different runs of one id.
        """
        runs: dict[str, TrainingRun] = {}
        for experiment in self.experiments():
            for run in experiment.runs():
                if runs.setdefault(run.id, run) != run:
                    raise ConfigError(
                        f"experiment {experiment.name}: run {run.id} is to have {run.total_updates} gradient steps and "
                        f"{run.num_checkpoints} checkpoints, another experiment gives it "
                        f"{runs[run.id].total_updates} and {runs[run.id].num_checkpoints}, or they differ in the "
                        "settings of a variant or in max_processor_s; run them in results directories of their own"
                    )
        return tuple(runs.values())

    def evaluations(self) -> dict[str, Evaluation]:
        """Run id -> the evaluation episodes of all its experiments."""
        return self._evaluations(lambda _, run: (run.id,))

    def players(self) -> dict[SimplePlayerName, Evaluation]:
        """Simple player -> the episodes that it plays: those of all runs of its experiments."""
        return self._evaluations(lambda experiment, _: experiment.players)

    def _evaluations(self, who: Callable[[Experiment, TrainingRun], tuple[str, ...]]) -> dict[str, Evaluation]:
        """Who plays the episodes of a run in an experiment -> all its episodes."""
        found: dict[str, Evaluation] = {}
        for experiment in self.experiments():
            for run in experiment.runs():
                for name in who(experiment, run):
                    before = found.get(name, Evaluation())
                    found[name] = before.joined(experiment.evaluation_tasks(run), experiment.episodes)
        return found

    def joined(self, other: "Plan") -> "Plan":
        """Both plans as one.

        Raises:
            ConfigError: they differ in scale.
        """
        if self.scale != other.scale:
            raise ConfigError(
                f"--scale: got {other.scale:g}, but the results there have {self.scale:g}, and scales cannot be mixed; "
                "give the same, or another --results"
            )
        both, mine = dict(self.asked), {experiment.name: experiment.scenarios for experiment in self.experiments()}
        for experiment in other.experiments():
            name, new = experiment.name, other.asked[experiment.name]
            before = both.setdefault(name, new)
            if before == new:
                continue
            if None in (before, new) and self.scale >= CHECK_BELOW:
                both[name] = None
            else:  # at a smaller scale, None is the first scenario alone
                both[name] = tuple(dict.fromkeys((*mine.get(name, ()), *experiment.scenarios)))
        return Plan(asked=both, scale=self.scale)


def read_plan(results: Path) -> Plan | None:
    """The plan of a results directory; None if there is none.

    Raises:
        ConfigError: plan.json is damaged or of another schema.
    """
    file = results / "plan.json"
    if not file.exists():
        return None
    try:
        saved = json.loads(file.read_text())
        if saved["schema"] != PLAN_SCHEMA:
            raise ConfigError(f"schema {saved['schema']}, want {PLAN_SCHEMA}")
        asked = dict(saved["experiments"])
        return Plan(
            asked={name: None if scenarios is None else tuple(scenarios) for name, scenarios in asked.items()},
            scale=saved["scale"],
        )
    except (ConfigError, TaskError) as error:
        raise ConfigError(f"{file}: {error}; mend it there, or move the file aside") from error
    except (ValueError, KeyError, TypeError, OSError, RecursionError) as error:
        raise ConfigError(f"{file} cannot be read: {error!r}; move it aside to make a new plan") from error


def write_plan(results: Path, plan: Plan) -> Plan:
    """Adds a plan to the one that the directory has.

    Commands that start at once with one directory wait for each other here, so that none takes the other's away.

    Returns: both as one.

    Raises:
        ConfigError: the scales differ, or the directory cannot be written.
    """
    try:
        results.mkdir(parents=True, exist_ok=True)
        with (results / ".plan.lock").open("ab") as lock:
            records.lock(lock, wait=True)
            before = read_plan(results)
            both = plan if before is None else before.joined(plan)
            saved = {"schema": PLAN_SCHEMA, "scale": both.scale, "experiments": both.asked}
            with written_whole(results / "plan.json") as writing:
                writing.write_text(json.dumps(saved, indent=2) + "\n")
    except OSError as error:
        raise ConfigError(f"--results: {results} cannot be written: {error.strerror}") from error
    return both


def parse_shard(text: str) -> tuple[int, int]:
    """ "2/3" -> (2, 3).

    Raises:
        ConfigError: not of that form, or outside 1..n.
    """
    match = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text)
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise ConfigError(f"--shard: got {text!r}, want i/n with i from 1 to n, for example 2/3")
    return int(match[1]), int(match[2])


def shard(items: Sequence[Item], index: int, count: int) -> tuple[Item, ...]:
    """Part `index` (1 .. count) of the items: every count-th, so that the parts are of about one size."""
    return tuple(items[index - 1 :: count])
