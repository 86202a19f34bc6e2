"""Lets the tests import `command`; what a test of the real command leaves behind fails it."""

import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parent))

from command import orphans, wait_until


@pytest.fixture
def nothing_left():
    """No segment and no stray engine file of ours remains after the test."""
    before, files = orphans(), set(Path.cwd().glob("_vizdoom*"))
    yield
    wait_until(lambda: orphans() <= before, "shared memory to be removed", 60)
    assert set(Path.cwd().glob("_vizdoom*")) <= files
