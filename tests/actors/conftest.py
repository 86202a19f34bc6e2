"""Lets tests and workers import fake_env."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parent))
