"""PPO on what `rainbow_segmented` sees and is rewarded for, with its network and games: no replay (docs/FINDINGS.md).

Settings of PPO are those of `ppo_quick`. It does not shift frames: PPO has no augmentations. There are two actors on
any number of cores: a rollout has a window for each game, so more games would be another setting of PPO.
"""

import dataclasses

from actors.config import ActorsConfig
from configs.ppo_quick import CONFIG as PPO
from configs.rainbow_segmented import CONFIG as SEGMENTED
from configs.rainbow_segmented import SCENARIO_SETTINGS as SEGMENTED_SETTINGS
from learner.config import change_agent

CONFIG = dataclasses.replace(
    SEGMENTED,
    name="ppo_segmented",
    actors=ActorsConfig(num_actors=2),
    agent=change_agent(SEGMENTED.agent, "ppo"),
    replay=None,
    learner=dataclasses.replace(PPO.learner, total_updates=500_000),
)

SCENARIO_SETTINGS = {"health_gathering": SEGMENTED_SETTINGS["health_gathering"]}
