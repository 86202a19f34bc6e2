"""`gvz experiment list | plan | run | status`: the experiments of gvz/experiments."""

import dataclasses
import heapq
import json
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from gvz.core.control_groups import some_cores
from gvz.core.errors import ConfigError

if TYPE_CHECKING:
    from gvz.experiments.costs import Cost
    from gvz.experiments.jobs import Job
    from gvz.experiments.places import Places, Slot
    from gvz.experiments.plan import Plan

DEFAULT_RESULTS = Path("runs/experiments")


@dataclass(frozen=True, kw_only=True)
class List:
    """List the experiments: their questions and numbers of runs."""

    json: bool = False
    """one JSON object a line instead of text"""

    def run(self) -> int:
        """Prints them."""
        from gvz.experiments.base import experiments

        for experiment in experiments().values():
            runs = experiment.runs()
            if self.json:
                fields = "name title question source configs scenarios trainings seeds total_updates max_processor_s"
                row = {name: getattr(experiment, name) for name in fields.split()}
                print(json.dumps({**row, "variants": dict(experiment.variants), "runs": len(runs)}))
                continue
            print(f"{experiment.name}: {experiment.question}")
            print(f"    {experiment.source}")
            grid = (experiment.agents, experiment.scenarios, experiment.trainings, map(str, experiment.seeds))
            cells = " x ".join(", ".join(values) for values in grid)
            print(f"    {len(runs)} runs of {experiment.budget}: {cells}")
        return 0


@dataclass(frozen=True, kw_only=True)
class PlanFlags:
    """The flags of a plan."""

    names: Annotated[
        tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="NAME ...", help_behavior_hint="")
    ] = ()
    """experiments; gvz experiment list shows them"""
    results: Path = DEFAULT_RESULTS
    """results directory: runs/ players/ logs/ plan.json"""
    scale: float = 1.0
    """less than 1 shrinks budgets, episodes and seeds; less than 0.01 only checks the pipeline, with few runs"""
    scenario: tuple[str, ...] = ()
    """only these scenarios of each experiment"""
    shard: str = "1/1"
    """i/n: only every n-th run, from the i-th; n such commands with one results directory do all runs"""
    jobs: int | None = None
    """jobs at once; default one a GPU, or one a pair of cores without a GPU"""

    def plan(self) -> "Plan":
        """Raises ConfigError for anything that cannot be run."""
        from gvz.experiments.plan import Plan

        return Plan.of(*self.names, scale=self.scale, scenarios=self.scenario or None)

    def slots(self) -> "tuple[Slot, ...]":
        """The machine's shares."""
        from gvz.experiments.places import gpus, make_slots

        return make_slots(self.jobs, some_cores(), gpus())


