"""Rainbow with uniform replay."""

from dataclasses import replace

from configs.rainbow_4task import CONFIG as RAINBOW
from learner.config import ReplayConfig

CONFIG = replace(RAINBOW, name="rainbow_no_prioritized", replay=ReplayConfig(prioritized=False))
