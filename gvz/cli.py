"""The `gvz` command: tasks, gallery, evaluate, train. Imports neither jax nor vizdoom until a command needs them."""

import json
import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, assert_never

import tyro

from gvz.errors import CheckpointError, ConfigError, GvzError, ResourceError, TaskError
from gvz.scenarios.base import Split, Task
from gvz.specs import EnvConfig, Profile
from gvz.tasks import named_tasks, parse_task, scenario_named, scenarios

if TYPE_CHECKING:
    from gvz.evaluation.play import Row

EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130


@dataclass(frozen=True, kw_only=True)
class Select:
    """Which tasks: all 76 named ones, or these."""

    tasks: tuple[str, ...] = ()
    """ids, for example defend_the_center/gore+mossy_bricks; not only named tasks"""
    scenario: str | None = None
    """the named tasks of this scenario"""
    split: Split | None = None
    """the named tasks of this training or test set"""

    def resolve(self) -> tuple[Task, ...]:
        """The tasks.

        Raises:
            TaskError: an unknown name. ConfigError: ids beside a scenario or split.
        """
        if not self.tasks:
            return named_tasks(scenario=self.scenario, split=self.split)
        if self.scenario is not None or self.split is not None:
            raise ConfigError("--tasks: got ids and also --scenario or --split, want one or the other")
        return tuple(dict.fromkeys(parse_task(text) for text in self.tasks))


@dataclass(frozen=True, kw_only=True)
class Tasks:
    """List the tasks: id, level, attributes, training and test sets."""

    select: Annotated[Select, tyro.conf.arg(name="")] = Select()
    json: bool = False
    """one JSON object a line instead of a table"""


@dataclass(frozen=True, kw_only=True)
class Gallery:
    """Draw a contact sheet of each scenario: a frame of every named task, same seed and pose."""

    out: Path = Path("gallery")
    """directory for gallery_<scenario>.png"""
    scenario: str | None = None
    """only this one"""
    moving: bool = False
    """also agents.webp: the scripted agents of all scenarios at play, level after level"""


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Play evaluation episodes and append a row for each to a record file.

    Episode n of a task has the same seed for every player. The same command goes on where it was stopped.

    Examples: gvz evaluate --player random --scenario seek_and_kill
              gvz evaluate --run runs/rainbow_4task/seed_1111 --checkpoint newest --split test
    """

    player: Literal["random", "idle", "scripted"] | None = None
    """random: uniformly random buttons; idle: presses nothing; scripted: the scenario's simple script"""
    run: Path | None = None
    """a run directory: its policy plays greedily, noise off; by default the test tasks of its scenario"""
    checkpoint: str = "newest"
    """gradient steps of one of the run's policies, or newest"""
    select: Annotated[Select, tyro.conf.arg(name="")] = Select()
    episodes: int = 100
    """episodes of each task"""
    out: Path | None = None
    """record file, JSON lines; default evaluation.jsonl, in the run directory if there is one"""
    profile: Profile = "thesis"
    """rules of the tasks (a run keeps the rules it was trained by)"""
    workers: int | None = None
    """processes; default one per CPU core"""


@dataclass(frozen=True, kw_only=True)
class Train:
    """Train an agent, or go on with a run: `gvz train --help` has all the options (as python -m gvz.launch)."""


