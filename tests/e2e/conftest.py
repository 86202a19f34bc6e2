"""Lets the tests import `command`; what a test of the real command leaves behind fails it."""

import sys
from pathlib import Path

import pytest

from gvz.core import janitor
from tests.waiting import wait_until

sys.path.append(str(Path(__file__).parent))

from command import STARTED


@pytest.fixture
def nothing_left():
    """Nothing that a run of the test has made is there after it; a run that a failed test has left is ended."""
    files = set(Path.cwd().glob("_vizdoom*"))
    yield
    for process in STARTED:
        if process.poll() is None:
            process.kill()
            process.communicate()
            janitor.clean_dead_instances()
    wait_until(lambda: not janitor.dead_instances(), "engines and shared memory to be removed")
    STARTED.clear()
    assert set(Path.cwd().glob("_vizdoom*")) <= files
