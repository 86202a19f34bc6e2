"""A measured body in its own process, under our interpreter or the peers'.

The process prints one JSON object about itself, and then one for every line of JSON arguments that it receives (see
`benchmarks/peers/serve.py`).
"""

import contextlib
import json
import os
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any

PEERS = Path(__file__).parent / "peers"
START_TIMEOUT_S = 600.0
"""limit for a process's first line: cold imports of torch and TensorFlow take a minute"""
ANSWER_TIMEOUT_S = 300.0
_END_TIMEOUT_S = 10.0


class RemoteError(Exception):
    """The process could not start, died or did not answer; the message has the end of its output."""


class Remote:
    """A running body. Call it with arguments; `close` it, or use it as a context manager.

    Attributes:
        about: the versions and settings that the process reported.
    """

    def __init__(
        self,
        script: str,
        *arguments: str,
        python: Path | str = sys.executable,
        environment: Mapping[str, str] = MappingProxyType({}),
        pass_fds: Sequence[int] = (),
    ):
        """Starts `benchmarks/peers/<script>.py` and waits until it is ready.

        Args:
            script: file name without suffix.
            *arguments: of its command line.
            python: interpreter.
            environment: variables to set.
            pass_fds: file descriptors that it inherits.

        Raises:
            RemoteError: there is no such interpreter, or the process ended before it was ready (a package that it
                needs is not installed).
        """
        self._name = script
        self._directory = tempfile.TemporaryDirectory(prefix="gvz-peer-")  # ViZDoom writes into its directory
        self._errors = Path(self._directory.name) / "stderr"
        self._process: subprocess.Popen[bytes] | None = None
        if not Path(python).exists():
            self.close()
            raise RemoteError(f"{script}: there is no interpreter {python}; make one with `make bench-peers`")
        root = str(PEERS.parent.parent)
        # peers do not see our modules, nor what stands before the installed ones
        path = [root, os.environ.get("PYTHONPATH", "")] if str(python) == sys.executable else []
        with self._errors.open("wb") as errors:
            self._process = subprocess.Popen(
                [str(Path(python).absolute()), str(PEERS / f"{script}.py"), *arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                cwd=self._directory.name,
                pass_fds=pass_fds,
                env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, path)), **environment},
            )
        self._buffer = b""
        try:
            self.about = self._answer(START_TIMEOUT_S)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> "Remote":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()

    def ask(self, **arguments: Any) -> None:
        """Sends arguments; the body starts at once. `answer` takes its result."""
        assert self._process is not None
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps(arguments).encode() + b"\n")
            self._process.stdin.flush()
        except OSError as error:
            raise RemoteError(f"{self._name}: it has died; {self._tail()}") from error

    def answer(self) -> dict[str, Any]:
        """The measurements of the body.

        Raises:
            RemoteError: it died, or did not answer in time.
        """
        return self._answer(ANSWER_TIMEOUT_S)

    def has_answered(self) -> bool:
        """Whether `answer` returns without waiting."""
        assert self._process is not None
        assert self._process.stdout is not None
        return bool(self._buffer or select.select([self._process.stdout], [], [], 0.0)[0])

    def __call__(self, **arguments: Any) -> dict[str, Any]:
        """`ask`, then `answer`."""
        self.ask(**arguments)
        return self.answer()

    def close(self) -> None:
        """Closes its input, which ends it normally; kills it if that takes too long. Can be repeated."""
        process, self._process = self._process, None
        if process is not None:
            assert process.stdin is not None
            assert process.stdout is not None
            with contextlib.suppress(OSError):
                process.stdin.close()
            try:
                process.wait(_END_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            process.stdout.close()
        self._directory.cleanup()

    def _answer(self, timeout_s: float) -> dict[str, Any]:
        """The next line that is a JSON object; libraries can print other lines before it."""
        assert self._process is not None
        assert self._process.stdout is not None
        descriptor, deadline = self._process.stdout.fileno(), time.monotonic() + timeout_s
        while True:
            line, newline, rest = self._buffer.partition(b"\n")
            if newline:
                self._buffer = rest
                if line.startswith(b"{"):
                    return json.loads(line)
                continue
            ready, _, _ = select.select([descriptor], [], [], max(0.0, deadline - time.monotonic()))
            if not ready:
                raise RemoteError(f"{self._name}: no answer within {timeout_s:.0f} s; {self._tail()}")
            data = os.read(descriptor, 65536)
            if not data:
                raise RemoteError(f"{self._name}: {self._tail()}")
            self._buffer += data

    def _tail(self) -> str:
        """The last line it wrote to its standard error: in Python, the exception."""
        lines = self._errors.read_text(errors="replace").strip().splitlines()
        return lines[-1][:300] if lines else "it ended without a message"


def start_peer(
    script: str, python: Path, *arguments: str, environment: Mapping[str, str] = MappingProxyType({})
) -> "Remote | str":
    """A peer's process, or the reason why there is none.

    A peer that does not work in the common environment (TensorFlow and torch in one process do not) has its own beside
    it, `<environment>-<peer>`.
    """
    venv = python.parent.parent
    own = venv.with_name(f"{venv.name}-{script.partition('_')[0]}") / "bin" / "python"
    python = own if own.exists() else python
    try:
        return Remote(script, *arguments, python=python, environment=environment)
    except RemoteError as error:
        return f"not installed, or it does not start: {error}"


def count_per_s(remotes: list[Remote], arguments: Mapping[str, Any]) -> float:
    """Asks all processes at once and adds up their `count` / `seconds`."""
    for remote in remotes:
        remote.ask(**arguments)
    answers = [remote.answer() for remote in remotes]
    return sum(answer["count"] / answer["seconds"] for answer in answers)
