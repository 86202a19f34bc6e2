"""Settings of every test process: strict JAX, and a runtime directory of its own, so that tests in other processes
do not stand in its engine starts or in its records. All share one cache of compiled XLA programs: compiling takes most
of the tests' processor time, and many tests compile the same functions.
"""

import atexit
import contextlib
import os
import shutil
import signal
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import pytest
from hypothesis import HealthCheck, settings

from gvz import cli
from gvz.core import janitor, records
from gvz.core.errors import GvzError
from tests.learner import seeds

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".pytest_cache" / "xla"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")


def _own_directory() -> tuple[Path, IO[str]]:
    """A new directory and its lock, which tells other test processes that this one lives."""
    while True:
        path = Path(tempfile.mkdtemp(prefix="gvz-tests-"))
        with contextlib.suppress(OSError):  # another one took it, still without a lock, for that of a dead process
            file = (path / "lock").open("w")
            if records.lock(file) and (path / "lock").exists():
                return path, file


for _left in Path(tempfile.gettempdir()).glob("gvz-tests-*"):
    with contextlib.suppress(OSError, GvzError), (_left / "lock").open("r+") as _file:
        if records.lock(_file):  # its test process was killed
            os.environ["GVZ_RUNTIME_DIR"] = str(_left)
            janitor.clean_dead_instances()
            shutil.rmtree(_left)
_DIRECTORY, _LOCK = _own_directory()
_OWNER = os.getpid()
os.environ["GVZ_RUNTIME_DIR"] = str(_DIRECTORY)

# Programs under test would inherit what a shell sets for a background job, and nohup for all.
for _number, _handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, _handler)

# Hypothesis measures time, and the machine may be busy.
settings.register_profile("any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any machine")


@atexit.register
def _clean_up() -> None:
    """Removes what tests that kill with SIGKILL have left, as the next start would; then the records of it."""
    if os.getpid() != _OWNER:
        return  # a fork
    janitor.clean_dead_instances()
    shutil.rmtree(_DIRECTORY, ignore_errors=True)
    _LOCK.close()


@pytest.fixture
def refusal(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """What a command of gvz says to bad input: one line on standard error, and exit code 2."""

    def refusal(*arguments: str) -> str:
        assert cli.main(list(arguments)) == 2
        out, err = capsys.readouterr()
        assert out == ""
        assert err.startswith("error: ")
        assert err.count("\n") == 1
        return err

    return refusal


def pytest_addoption(parser: pytest.Parser) -> None:
    seeds.add_option(parser)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    seeds.parametrize(metafunc)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """End-to-end tests first: their files take minutes, so that one at the end would leave a worker without work."""
    items.sort(key=lambda item: "e2e" not in item.keywords)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """`--dist loadfile`, in the order of the items, and with one worker for the tests that share a cluster of Ray.

    The tests of a file share fixtures and compiled programs. Groups of pytest-xdist 3.8 have no effect with pytest 9.2.
    """
    from xdist.scheduler import LoadFileScheduling

    class OneWorkerForRay(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return "ray" if nodeid.startswith("tests/cluster/") else super()._split_scope(nodeid)

    config.option.loadscopereorder = False
    return OneWorkerForRay(config, log)


def pytest_runtest_setup(item: pytest.Item) -> None:
    from tests import compiling

    compiling.optimize("isa" in item.keywords)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    if terminalreporter.config.getoption("--learning-seeds"):
        seeds.summarize(terminalreporter)


def pytest_configure() -> None:
    import jax  # after the environment is set

    from tests import compiling

    jax.config.update("jax_numpy_rank_promotion", "raise")
    compiling.prepare()
