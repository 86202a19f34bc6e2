"""`gvz evaluate`: plays evaluation episodes and prints the scores."""

import dataclasses
import json
import os
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from gvz.core.env_config import EnvConfig, Profile, SimplePlayer
from gvz.core.errors import ConfigError
from gvz.evaluation.selection import ALL_TASKS, TaskSelection
from gvz.scenarios.base import Task

if TYPE_CHECKING:
    from gvz.evaluation.episode_log import RecordFile
    from gvz.evaluation.play import PlayerSpec, Row

EXIT_INTERRUPTED = 130
LINE_PERIOD_S = 10.0
"""seconds between lines of progress when the output is not a terminal"""


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Play evaluation episodes and append a row for each to a record file.

    Episode n of a task has the same seed for every player. The same command goes on where it was stopped.

    Examples: gvz evaluate runs/rainbow_4task/seed_1111 --checkpoints last5 --split test
              gvz evaluate --player random --scenario seek_and_kill
    """

    run_dirs: Annotated[
        tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="[RUN_DIR ...]", help_behavior_hint="")
    ] = ()
    """run directories: their policies play greedily, noise off; by default the test tasks of their scenario"""
    player: SimplePlayer | None = None
    """random: uniformly random buttons; idle: presses nothing; sweep: a fixed sequence of buttons; scripted: the
    scenario's simple script, which is told what is in sight"""
    agent: Path | None = None
    """the Python file of the run's agent, if it is in a file of its own: playing executes it"""
    checkpoints: tuple[str, ...] = ("newest",)
    """which of a run's policies: newest, all, last5 (or another number), or numbers of gradient steps"""
    select: Annotated[TaskSelection, tyro.conf.arg(name="")] = ALL_TASKS
    episodes: int = 100
    """episodes of each task"""
    seeds: tuple[int, ...] = (0,)
    """base seeds: each draws episodes of its own. 0 is the set that all published scores are of"""
    out: Path | None = None
    """record file, JSON lines; default evaluation.jsonl, in the run directory if there is one"""
    profile: Profile = "thesis"
    """rules of the tasks (a run keeps the rules it was trained by)"""
    workers: int | None = None
    """processes; default one per CPU core"""
    json: bool = False
    """print the scores as JSON, an object a line, instead of a table"""

    def run(self) -> int:
        """Plays what the record files do not hold yet, with a progress bar, and prints the scores."""
        workers = len(os.sched_getaffinity(0)) if self.workers is None else self.workers
        self._check(workers)
        from gvz.evaluation.episode_log import missing_jobs, play_and_record, wanted_episodes

        player_specs = self._player_specs()
        files: dict[Path, RecordFile] = {}
        handler = signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C
        try:
            held = {player_spec: _open(files, out) for player_spec, (_, out) in player_specs.items()}
            jobs = []
            for player_spec, (tasks, _) in player_specs.items():
                wanted = wanted_episodes(tasks, self.episodes, self.seeds)
                jobs += missing_jobs({player_spec: held[player_spec]}, wanted)
            _show_progress(play_and_record(held, jobs, num_workers=workers), len(jobs))
            for player_spec, (tasks, _) in player_specs.items():
                self._print_scores(player_spec, tasks, held[player_spec].rows)
        except KeyboardInterrupt:
            print("interrupted; the same command goes on from here", file=sys.stderr)
            return EXIT_INTERRUPTED
        finally:
            signal.signal(signal.SIGTERM, handler)
            for file in files.values():
                file.close()
        return 0

    def _check(self, workers: int) -> None:
        if (self.player is None) == (not self.run_dirs):
            raise ConfigError("evaluate: want run directories or --player")
        for name, value in (("episodes", self.episodes), ("workers", workers)):
            if value < 1:
                raise ConfigError(f"--{name}: got {value}, want at least 1")
        if any(seed < 0 for seed in self.seeds) or not self.seeds:
            raise ConfigError(f"--seeds: got {list(self.seeds)}, want numbers of at least 0")

    def _player_specs(self) -> "dict[PlayerSpec, tuple[tuple[Task, ...], Path]]":
        """Who plays -> what, and the record file."""
        from gvz.evaluation.episode_log import simple_player
        from gvz.evaluation.trained import check_tasks, find_checkpoints, read_run_config, trained_player

        if self.player is not None:
            out = Path("evaluation.jsonl") if self.out is None else self.out
            return {simple_player(self.player, EnvConfig(profile=self.profile)): (self.select.resolve(), out)}
        found = {}
        for run_dir in dict.fromkeys(self.run_dirs):
            config = read_run_config(run_dir, self.agent)
            tasks = run_tasks(self.select, config.resolved_scenario().id)
            check_tasks(config, tasks)
            out = run_dir / "evaluation.jsonl" if self.out is None else self.out
            for num_updates in find_checkpoints(run_dir, self.checkpoints):
                found[trained_player(run_dir, config, num_updates)] = (tasks, out)
        return found

    def _print_scores(self, player_spec: "PlayerSpec", tasks: Sequence[Task], rows: "Sequence[Row]") -> None:
        from gvz.evaluation.table import score_lines, score_row, scores

        player = player_spec.identity["player"]
        for base_seed in self.seeds:
            chosen = [row for row in rows if row.get("base_seed", 0) == base_seed]
            found = scores(chosen, player_spec.identity, tasks, self.episodes)
            if self.json:
                for one in found:
                    print(json.dumps({"player": player, "base_seed": base_seed, **score_row(one)}))
            else:
                print(player + (f", base seed {base_seed}" if base_seed else ""))
                print("\n".join(score_lines(found)))


COMMAND = Evaluate


def run_tasks(select: TaskSelection, scenario: str) -> tuple[Task, ...]:
    """The tasks a run is evaluated on: as selected, of its own scenario if none is said; else its test set."""
    if select == ALL_TASKS:
        select = TaskSelection(split="test")
    if not select.tasks and select.scenario is None:
        select = dataclasses.replace(select, scenario=scenario)
    return select.resolve()


def _open(files: "dict[Path, RecordFile]", path: Path) -> "RecordFile":
    """The record file at `path`, opened once."""
    from gvz.evaluation.episode_log import RecordFile

    if path not in files:
        files[path] = RecordFile(path)
    return files[path]


def _show_progress(rows: "Iterator[Row]", total: int) -> None:
    """Draws the rows as they come, on stderr: a bar with rate and time left, or now and then a line."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
    from rich.table import Column

    from gvz.run.progress import format_duration

    console = Console(stderr=True)
    columns = (
        *(BarColumn(20), MofNCompleteColumn(), TextColumn("{task.fields[rate]}"), TimeRemainingColumn()),
        TextColumn("{task.description}", table_column=Column(overflow="fold")),  # long: it may take two lines
    )
    first_s = next_line_s = 0.0
    with Progress(*columns, console=console, disable=not console.is_terminal, speed_estimate_period=300) as bar:
        shown = bar.add_task("", total=total, rate="")
        for done, row in enumerate(rows, 1):
            now_s = time.monotonic()
            first_s = now_s if done == 1 else first_s
            per_s = (done - 1) / (now_s - first_s) if done > 1 else 0.0  # the start of the workers left out
            rate, name = f"{per_s:.2f} episodes/s", f"{row['player']}  {row['task']}"
            bar.update(shown, advance=1, description=name, rate=rate)
            if not console.is_terminal and (now_s >= next_line_s or done == total):
                left = format_duration((total - done) / per_s if per_s else None)
                print(f"{done}/{total}  {rate}  eta {left}  {name}", file=sys.stderr, flush=True)
                next_line_s = now_s + LINE_PERIOD_S
