"""The command line of the trainer, nothing else: `python -m gvz.launch --config rainbow_4task.py`.

Everything that can be wrong with a configuration is said here, before any process starts. jax is imported only
after that, so `--help` and errors are quick.
"""

import dataclasses
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from gvz.core.errors import GvzError
from gvz.core.stop import StopRequest
from gvz.run.config import RunConfig, load_config
from gvz.run.rundir import RunDir, move_aside

DEFAULT_CONFIG = "rainbow_4task.py"


@dataclass(frozen=True, kw_only=True)
class Launch:
    """Train an agent on Doom. The same command resumes a run where it stopped.

    Example: python -m gvz.launch --config rainbow_4task.py --learner.total-updates 5000
    """

    config: str = DEFAULT_CONFIG
    """config file: a name in configs/, or a path"""
    fresh: bool = False
    """start anew: an old run in the run directory is moved aside, never overwritten"""
    run: Annotated[RunConfig, tyro.conf.arg(name="")]


def config_argument(arguments: Sequence[str]) -> str:
    """The value of --config, which decides the defaults of all other flags."""
    for i, argument in enumerate(arguments):
        if argument == "--config" and i + 1 < len(arguments):
            return arguments[i + 1]
        if argument.startswith("--config="):
            return argument.removeprefix("--config=")
    return DEFAULT_CONFIG


def parse(arguments: Sequence[str]) -> Launch:
    """Parses the command line.

    Raises:
        ConfigError, TaskError: a value that cannot be run. SystemExit(2): flags that do not parse.
    """
    name = config_argument(arguments)
    default = Launch(config=name, run=load_config(name))
    return tyro.cli(Launch, args=arguments, default=default, prog="python -m gvz.launch")


def resumed_config(run: RunDir, config: RunConfig) -> RunConfig:
    """`config`, with the number of actors and games the run began with where the command leaves them open."""
    saved = run.saved_config()
    if saved is None or config.mode == "sync":
        return config
    actors = config.actors
    if actors.num_actors is None:
        actors = dataclasses.replace(actors, num_actors=saved.actors.num_actors)
    if actors.games_per_actor is None:
        actors = dataclasses.replace(actors, games_per_actor=saved.actors.games_per_actor)
    return dataclasses.replace(config, actors=actors)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns the exit code: 0 done, 1 failed, 2 bad input, 130 and 143 stopped and saved."""
    arguments = sys.argv[1:] if arguments is None else arguments
    with StopRequest(at_once=True) as stop:  # until the trainer has something to save
        try:
            launch = parse(arguments)
            directory = launch.run.resolved_run_dir
            if launch.fresh and (moved := move_aside(directory)) is not None:
                print(f"moved the old run to {moved}", file=sys.stderr)
            with RunDir(Path(directory)) as run:
                config = resumed_config(run, launch.run)
                run.check_resumable(config)
                stop.importing = True
                from gvz.run.train import train  # imports jax: only once the input is known to be good

                stop.importing = False
                return train(config, run, stop)
        except GvzError as error:
            print(f"error: {error}", file=sys.stderr)
            return error.exit_code
        except KeyboardInterrupt:
            print("stopped at once", file=sys.stderr)
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(stop.exit_code)  # the interpreter's own end would wait for a thread that writes a checkpoint


if __name__ == "__main__":
    sys.exit(main())
