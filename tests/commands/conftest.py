"""A run directory that was never trained, for commands that read one, and a place without a display."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.evaluation.policies import CONFIG, write_policy


@pytest.fixture
def small_run(tmp_path: Path) -> Path:
    """The run small/seed_7 on Defend the Center, with random policies of updates 10 and 20."""
    path = tmp_path / "run"
    for step in (10, 20):
        write_policy(path, CONFIG, step)
    return path


@pytest.fixture
def refused_without_display(tmp_path: Path) -> Callable[..., str]:
    """What a command of gvz writes to standard error where no window can be opened; it leaves no file."""

    def refused(*arguments: str) -> str:
        hidden = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")
        done = subprocess.run(
            [sys.executable, "-m", "gvz.cli", *arguments],
            env={name: value for name, value in os.environ.items() if name not in hidden},
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        assert done.returncode == 2
        assert not list(tmp_path.iterdir())
        return done.stderr

    return refused
