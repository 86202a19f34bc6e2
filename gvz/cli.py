"""The `gvz` command: finds the commands in gvz/commands/ and runs one."""

import functools
import operator
import os
import sys
from collections.abc import Sequence
from typing import Annotated, Any

import tyro

import gvz
from gvz.core.errors import GvzError
from gvz.core.registry import discover

EXIT_BROKEN_PIPE = 141
"""what a shell says of a program that SIGPIPE ended"""
DESCRIPTION = (
    "GViZDoom: graded visual generalization in Doom. `gvz COMMAND --help` says more; `gvz --version` which it is."
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns the exit code: 0 done, 1 failed, 2 bad input, 130 interrupted."""
    try:
        code = run(list(sys.argv[1:] if arguments is None else arguments))
        sys.stdout.flush()
        return code
    except GvzError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    except BrokenPipeError:  # who read our output has what they wanted: gvz tasks | head
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes once more at the end
        return EXIT_BROKEN_PIPE


def run(arguments: Sequence[str]) -> int:
    """The exit code of what is asked for.

    Raises:
        GvzError: it failed, or cannot be done.
    """
    if arguments == ["--version"]:
        print(f"gvizdoom {gvz.__version__}")
        return 0
    if arguments[:1] == ["train"]:  # its flags come from a config file: they are parsed there
        from gvz import launch

        return launch.main(arguments[1:])
    return parse(arguments).run()


def parse(arguments: Sequence[str], **other_commands: type) -> Any:
    """The command that is asked for, with its flags.

    Args:
        arguments: of `gvz`.
        **other_commands: name -> dataclass, in place of the one in gvz/commands.
    """
    found = {name: module.COMMAND for name, module in discover("gvz.commands").items()} | other_commands
    overview = arguments[:1] in ([], ["-h"], ["--help"])
    choices: list[Any] = [Annotated[command, _subcommand(name, command, overview)] for name, command in found.items()]
    return tyro.cli(
        functools.reduce(operator.or_, choices),
        args=arguments,
        prog="gvz",
        description=DESCRIPTION,
        config=(tyro.conf.DisallowNone, tyro.conf.FlagCreatePairsOff),
    )


def _subcommand(name: str, command: type, overview: bool) -> Any:
    """In the overview of all commands each is said in a sentence."""
    if not overview:
        return tyro.conf.subcommand(name)
    return tyro.conf.subcommand(name, description=(command.__doc__ or "").partition("\n")[0])


if __name__ == "__main__":
    sys.exit(main())
