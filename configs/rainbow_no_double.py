"""Rainbow without double Q-learning: the target network both chooses and values the next action."""

from dataclasses import replace

from configs.rainbow_4task import CONFIG as RAINBOW

CONFIG = replace(RAINBOW, name="rainbow_no_double", agent=replace(RAINBOW.agent, double=False))
