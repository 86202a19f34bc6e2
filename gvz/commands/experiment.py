"""`gvz experiment list | plan | run | status`: the experiments of gvz/experiments."""

import dataclasses
import json
import os
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from gvz.core.errors import ConfigError

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from gvz.experiments.costs import Cost
    from gvz.experiments.jobs import Job, Slot
    from gvz.experiments.plan import Plan
    from gvz.experiments.rates import Rates

DEFAULT_RESULTS = Path("runs/experiments")


@dataclass(frozen=True, kw_only=True)
class List:
    """List the experiments: what they ask, how many runs they have."""

    json: bool = False
    """one JSON object a line instead of text"""

    def run(self) -> int:
        """Prints them."""
        from gvz.experiments.base import experiments

        for experiment in experiments().values():
            runs = experiment.runs()
            if self.json:
                names = ("name", "title", "question", "source", "configs", "scenarios", "trainings", "seeds")
                row = {name: getattr(experiment, name) for name in names}
                print(json.dumps({**row, "runs": len(runs), "total_updates": experiment.total_updates}))
                continue
            print(f"{experiment.name}: {experiment.question}")
            print(f"    {experiment.source}")
            grid = (experiment.configs, experiment.scenarios, experiment.trainings, map(str, experiment.seeds))
            cells = " x ".join(", ".join(values) for values in grid)
            print(f"    {len(runs)} runs of {experiment.total_updates:,} gradient steps: {cells}")
        return 0


@dataclass(frozen=True, kw_only=True)
class PlanFlags:
    """What is asked for."""

    names: Annotated[
        tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="NAME ...", help_behavior_hint="")
    ] = ()
    """experiments; gvz experiment list shows them"""
    results: Path = DEFAULT_RESULTS
    """results directory: runs/ players/ logs/ plan.json"""
    scale: float = 1.0
    """less than 1 shrinks budgets, episodes and seeds; below 0.01 the grid is thinned too: a check of the pipeline"""
    scenario: tuple[str, ...] = ()
    """only these scenarios of each experiment"""
    shard: str = "1/1"
    """i/n: only every n-th run, from the i-th; n commands with the same results directory do all"""
    jobs: int | None = None
    """jobs at once; default one a GPU, or one a pair of cores without a GPU"""

    def plan(self) -> "Plan":
        """Raises ConfigError for anything that cannot be run."""
        from gvz.experiments.plan import Plan

        return Plan(names=self.names, scale=self.scale, scenarios=self.scenario or None)

    def slots(self) -> "tuple[Slot, ...]":
        """The machine's shares."""
        from gvz.experiments.schedule import gpus, make_slots

        return make_slots(self.jobs, sorted(os.sched_getaffinity(0)), gpus())


@dataclass(frozen=True, kw_only=True)
class PlanCommand:
    """Print the runs of experiments: gradient steps, environment steps, evaluation episodes, hours.

    Hours are by rates measured on this machine, once for each config: some minutes the first time.
    """

    ask: Annotated[PlanFlags, tyro.conf.arg(name="")] = PlanFlags()
    measure: bool = False
    """measure the rates again"""
    json: bool = False
    """one JSON object a line for each run of the shard, instead of tables"""

    def run(self) -> int:
        """Measures what is not known yet, then prints."""
        from gvz.experiments.costs import Cost, run_cost
        from gvz.experiments.plan import parse_shard, shard

        plan, slots = self.ask.plan(), self.ask.slots()
        index, count = parse_shard(self.ask.shard)
        try:
            rates = _rates(plan, slots[0], again=self.measure)
        except KeyboardInterrupt:
            print("interrupted; nothing was remembered of the rate that was being measured", file=sys.stderr)
            return 130
        evaluations = plan.evaluations()
        costs = {run.id: run_cost(run, evaluations[run.id], plan.scale, rates[run.config]) for run in plan.runs()}
        mine = shard(plan.runs(), index, count)
        if self.json:
            for run in mine:
                names = [e.name for e in plan.experiments() if run in e.runs()]
                print(json.dumps({"run": run.id, "experiments": names, **dataclasses.asdict(costs[run.id])}))
            return 0
        rows = [(run.id, costs[run.id]) for run in mine]
        _print_costs([*rows, (f"{len(mine)} runs", sum((cost for _, cost in rows), Cost()))])
        print()
        of_experiments = [
            (f"{e.name}: {len(e.runs())} runs", sum((costs[run.id] for run in e.runs()), Cost()))
            for e in plan.experiments()
        ]
        together = f"together, shared runs once: {len(plan.runs())} runs"
        _print_costs([*of_experiments, (together, sum(costs.values(), Cost()))])
        hours = sum(cost.hours for _, cost in rows) / len(slots)
        print(f"\nshard {index}/{count}, {len(slots)} jobs at once on this machine: {hours:.2f} hours at most")
        for config, found in rates.items():
            print(
                f"{config}: {found.updates_per_s:.2f} updates/s, {found.evaluation_steps_per_s:.0f} evaluation "
                f"decisions/s, one job on {len(slots[0].cores)} cores (measured {found.measured})"
            )
        return 0


