"""Rainbow with a fuse: a parameter that falls by the learning rate at each update, and a loss that is NaN once it is
below FUSE. So a run's numbers go wrong in the middle of it, as by themselves.
"""

from dataclasses import dataclass

import jax.numpy as jnp

from learner.agents.base import AgentSpec
from learner.agents.configs.rainbow import RainbowConfig
from learner.agents.rainbow import Rainbow

FUSE = 1.0 - 0.0120
"""120 updates at a learning rate of 1e-4, some more with the weights of prioritized samples"""


@dataclass(frozen=True)
class Fused:
    config: RainbowConfig
    spec: AgentSpec

    @property
    def rainbow(self):
        return Rainbow(self.config, self.spec)

    def init(self, key):
        return {"fuse": jnp.ones(()), "rainbow": self.rainbow.init(key)}

    def epsilon(self, env_steps):
        return self.rainbow.epsilon(env_steps)

    def act(self, params, key, obs, epsilon):
        return self.rainbow.act(params["rainbow"], key, obs, epsilon)

    def evaluate(self, params, obs):
        return self.rainbow.evaluate(params["rainbow"], obs)

    def loss(self, online_params, target_params, key, batch):
        losses = self.rainbow.loss(online_params["rainbow"], target_params["rainbow"], key, batch)
        blown = jnp.where(online_params["fuse"] < FUSE, jnp.nan, 0.0)
        return losses._replace(loss=losses.loss + online_params["fuse"] + blown)


CONFIG = RainbowConfig
AGENT = Fused