@dataclass(frozen=True, kw_only=True)
class PlanCommand:
    """Print the runs of experiments: gradient steps, environment steps, evaluation episodes, hours.

    Hours are by the records of runs on this machine; a config that has not run here yet has none.
    """

    ask: Annotated[PlanFlags, tyro.conf.arg(name="")] = PlanFlags()
    json: bool = False
    """one JSON object a line for each run of the shard, instead of tables"""

    def run(self) -> int:
        """Prints the plan."""
        from gvz.experiments.costs import Cost, read_rates, run_cost
        from gvz.experiments.plan import parse_shard, shard

        plan, slots = self.ask.plan(), self.ask.slots()
        index, count = parse_shard(self.ask.shard)
        cores = len(slots[0].cores)
        agents = sorted({run.agent for run in plan.runs()})
        rates = {agent: read_rates(self.ask.results, agent, plan.scale, cores) for agent in agents}
        evaluations = plan.evaluations()
        costs = {run.id: run_cost(run, evaluations[run.id], plan.scale, rates[run.agent], cores) for run in plan.runs()}
        mine = shard(plan.runs(), index, count)
        if self.json:
            for run in mine:
                names = [e.name for e in plan.experiments() if run in e.runs()]
                print(json.dumps({"run": run.id, "experiments": names, **dataclasses.asdict(costs[run.id])}))
            return 0
        whole = sum((costs[run.id] for run in mine), Cost())
        _print_costs([*((run.id, costs[run.id]) for run in mine), (f"{len(mine)} runs", whole)])
        print()
        of_experiments = [
            (f"{e.name}: {len(e.runs())} runs", sum((costs[run.id] for run in e.runs()), Cost()))
            for e in plan.experiments()
        ]
        together = f"together, shared runs once: {len(plan.runs())} runs"
        _print_costs([*of_experiments, (together, sum(costs.values(), Cost()))])
        jobs = f"shard {index}/{count}, {len(slots)} {'job' if len(slots) == 1 else 'jobs'} at once on this machine"
        if whole.training_hours is None or whole.evaluation_hours is None:
            print(f"\n{jobs}: hours are not known yet; begin with gvz experiment run, and ask again after a while")
        else:
            hours = [(costs[run.id].training_hours or 0) + (costs[run.id].evaluation_hours or 0) for run in mine]
            how = "about" if any(run.max_processor_s is not None for run in mine) else "at most"
            print(f"\n{jobs}: {how} {_side_by_side(hours, len(slots)):.2f} hours")
        for agent, found in rates.items():
            trained, played = (_text(rate) for rate in (found.updates_per_s, found.evaluation_steps_per_s))
            print(f"{agent}: {trained} updates/s, {played} evaluation decisions/s, one job on {cores} cores")
        return 0


@dataclass(frozen=True, kw_only=True)
class RunCommand:
    """Run experiments: train, evaluate, play with the simple players. The same command resumes what was stopped.

    Example: gvz experiment run training_set_size rainbow_evaluation --results runs/thesis --shard 1/4
    """

    ask: Annotated[PlanFlags, tyro.conf.arg(name="")] = PlanFlags()
    cluster: str | None = None
    """HOST:PORT of a Ray cluster (docs/CLUSTER.md) whose nodes run the jobs; they all see the results directory"""
    cluster_public: bool = False
    """its nodes may have public addresses; whoever reaches them and has the token runs code there"""
    job_cores: int | None = None
    """of a node of the cluster, for a job; default 2"""
    job_gpus: float | None = None
    """likewise, while it trains: a part of a GPU (0.5), or whole ones; default one if a node of the cluster has any"""

    def run(self) -> int:
        """0 all done, 1 some failed, 130, 143 or 129 stopped."""
        from gvz.experiments.places import Machine
        from gvz.experiments.plan import parse_shard

        plan = self.ask.plan()
        shard = parse_shard(self.ask.shard)
        _check_flags(plan)
        if self.cluster is None:
            if self.job_cores is not None or self.job_gpus is not None:
                raise ConfigError(
                    "--job-cores and --job-gpus are for a cluster (--cluster); here --jobs divides the cores"
                )
            return _run(plan, self.ask.results, shard, Machine(self.ask.slots()))
        from gvz.cluster.ray_jobs import open_places

        results = self.ask.results.resolve()  # every node has working directories of its own
        share = (2 if self.job_cores is None else self.job_cores, self.job_gpus, self.ask.jobs)
        with open_places(self.cluster, results, *share, public=self.cluster_public) as places:
            return _run(plan, results, shard, places)


