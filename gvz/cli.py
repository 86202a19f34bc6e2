"""The `gvz` command: finds the commands in gvz/commands/ and runs one."""

import errno
import functools
import operator
import os
import sys
from collections.abc import Sequence
from typing import Annotated, Any

import tyro

import gvz
from gvz.core.errors import EXIT_INTERRUPTED, GvzError
from gvz.core.files import NO_ROOM
from gvz.core.helptext import paragraphs
from gvz.core.registry import discover
from gvz.core.stop import StopRequest, exit_at_once, say, stuck

EXIT_BROKEN_PIPE = 141
"""exit code that a shell shows for a program that SIGPIPE ended"""
_OF_THE_DISK = {*NO_ROOM, errno.EACCES, errno.EPERM, errno.EROFS, errno.EISDIR, errno.ENAMETOOLONG}
"""what a user can do something about: no permission, no room, a directory in a file's place, too long a name"""
DESCRIPTION = (
    "GViZDoom: a benchmark of visual generalization in Doom. Help: `gvz COMMAND --help`. Version: `gvz --version`."
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns the exit code: 0 done, 1 failed, 2 bad input; 130, 143 and 129 ended by SIGINT, SIGTERM
    and SIGHUP.
    """
    code = _main(arguments)
    if any(thread.is_alive() for thread in stuck):
        exit_at_once(code, "left without waiting for the cluster, whose head does not answer")
    return code


def _main(arguments: Sequence[str] | None) -> int:
    if sys.stdout is None:  # closed by who started us
        sys.stdout = open(os.devnull, "w")  # noqa: PTH123, SIM115
    stop = StopRequest(at_once=True)
    try:
        with stop:
            try:
                return run(list(sys.argv[1:] if arguments is None else arguments))
            finally:  # a help text ends by SystemExit
                sys.stdout.flush()
    except GvzError as error:
        say(f"error: {error}")
        return error.exit_code
    except KeyboardInterrupt as interruption:  # some commands have something to say about it
        say("; ".join(["interrupted", *interruption.args]))
        return stop.exit_code or EXIT_INTERRUPTED
    except BrokenPipeError:  # the reader of our output has closed it: gvz tasks | head
        _drop_unwritten()
        return EXIT_BROKEN_PIPE
    except OSError as error:
        if error.errno == errno.ENOENT and _directory_is_gone():
            say("error: the current directory is not there any more; change to another")
            return 2
        if error.errno not in _OF_THE_DISK:
            raise
        _drop_unwritten()
        where = f"{error.filename}: " if error.filename else ""
        say(f"error: {where}{error.strerror}; make room or give a place that you can write to")
        return 1
    except ImportError:  # a library gives it when its import is interrupted
        if stop.signal is None:
            raise
        say("interrupted")
        return stop.exit_code


def _directory_is_gone() -> bool:
    try:
        os.getcwd()  # noqa: PTH109
    except FileNotFoundError:
        return True
    return False


def _drop_unwritten() -> None:
    """Drops output that cannot be written: Python flushes once more when it ends, and its exit code would be 120."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


def run(arguments: Sequence[str]) -> int:
    """Runs the command and returns its exit code.

    Raises:
        GvzError: it failed, or it is not possible.
    """
    if arguments == ["--version"]:
        print(f"gvizdoom {gvz.__version__}")
        return 0
    if arguments[:1] == ["train"]:  # its flags depend on a config file, so launch parses them
        from gvz import launch

        return launch.main(arguments[1:])
    return parse(arguments).run()


def parse(arguments: Sequence[str], **other_commands: type) -> Any:
    """The chosen command with its flags.

    Args:
        arguments: of `gvz`.
        **other_commands: name -> dataclass, instead of the one in gvz/commands.
    """
    found = {name: module.COMMAND for name, module in discover("gvz.commands").items()} | other_commands
    overview = arguments[:1] in ([], ["-h"], ["--help"])  # shows only the first sentence of each command
    choices: list[Any] = []
    for name, command in found.items():
        sentence = (command.__doc__ or "").partition("\n")[0] if overview else None
        choices.append(Annotated[command, tyro.conf.subcommand(name, description=sentence)])
    with paragraphs():
        return tyro.cli(
            functools.reduce(operator.or_, choices),
            args=arguments,
            prog="gvz",
            description=DESCRIPTION,
            config=(tyro.conf.DisallowNone, tyro.conf.FlagCreatePairsOff),
        )


if __name__ == "__main__":
    sys.exit(main())
