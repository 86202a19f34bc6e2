"""Rainbow with uniform replay."""

from dataclasses import replace

from configs.rainbow_4task import CONFIG as RAINBOW

CONFIG = replace(
    RAINBOW,
    name="rainbow_no_prioritized",
    replay=replace(RAINBOW.replay, prioritized=False),
)
