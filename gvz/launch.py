"""The command line of the trainer: `python -m gvz.launch --config rainbow_4task.py`.

All errors of a configuration are reported here, before any process starts. jax is imported only after that, so `--help`
and errors are quick.
"""

import dataclasses
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import tyro

from gvz.core.control_groups import keep_xla_to_quota
from gvz.core.errors import ConfigError, GvzError
from gvz.core.helptext import paragraphs
from gvz.core.libraries import require_learner
from gvz.core.stop import StopRequest, exit_at_once, say, told_of_delay
from gvz.run.config import RunConfig, with_agent, without_effect
from gvz.run.config_files import load_config
from gvz.run.rundir import RunDir, move_aside, refuse_other_contents

DEFAULT_CONFIG = "rainbow_4task.py"


@dataclass(frozen=True, kw_only=True)
class Launch:
    """Train an agent on Doom. The same command resumes a run where it stopped.

    Example: python -m gvz.launch --config rainbow_4task.py --learner.total-updates 5000
    """

    config: str = DEFAULT_CONFIG
    """config file: a name in configs/, or a path"""
    fresh: bool = False
    """start a new run; an old run in the run directory is moved aside, never overwritten"""
    run: Annotated[RunConfig, tyro.conf.arg(name=""), tyro.conf.AvoidSubcommands]


def argument(arguments: Sequence[str], flag: str) -> str | None:
    """The value of a flag that decides the defaults of other flags: the last one, or None if it is not given."""
    value = None
    for i, text in enumerate(arguments):
        name, equals, behind = text.partition("=")
        if name.replace("_", "-") == flag:  # tyro takes both
            value = behind if equals else next(iter(arguments[i + 1 :]), value)
    return value


def parse(arguments: Sequence[str]) -> Launch:
    """Parses the command line. The flags are those of the configuration's agent.

    Raises:
        ConfigError, TaskError: an invalid value. SystemExit(2): flags that do not parse.
    """
    if arguments and not arguments[0].startswith("-"):
        raise ConfigError(f"got {arguments[0]!r} without a flag; to choose a config, give --config {arguments[0]}")
    name = argument(arguments, "--config") or DEFAULT_CONFIG
    agent = argument(arguments, "--agent.name")

    def parsed(config: RunConfig) -> Launch:
        if agent is not None and agent != config.agent.name:
            config = with_agent(config, agent)
        default = Launch(config=name, run=config)
        with paragraphs():
            return tyro.cli(Launch, args=arguments, default=default, prog="python -m gvz.launch")

    config = load_config(name, argument(arguments, "--scenario"))
    launch = parsed(config)
    if launch.run.tasks is not None:
        theirs = f"the tasks of {name}" if argument(arguments, "--tasks") is None else "--tasks"
        for flag in ("--scenario", "--training-set"):
            if (value := argument(arguments, flag)) is not None:
                raise ConfigError(
                    f"{flag}: got {value} and also {theirs}, which leave it without effect; want one of them"
                )
    played = launch.run.table.scenarios
    of_played = load_config(name, played[0].id if len(played) == 1 else None)
    return launch if of_played == config else parsed(of_played)


def resumed_config(run: RunDir, config: RunConfig) -> RunConfig:
    """`config` with the run's first number of actors and games, if the command does not set them."""
    saved = run.saved_config(config.own_files)
    if saved is None or config.mode == "sync":
        return config
    unset = [name for name in ("num_actors", "games_per_actor") if getattr(config.actors, name) is None]
    first = {name: getattr(saved.actors, name) for name in unset}
    return dataclasses.replace(config, actors=dataclasses.replace(config.actors, **first))


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns the exit code: 0 done, 1 failed, 2 bad input, 130, 143 and 129 stopped and saved."""
    arguments = sys.argv[1:] if arguments is None else arguments
    in_group = False
    # before the trainer exists, a signal ends the command at once
    with StopRequest(at_once=True) as stop, told_of_delay(stop):
        try:
            launch = parse(arguments)
            require_learner("training")
            directory = launch.run.resolved_run_dir
            if launch.fresh and launch.run.group.num_processes > 1:
                raise ConfigError("--fresh: got it for a group of learner processes; give all another --run-dir")
            if launch.fresh and (moved := move_aside(directory)) is not None:
                say(f"moved the old run to {moved}")
            refuse_other_contents(directory)
            with RunDir(directory, in_another=launch.run.group.own_id > 0) as run:
                config = resumed_config(run, launch.run)
                for note in (*run.check_resumable(config), *(f"warning: {text}" for text in without_effect(config))):
                    say(note)
                keep_xla_to_quota()
                stop.importing = True
                from gvz.run.train import train  # imports jax, so only after the input is checked

                stop.importing, in_group = False, config.group.num_processes > 1
                return train(config, run, stop)
        except GvzError as error:
            if in_group:  # a normal end would wait for the other processes
                exit_at_once(error.exit_code, f"error: {error}")
            say(f"error: {error}")
            return error.exit_code
        except KeyboardInterrupt:  # it would wait for a thread that writes a checkpoint
            exit_at_once(stop.exit_code, "stopped at once")


if __name__ == "__main__":
    from gvz import cli  # a full disk or a closed pipe is one line there

    sys.exit(cli.main(["train", *sys.argv[1:]]))
