"""Ten seeds of every test of learning, and what they measured: `--learning-seeds 10`. Imports pytest.

A test of learning takes the fixture `learning_seed` and notes what it compares by `record_property`. In `make test` it
runs with one seed, in the slow lane with three. With the option it runs with as many as asked for, and a table at the
end says how many passed and between which bounds the compared numbers lay: the figures beside each test.
"""

import re
from collections import defaultdict

import pytest

SLOW_LANE_SEEDS = 3


def add_option(parser: pytest.Parser) -> None:
    parser.addoption(
        "--learning-seeds",
        type=int,
        default=0,
        metavar="N",
        help="run every test of learning with N seeds, and show what they measured",
    )


def parametrize(metafunc: pytest.Metafunc) -> None:
    """Seeds 1111, 2222, ...; all but the first belong to the slow lane, unless the option asks for them."""
    if "learning_seed" not in metafunc.fixturenames:
        return
    wanted = metafunc.config.getoption("--learning-seeds")
    slow = () if wanted else (pytest.mark.slow,)
    seeds = [1111 * (i + 1) for i in range(wanted or SLOW_LANE_SEEDS)]
    values = [pytest.param(seed, marks=slow if i else (), id=f"seed {seed}") for i, seed in enumerate(seeds)]
    metafunc.parametrize("learning_seed", values)


def summarize(reporter: pytest.TerminalReporter) -> None:
    """One line for each test: seeds passed, and the range of each number it noted."""
    passed: dict[str, list[bool]] = defaultdict(list)
    numbers: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for outcome in ("passed", "failed"):
        for report in reporter.getreports(outcome):
            test, found = re.subn(r"seed \d+-?", "", report.nodeid.rpartition("::")[2])
            if not found or report.when != "call":
                continue
            passed[test].append(report.passed)
            for name, value in report.user_properties:
                numbers[test][name].append(float(value))
    reporter.section("tests of learning")
    for test, ones in sorted(passed.items()):
        ranges = [f"{name} {min(values):.3g} to {max(values):.3g}" for name, values in numbers[test].items()]
        reporter.write_line(f"{sum(ones)} of {len(ones)}  {test.removesuffix('[]')}: {'; '.join(ranges)}")