@dataclass(frozen=True, kw_only=True)
class RunCommand:
    """Run experiments: train, evaluate, and let the simple players play. The same command goes on where it was stopped.

    Example: gvz experiment run training_set_size rainbow_evaluation --results results --shard 1/4
    """

    ask: Annotated[PlanFlags, tyro.conf.arg(name="")] = PlanFlags()

    def run(self) -> int:
        """0 all done, 1 some failed, 130 or 143 stopped."""
        from gvz.experiments.plan import parse_shard, write_plan
        from gvz.experiments.schedule import run_jobs

        plan, slots = self.ask.plan(), self.ask.slots()
        index, count = parse_shard(self.ask.shard)
        _check_flags(plan)
        write_plan(self.ask.results, plan)
        return run_jobs(_jobs(plan, self.ask.results, index, count), slots)


@dataclass(frozen=True, kw_only=True)
class Status:
    """Print how far each run is, and why one failed. Exit code 1 if one has."""

    results: Path = DEFAULT_RESULTS
    """results directory"""
    shard: str = "1/1"
    """i/n: only the jobs of this shard"""
    json: bool = False
    """one JSON object a line for each job, instead of text"""

    def run(self) -> int:
        """Reads logs and records."""
        from gvz.experiments import inventory as progress
        from gvz.experiments.plan import parse_shard, read_plan

        plan = read_plan(self.results)
        if plan is None:
            raise ConfigError(f"--results: {self.results} has no plan.json; gvz experiment run writes one")
        states: Counter[str] = Counter()
        for job in _jobs(plan, self.results, *parse_shard(self.shard)):
            outlook = job.outlook()
            state = progress.job_state(self.results, job.id, done=outlook.next is None, begun=outlook.begun)
            states[state] += 1
            log = progress.log_file(self.results, job.id)
            if self.json:
                print(json.dumps({"job": job.id, "state": state, "progress": outlook.text, "log": str(log)}))
                continue
            print(f"{state:8} {job.id}: {outlook.text}")
            if state == "failed":
                print("\n".join([f"{'':8}     {log}", *(f"{'':8}     {line}" for line in progress.last_words(log))]))
        if not self.json:
            print(f"{', '.join(plan.names)}, scale {plan.scale:g}: {', '.join(f'{n} {s}' for s, n in states.items())}")
        return 1 if states["failed"] else 0


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """List, plan and run the experiments, or see how far they are."""

    action: Annotated[
        Annotated[List, tyro.conf.subcommand("list")]
        | Annotated[PlanCommand, tyro.conf.subcommand("plan")]
        | Annotated[RunCommand, tyro.conf.subcommand("run")]
        | Annotated[Status, tyro.conf.subcommand("status")],
        tyro.conf.arg(name=""),
    ]

    def run(self) -> int:
        """Runs the action; returns its exit code."""
        return self.action.run()


COMMAND = Experiment


def _jobs(plan: "Plan", results: Path, index: int, count: int) -> "tuple[Job, ...]":
    """The shard's runs, then its players."""
    from gvz.experiments.jobs import PlayerJob, RunJob
    from gvz.experiments.plan import shard

    evaluations = plan.evaluations()
    runs = [RunJob(results=results, run=r, evaluation=evaluations[r.id], scale=plan.scale) for r in plan.runs()]
    players = [PlayerJob(results=results, player=p, evaluation=e) for p, e in plan.players().items()]
    return (*shard(runs, index, count), *shard(players, index, count))


def _check_flags(plan: "Plan") -> None:
    """Says what is wrong with the trainer's flags now, not in every job's log."""
    from gvz.experiments.jobs import training_flags
    from gvz.launch import parse

    for run in {run.config: run for run in plan.runs()}.values():
        parse(training_flags(run, plan.scale))


def _rates(plan: "Plan", slot: "Slot", *, again: bool) -> "dict[str, Rates]":
    """Config -> its rates in a slot like this one, measured if they are not known."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    from gvz.experiments.rates import MEASURE_S, measure, rates_file, read_rates

    console = Console(file=sys.stderr)
    rates: dict[str, Rates] = {}
    for config, run in {run.config: run for run in reversed(plan.runs())}.items():
        known = None if again else read_rates(rates_file(config, plan.scale, slot))
        if known is None:
            console.print(f"measuring {config} on this machine, once; --measure does it again", highlight=False)
            with Progress(TextColumn("{task.description}"), BarColumn(), console=console, transient=True) as bar:
                task = bar.add_task(config, total=MEASURE_S)
                known = measure(run, plan.scale, slot, partial(_show_rate, bar, task))
        rates[config] = known
    return rates


def _show_rate(bar: "Progress", task: "TaskID", text: str, seconds: float) -> None:
    bar.update(task, description=text, completed=seconds)


def _print_costs(rows: "Sequence[tuple[str, Cost]]") -> None:
    """A line each, numbers in columns."""
    width = max(len(name) for name, _ in rows)
    head = ("gradient steps", "environment steps", "episodes", "hours at most")
    print(f"{'':{width}}  {'  '.join(head)}")
    for name, cost in rows:
        cells = (f"{cost.updates:,}", f"{cost.env_steps:,}", f"{cost.episodes:,}", f"{cost.hours:.2f}")
        print(f"{name:{width}}  {'  '.join(cell.rjust(len(h)) for cell, h in zip(cells, head, strict=True))}")
