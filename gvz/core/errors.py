"""Every error a caller may handle.

Arguments that are simply wrong raise `ValueError`; a broken own invariant is an `assert`. Everything else that
can go wrong at run time has a class here, and its message says what, where, got, wanted, and what to do.
"""

import signal
from collections.abc import Iterable
from difflib import get_close_matches

EXIT_INTERRUPTED = 130
"""exit code that a shell shows for a program that Ctrl-C ended"""


class GvzError(Exception):
    """Base of all errors of this project."""

    exit_code = 1
    """of a command that ends with this error: 2 if what the user gave cannot be run, else 1"""


class ConfigError(GvzError, ValueError):
    """A configuration that cannot be run: names the field, the value, what is allowed."""

    exit_code = 2


class UnknownOptionError(ConfigError, TypeError):
    """An unknown keyword argument. It is a TypeError, as in Python itself: TorchRL's GymEnv catches that."""


class TaskError(GvzError, ValueError):
    """An unknown scenario, task or attribute, or a set of attributes that cannot be combined."""

    exit_code = 2


class AcsError(GvzError, ValueError):
    """ACS source text that cannot be compiled. Carries the 1-based `line` and `column`."""

    def __init__(self, message: str, line: int, column: int):
        super().__init__(message, line, column)  # all of them: a worker process sends the error as these
        self.line = line
        self.column = column

    def __str__(self) -> str:
        return f"ACS script, line {self.line}, column {self.column}: {self.args[0]}"


class WadError(GvzError, ValueError):
    """Bytes that are not the WAD, lump or UDMF text they should be."""


class EngineError(GvzError):
    """The ViZDoom engine did not start, died, or stopped answering."""


class TransportError(GvzError):
    """A shared-memory segment is not what it should be (schema, layout, size, sequence)."""


class WaitTimeoutError(GvzError, TimeoutError):
    """A wait reached its time-out. The message says who waited for whom, for what, how long."""


class WorkerError(GvzError):
    """An actor failed for good: its restart budget is spent, and the message has its last log lines. Or choosing the
    actors' actions failed.
    """


class GroupError(GvzError):
    """A process of a group of learners is gone, so that the others cannot go on."""


def exit_text(code: int) -> str:
    """How a process with this exit code ended. Below 0 (Python) and above 128 (shells), a signal ended it."""
    try:
        name = signal.Signals(-code if code < 0 else code - 128).name
    except ValueError:
        return f"exit code {code}"
    why = ": perhaps no memory was left" if name == "SIGKILL" else ""
    return f"exit code {code} ({name}{why})"


def nearest(name: str, known: Iterable[str]) -> str:
    """A hint at the known name that is most similar to `name`, for an error message; empty if none is similar."""
    match = get_close_matches(name, list(known), n=1)
    return f" (did you mean {match[0]!r}?)" if match else ""


class ResourceError(GvzError):
    """The run does not fit this machine (memory, /dev/shm, disk): says how much is needed and how to get it."""

    exit_code = 2


class CheckpointError(GvzError):
    """A checkpoint cannot be written or read."""


class ResumeError(GvzError):
    """A run directory cannot be continued with this configuration: names every differing field."""

    exit_code = 2


class NonFiniteError(GvzError):
    """A loss, gradient or parameter is NaN or infinite: the run stops and the batch is saved."""
