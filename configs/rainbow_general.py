"""Rainbow for tasks that it has not seen, on two CPU cores: settings most of which gates chose (docs/FINDINGS.md).

Against `rainbow_quick`: the eight training tasks of a scenario, a replay twice as large, and at most 500,000 gradient
steps; in Seek and Kill a tenth of the reward for walking, and shots that cost nothing. Stop it when you like, or set
`--max-processor-s`.
"""

import dataclasses

from configs.rainbow_quick import CONFIG as QUICK
from gvz.run.config import CheckpointConfig, off_policy

_LEARNER, _REPLAY = off_policy(QUICK)

CONFIG = dataclasses.replace(
    QUICK,
    name="rainbow_general",
    training_set=8,
    env=dataclasses.replace(
        QUICK.env, reward_weights=(("seek_and_kill.ammo_spent", 0.0), ("seek_and_kill.moved", 0.0005))
    ),
    replay=dataclasses.replace(_REPLAY, capacity=100_000),
    learner=dataclasses.replace(_LEARNER, total_updates=500_000),
    checkpoint=CheckpointConfig(period_updates=10_000),
)