Command = (
    Annotated[Tasks, tyro.conf.subcommand("tasks")]
    | Annotated[Gallery, tyro.conf.subcommand("gallery")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[Train, tyro.conf.subcommand("train")]
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns the exit code: 0 done, 1 failed, 2 bad input, 130 interrupted."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if arguments[:1] == ["train"]:  # its options come from a config file: they are parsed there
        from gvz import launch

        return launch.main(arguments[1:])
    command = tyro.cli(
        Command,  # pyright: ignore[reportArgumentType]  # a union of annotated types is what tyro wants
        args=arguments,
        prog="gvz",
        description="GViZDoom: graded visual generalization in Doom.",
    )
    try:
        match command:
            case Tasks():
                list_tasks(command)
            case Gallery():
                draw_gallery(command)
            case Evaluate():
                return evaluate(command)
            case Train():
                raise AssertionError("train is forwarded above")
            case _:
                assert_never(command)
    except (ConfigError, TaskError, ResourceError, CheckpointError) as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except GvzError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def task_row(task: Task) -> dict[str, Any]:
    """What is to be said of a task, as JSON types."""
    from gvz.registration import gymnasium_id

    scenario = task.scenario
    sets = [name for name in scenario.splits if task in named_tasks(scenario.id, split=name)]
    return {
        "task": task.id,
        "scenario": scenario.id,
        "level": task.level,
        "attributes": list(task.attributes),
        "sets": sets,
        "gymnasium_id": gymnasium_id(task) if task in named_tasks(scenario.id) else None,
    }


def list_tasks(command: Tasks) -> None:
    """Prints a table, or JSON lines."""
    rows = [task_row(task) for task in command.select.resolve()]
    if command.json:
        for row in rows:
            print(json.dumps(row))
        return
    table = [("task", "level", "attributes", "sets")]
    table += [(r["task"], str(r["level"]), "+".join(r["attributes"]), " ".join(r["sets"])) for r in rows]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    for cells in table:
        print("  ".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)).rstrip())


def draw_gallery(command: Gallery) -> None:
    """Writes the pictures and says where they are."""
    chosen = scenarios().values() if command.scenario is None else [scenario_named(command.scenario)]
    try:
        command.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"--out: {command.out} cannot be made: {error.strerror}") from error
    from gvz.gallery import write_contact_sheet, write_moving_picture

    for scenario in chosen:
        print(write_contact_sheet(scenario, command.out))
    if command.moving:
        print(write_moving_picture(command.out / "agents.webp"))


def evaluate(command: Evaluate) -> int:
    """Plays what the record file does not hold yet, with a progress bar, and prints the scores."""
    from gvz.evaluation.players import PlayerSpec, player_env
    from gvz.evaluation.record import RecordFile, missing_jobs, play_and_record, row_identity
    from gvz.evaluation.table import score_lines

    if (command.player is None) == (command.run is None):
        raise ConfigError("evaluate: want one of --player and --run")
    if command.episodes < 1:
        raise ConfigError(f"--episodes: got {command.episodes}, want at least 1")
    workers = len(os.sched_getaffinity(0)) if command.workers is None else command.workers
    if workers < 1:
        raise ConfigError(f"--workers: got {workers}, want at least 1")
    if command.run is None:
        assert command.player is not None
        tasks = command.select.resolve()
        spec, names = PlayerSpec(kind=command.player), {"player": command.player}
        env = player_env(command.player, EnvConfig(profile=command.profile))
        out = Path("evaluation.jsonl")
    else:
        from gvz.evaluation.trained import check_tasks, read_run_config, read_trained_player

        config = read_run_config(command.run)
        tasks = _run_tasks(command.select, config.resolved_scenario().id)
        check_tasks(config, tasks)
        trained = read_trained_player(command.run, config, _checkpoint(command.checkpoint))
        spec, names, env = trained.spec, trained.identity, config.env
        out = command.run / "evaluation.jsonl"
    file = RecordFile(out if command.out is None else command.out)
    identity = row_identity(names, env)
    jobs = missing_jobs(file.rows, identity, tasks, command.episodes)
    try:
        _show_progress(play_and_record(file, jobs, identity, spec, env, workers), len(jobs), names["player"])
    except KeyboardInterrupt:
        print("interrupted; the same command goes on from here", file=sys.stderr)
        return EXIT_INTERRUPTED
    finally:
        file.close()
    print("\n".join(score_lines(file.rows, identity, tasks, command.episodes)))
    return 0


def _run_tasks(select: Select, scenario: str) -> tuple[Task, ...]:
    """The tasks a run is evaluated on: as selected, else the test set of its scenario."""
    if select == Select():
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


if __name__ == "__main__":
    sys.exit(main())
