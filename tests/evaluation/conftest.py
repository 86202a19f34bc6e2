"""What tests of evaluation share."""

import pytest

from tests.evaluation.policies import CONFIG, write_policy


@pytest.fixture
def run(tmp_path):
    """A run directory with the policies of updates 10, 20 and 100."""
    for step in (10, 20, 100):
        write_policy(tmp_path / "run", CONFIG, step)
    return tmp_path / "run"
