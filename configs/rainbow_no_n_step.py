"""Rainbow with one-step returns."""

from dataclasses import replace

from configs.rainbow_4task import CONFIG as RAINBOW

CONFIG = replace(RAINBOW, name="rainbow_no_n_step", agent=replace(RAINBOW.agent, n_steps=1))
