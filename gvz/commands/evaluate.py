"""`gvz evaluate`: plays evaluation episodes and prints the scores."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from gvz.core.control_groups import num_cores
from gvz.core.env_config import EnvConfig, Profile
from gvz.core.errors import EXIT_INTERRUPTED, ConfigError
from gvz.core.registry import NO_OWN_FILES, OwnFiles
from gvz.core.stop import StopRequest, say
from gvz.evaluation.selection import ALL_TASKS, TaskSelection
from gvz.evaluation.simple import SimplePlayerName
from gvz.run.rundir import EVALUATION_RECORDS
from gvz.scenarios.base import Task

if TYPE_CHECKING:
    from gvz.evaluation.play import PlayerSpec, Row

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
    """run directories, or zoo:NAME (see gvz zoo): their policies play greedily, noise off; by default
    the test tasks of their scenarios"""
    player: SimplePlayerName | None = None
    """random: uniformly random buttons; idle: presses nothing; sweep: a fixed sequence of buttons; scripted: the
    scenario's simple script, which gets names and places of what is in sight"""
    own_files: Annotated[OwnFiles, tyro.conf.arg(name="")] = NO_OWN_FILES
    checkpoints: tuple[str, ...] = ("newest",)
    """which of a run's policies: newest, all, last5 (or another number), or numbers of gradient steps"""
    select: Annotated[TaskSelection, tyro.conf.arg(name="")] = ALL_TASKS
    episodes: int = 100
    """episodes of each task"""
    seeds: tuple[int, ...] = (0,)
    """base seeds: each draws episodes of its own. 0 is the set that all published scores are of"""
    out: Path | None = None
    """record file, JSON lines; default evaluation.jsonl, in the run directory if there is one"""
    profile: Profile | None = None
    """rules of the tasks, for --player: thesis by default; a run keeps the rules it was trained by"""
    workers: int | None = None
    """processes; default one per CPU core"""
    json: bool = False
    """print the scores as JSON, an object a line, instead of a table"""

    def run(self) -> int:
        """Plays what the record files do not hold yet, with a progress bar, and prints the scores."""
        workers = num_cores() if self.workers is None else self.workers
        self._check(workers)
        from gvz.evaluation.episode_log import RecordFile, missing_jobs, play_and_record, wanted_episodes

        player_specs = self._player_specs()
        files: dict[Path, RecordFile] = {}
        stop = StopRequest()
        try:
            with stop:
                held: dict[PlayerSpec, RecordFile] = {}
                jobs = []
                for player_spec, (tasks, out) in player_specs.items():
                    if out not in files:
                        files[out] = RecordFile(out)
                    held[player_spec] = files[out]
                    jobs += missing_jobs(player_spec, files[out], wanted_episodes(tasks, self.episodes, self.seeds))
                _show_progress(play_and_record(held, jobs, num_workers=workers, stop=stop), len(jobs))
            for player_spec, (tasks, _) in player_specs.items():
                self._print_scores(player_spec, tasks, held[player_spec].rows)
        except KeyboardInterrupt:
            say("interrupted; the same command goes on from here")
            return stop.exit_code or EXIT_INTERRUPTED
        finally:
            for file in files.values():
                file.close()
        return 0

    def _check(self, workers: int) -> None:
        if self.player is not None and self.run_dirs:
            raise ConfigError(f"evaluate: got --player {self.player} and also {self.run_dirs[0]}, want one of them")
        if self.player is None and not self.run_dirs:
            raise ConfigError("evaluate: want --player or run directories (before --tasks, which takes what follows)")
        agent, encoder = self.own_files
        of_runs = {"--agent": agent, "--encoder": encoder, "--checkpoints": self.checkpoints != ("newest",)}
        if self.player is not None and (given := [flag for flag, value in of_runs.items() if value]):
            raise ConfigError(f"{given[0]}: got it beside --player {self.player}, want it with run directories alone")
        if not self.checkpoints:
            raise ConfigError("--checkpoints: got none, want newest, all, last5 (or another number), or gradient steps")
        for name, value in (("episodes", self.episodes), ("workers", workers)):
            if value < 1:
                raise ConfigError(f"--{name}: got {value}, want at least 1")
        if not self.seeds or len(set(self.seeds)) < len(self.seeds) or not all(0 <= n < 2**63 for n in self.seeds):
            raise ConfigError(f"--seeds: got {list(self.seeds)}, want different numbers from 0 to 2^63 - 1")

    def _player_specs(self) -> "dict[PlayerSpec, tuple[tuple[Task, ...], Path]]":
        """Who plays -> what, and the record file."""
        from gvz.evaluation.episode_log import simple_player
        from gvz.evaluation.trained import check_profile, check_tasks, find_checkpoints, read_run_config, trained_player
        from gvz.evaluation.zoo import run_directory

        if self.player is not None:
            out = Path(EVALUATION_RECORDS) if self.out is None else self.out
            env = EnvConfig(profile=self.profile or "thesis")
            return {simple_player(self.player, env): (self.select.resolve(), out)}
        found = {}
        for run_dir in dict.fromkeys(map(run_directory, self.run_dirs)):
            config = read_run_config(run_dir, self.own_files)
            tasks = self.select.of_run([scenario.id for scenario in config.table.scenarios])
            check_tasks(config, tasks)
            check_profile(config, self.profile)
            out = run_dir / EVALUATION_RECORDS if self.out is None else self.out
            for num_updates in find_checkpoints(run_dir, self.checkpoints):
                found[trained_player(run_dir, config, num_updates)] = (tasks, out)
        return found

    def _print_scores(self, player_spec: "PlayerSpec", tasks: Sequence[Task], rows: "Sequence[Row]") -> None:
        from gvz.evaluation.episode_log import rows_of
        from gvz.evaluation.table import score_lines, score_rows

        player, mine = player_spec.identity["player"], rows_of(player_spec, rows)
        for base_seed in self.seeds:
            chosen = [row for one, row in mine.items() if one.base_seed == base_seed and one.episode < self.episodes]
            found = score_rows(chosen, tasks)
            if self.json:
                for one in found:
                    print(json.dumps({"player": player, "base_seed": base_seed, **one}))
            else:
                print(player + (f", base seed {base_seed}" if base_seed else ""))
                print("\n".join(score_lines(found)))


COMMAND = Evaluate


def _show_progress(rows: "Iterator[Row]", total: int) -> None:
    """Shows the rows as they come."""
    from gvz.run.bars import Bar, Bars

    with Bars(LINE_PERIOD_S) as bars:
        for done, row in enumerate(rows, 1):
            text = f"{row['player']}  {row['task']}"
            bars.show([Bar(name="episodes", done=done, total=total, unit="episodes", text=text)])
