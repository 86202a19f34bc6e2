"""Rainbow without the dueling streams: one hidden layer leads to all actions."""

from dataclasses import replace

from configs.rainbow_4task import CONFIG as RAINBOW

CONFIG = replace(RAINBOW, name="rainbow_no_dueling", agent=replace(RAINBOW.agent, dueling=False))