@dataclass(frozen=True, kw_only=True)
class Status:
    """Print the progress of each run, and why runs failed. Exit code 1 if one has failed."""

    results: Path = DEFAULT_RESULTS
    """results directory"""
    shard: str = "1/1"
    """i/n: only the jobs of this shard. All experiments of the directory are divided together, also those that a `run`
    did not name"""
    json: bool = False
    """one JSON object a line for each job, instead of text"""

    def run(self) -> int:
        """Reads logs and records."""
        from gvz.experiments import inventory
        from gvz.experiments.plan import parse_shard, read_plan

        plan = read_plan(self.results)
        if plan is None:
            raise ConfigError(f"--results: {self.results} has no plan.json; gvz experiment run writes one")
        states: Counter[str] = Counter()
        for job in _jobs(plan, self.results, *parse_shard(self.shard)):
            outlook = job.outlook()
            state = inventory.job_state(self.results, job.id, done=outlook.next is None, begun=outlook.begun)
            states[state] += 1
            log = inventory.log_file(self.results, job.id)
            if self.json:
                print(json.dumps({"job": job.id, "state": state, "progress": outlook.text, "log": str(log)}))
                continue
            print(f"{state:8} {job.id}: {outlook.text}")
            if state == "failed":
                print("\n".join([f"{'':8}     {log}", *(f"{'':8}     {line}" for line in inventory.last_words(log))]))
        if not self.json:
            print(f"{', '.join(plan.asked)}, scale {plan.scale:g}: {', '.join(f'{n} {s}' for s, n in states.items())}")
        return 1 if states["failed"] else 0


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """List, plan and run the experiments, or print their progress."""

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


def _run(plan: "Plan", results: Path, shard: tuple[int, int], places: "Places") -> int:
    """Notes the plan and runs the jobs of a shard; returns the exit code."""
    from gvz.experiments.plan import write_plan
    from gvz.experiments.schedule import run_jobs

    write_plan(results, plan)
    jobs = _jobs(plan, results, *shard)
    _warn_of_other_settings(jobs)
    return run_jobs(jobs, places)


def _warn_of_other_settings(jobs: "Sequence[Job]") -> None:
    """Names runs that are trained and were made with other settings; one that is not is refused when it goes on."""
    from gvz.experiments.jobs import RunJob

    for job in jobs:
        if isinstance(job, RunJob) and (changed := job.other_settings()):
            print(
                f"warning: {job.id} was trained with other settings and stays as it is ({'; '.join(changed)}). "
                "To train it again, move its directory aside",
                file=sys.stderr,
            )


def _side_by_side(hours: Sequence[float], num_slots: int) -> float:
    """Hours until all jobs are done: the next one begins where a slot is free first."""
    ends = [0.0] * num_slots
    for of_job in hours:
        heapq.heapreplace(ends, ends[0] + of_job)
    return max(ends)


def _jobs(plan: "Plan", results: Path, index: int, count: int) -> "tuple[Job, ...]":
    """The shard's runs, then its players."""
    from gvz.experiments.jobs import PlayerJob, RunJob
    from gvz.experiments.plan import shard

    evaluations = plan.evaluations()
    runs = [RunJob(results=results, run=r, evaluation=evaluations[r.id], scale=plan.scale) for r in plan.runs()]
    players = [PlayerJob(results=results, player=p, evaluation=e) for p, e in plan.players().items()]
    return (*shard(runs, index, count), *shard(players, index, count))


def _check_flags(plan: "Plan") -> None:
    """Raises ConfigError for bad flags of the trainer here, before every job fails with them."""
    from gvz.experiments.jobs import training_flags
    from gvz.launch import parse

    for run in {run.agent: run for run in plan.runs()}.values():
        parse(training_flags(run, plan.scale))


def _text(number: float | None) -> str:
    return "-" if number is None else f"{number:.2f}"


def _print_costs(rows: "Sequence[tuple[str, Cost]]") -> None:
    """A line each, numbers in columns."""
    width = max(len(name) for name, _ in rows)
    head = ("gradient steps", "environment steps", "episodes", "training hours", "evaluation hours at most")
    print(f"{'':{width}}  {'  '.join(head)}")
    for name, cost in rows:
        counts = (f"{cost.updates:,}", f"{cost.env_steps:,}", f"{cost.episodes:,}")
        cells = (*counts, _text(cost.training_hours), _text(cost.evaluation_hours))
        print(f"{name:{width}}  {'  '.join(cell.rjust(len(h)) for cell, h in zip(cells, head, strict=True))}")
