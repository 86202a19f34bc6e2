"""Rainbow without noisy layers: it explores by epsilon, as DQN does."""

from dataclasses import replace

from configs.rainbow_4task import CONFIG as RAINBOW

CONFIG = replace(RAINBOW, name="rainbow_no_noisy", agent=replace(RAINBOW.agent, noisy="off"))
