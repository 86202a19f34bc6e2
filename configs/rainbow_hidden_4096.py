"""Rainbow with 4096 hidden units in each stream (thesis 4.1.5)."""

from dataclasses import replace

from configs.rainbow_4task import CONFIG as RAINBOW

CONFIG = replace(RAINBOW, name="rainbow_hidden_4096", agent=replace(RAINBOW.agent, hidden_units=4096))
