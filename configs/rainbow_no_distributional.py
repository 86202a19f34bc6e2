"""Rainbow without the return distribution: expected values and the Huber loss."""

from dataclasses import replace

from configs.rainbow_4task import CONFIG as RAINBOW

CONFIG = replace(RAINBOW, name="rainbow_no_distributional", agent=replace(RAINBOW.agent, distributional=False))
