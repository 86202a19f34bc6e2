"""Rainbow on four Defend the Center tasks with every part of the thesis's recipe on.

As `rainbow_4task`, which has the six parts of Rainbow (4.2), replay, network and Tables 5.1 and 5.2, and in addition:

- a sample's loss is scaled by the KPI weight of its task (4.3.2, eq. 4.19 and 4.20), over the last 30 episodes and at
  most 10; the thesis gives neither number;
- the newest transitions stand at the end of every batch (4.1.1: "a fixed number"): 3, as in its author's first code.

The hidden layers have the 512 units of Hessel et al. 2018, whose architecture 5.1.2 retains. The 4096 units of the DQN
in 4.1.5 are in `rainbow_hidden_4096`.
"""

from dataclasses import replace

from configs.rainbow_4task import CONFIG as RAINBOW
from learner.config import ReplayConfig

CONFIG = replace(
    RAINBOW,
    name="rainbow_4task_thesis",
    replay=ReplayConfig(num_newest=3),
    learner=replace(RAINBOW.learner, kpi_weighting=True),
)
