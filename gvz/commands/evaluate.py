"""`gvz evaluate`: plays evaluation episodes and prints the scores. Imports gvz.{selection,specs,tasks}; what plays only
once it runs.
"""

import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from gvz.errors import ConfigError
from gvz.scenarios.base import Task
from gvz.selection import ALL_TASKS, TaskSelection
from gvz.specs import EnvConfig, Profile
from gvz.tasks import named_tasks

if TYPE_CHECKING:
    from gvz.evaluation.play import Row

EXIT_INTERRUPTED = 130


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Play evaluation episodes and append a row for each to a record file.

    Episode n of a task has the same seed for every player. The same command goes on where it was stopped.

    Examples: gvz evaluate --player random --scenario seek_and_kill
              gvz evaluate runs/rainbow_4task/seed_1111 --checkpoint newest --split test
    """

    player: Literal["random", "idle", "scripted"] | None = None
    """random: uniformly random buttons; idle: presses nothing; scripted: the scenario's simple script"""
    run_dir: tyro.conf.Positional[Path | None] = None
    """a run directory: its policy plays greedily, noise off; by default the test tasks of its scenario"""
    checkpoint: str = "newest"
    """gradient steps of one of the run's policies, or newest"""
    select: Annotated[TaskSelection, tyro.conf.arg(name="")] = ALL_TASKS
    episodes: int = 100
    """episodes of each task"""
    out: Path | None = None
    """record file, JSON lines; default evaluation.jsonl, in the run directory if there is one"""
    profile: Profile = "thesis"
    """rules of the tasks (a run keeps the rules it was trained by)"""
    workers: int | None = None
    """processes; default one per CPU core"""

    def run(self) -> int:
        """Plays what the record file does not hold yet, with a progress bar, and prints the scores."""
        from gvz.evaluation.players import PlayerSpec, player_env
        from gvz.evaluation.record import RecordFile, missing_jobs, play_and_record, row_identity
        from gvz.evaluation.table import score_lines

        if (self.player is None) == (self.run_dir is None):
            raise ConfigError("evaluate: want a run directory or --player")
        if self.episodes < 1:
            raise ConfigError(f"--episodes: got {self.episodes}, want at least 1")
        workers = len(os.sched_getaffinity(0)) if self.workers is None else self.workers
        if workers < 1:
            raise ConfigError(f"--workers: got {workers}, want at least 1")
        if self.run_dir is None:
            assert self.player is not None
            tasks = self.select.resolve()
            spec, names = PlayerSpec(kind=self.player), {"player": self.player}
            env = player_env(self.player, EnvConfig(profile=self.profile))
            out = Path("evaluation.jsonl")
        else:
            from gvz.evaluation.trained import check_tasks, read_run_config, read_trained_player

            config = read_run_config(self.run_dir)
            tasks = _run_tasks(self.select, config.resolved_scenario().id)
            check_tasks(config, tasks)
            trained = read_trained_player(self.run_dir, config, _checkpoint(self.checkpoint))
            spec, names, env = trained.spec, trained.identity, config.env
            out = self.run_dir / "evaluation.jsonl"
        file = RecordFile(out if self.out is None else self.out)
        identity = row_identity(names, env)
        jobs = missing_jobs(file.rows, identity, tasks, self.episodes)
        try:
            _show_progress(play_and_record(file, jobs, identity, spec, env, workers), len(jobs), names["player"])
        except KeyboardInterrupt:
            print("interrupted; the same command goes on from here", file=sys.stderr)
            return EXIT_INTERRUPTED
        finally:
            file.close()
        print("\n".join(score_lines(file.rows, identity, tasks, self.episodes)))
        return 0


COMMAND = Evaluate


def _run_tasks(select: TaskSelection, scenario: str) -> tuple[Task, ...]:
    """The tasks a run is evaluated on: as selected, else the test set of its scenario."""
    if select == ALL_TASKS:
        return named_tasks(scenario, split="test")
    if select.tasks or select.scenario is not None:
        return select.resolve()
    return named_tasks(scenario, split=select.split)


def _checkpoint(text: str) -> int | Literal["newest"]:
    if text == "newest":
        return "newest"
    if not text.isdecimal():
        raise ConfigError(f"--checkpoint: got {text!r}, want newest or a number of gradient steps")
    return int(text)


def _show_progress(rows: "Iterator[Row]", total: int, name: str) -> None:
    """Draws the rows as they come, on stderr."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as bar:
        shown = bar.add_task(name, total=total)
        for row in rows:
            bar.update(shown, advance=1, description=f"{name}  {row['task']}")
