"""The command: `python -m benchmarks NAME... [--quick] [--out DIR] [--peers PYTHON]`, or `--list`."""

import shlex
import signal
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import tyro

from benchmarks import rounds, runner
from gvz.core.errors import GvzError


@dataclass(frozen=True, kw_only=True)
class Benchmarks:
    """Measure throughput beside peers. Each benchmark writes a record; `python -m benchmarks.report` makes the page.

    Example: python -m benchmarks all --out results/performance
    """

    names: tyro.conf.Positional[tuple[str, ...]] = ()
    """benchmarks to run, or all"""
    list: bool = False
    """print the names and what each compares"""
    quick: bool = False
    """smallest sizes: checks that every body runs; the figures have no meaning"""
    out: Path = Path("runs/benchmarks")
    """directory of the records; a record with the same name is replaced"""
    peers: Path = rounds.FULL.peers
    """interpreter of the peers' virtual environment (`make bench-peers`)"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns the exit code: 0 done, 1 some benchmark failed, 2 bad input, 130 interrupted."""
    arguments = sys.argv[1:] if arguments is None else arguments
    options = tyro.cli(Benchmarks, args=arguments, prog="python -m benchmarks")
    if options.list:
        for name, module in runner.benchmarks().items():
            print(f"{name:16} {(module.__doc__ or '').splitlines()[0]}")
        return 0
    for number in (signal.SIGINT, signal.SIGTERM):  # also if a shell started us with Ctrl-C ignored
        signal.signal(number, signal.default_int_handler)
    budget = replace(rounds.QUICK if options.quick else rounds.FULL, peers=options.peers.absolute())
    failures = []
    try:
        for name in runner.chosen(options.names):
            print(f"{name}:", flush=True)
            command = shlex.join(["python", "-m", "benchmarks", name, *(["--quick"] if options.quick else [])])
            if failure := runner.run(name, budget, command, options.out):
                failures.append(failure)
                print(f"  failed: {failure}", file=sys.stderr, flush=True)
    except GvzError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("stopped; what was started is ended", file=sys.stderr)
        return 130
    for failure in failures:
        print(f"failed: {failure}", file=sys.stderr)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
