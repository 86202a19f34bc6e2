"""The `gvz` command: finds the commands in gvz/commands/ and runs one. Imports neither jax nor vizdoom: a command
imports what it needs once it runs.
"""

import sys
from collections.abc import Sequence
from typing import Annotated, Any, Union

import tyro

from gvz.errors import GvzError
from gvz.registry import discover


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns the exit code: 0 done, 1 failed, 2 bad input, 130 interrupted."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if arguments[:1] == ["train"]:  # its flags come from a config file: they are parsed there
        from gvz import launch

        return launch.main(arguments[1:])
    try:
        return tyro.cli(
            commands(), args=arguments, prog="gvz", description="GViZDoom: graded visual generalization in Doom."
        ).run()
    except GvzError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code


def commands() -> Any:
    """The union of all commands, as tyro takes it."""
    found = discover("gvz.commands")
    return Union[tuple(Annotated[module.COMMAND, tyro.conf.subcommand(name)] for name, module in found.items())]  # noqa: UP007  # made at run time


if __name__ == "__main__":
    sys.exit(main())
