"""What can be set of PPO."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

from gvz.core.ranges import Range, Share
from learner.config import AgentConfig


@dataclass(frozen=True, kw_only=True, slots=True)
class PPOConfig(AgentConfig):
    """PPO. Source: Schulman et al. 2017, sections 3 to 5 and Table 5; OpenAI's published code where a field says so."""

    on_policy: ClassVar[bool] = True

    name: str = "ppo"
    """module in learner/agents, or the path of a Python file (docs/AGENTS.md)"""
    td_lambda: Share = 0.95
    """lambda of the generalized advantages"""
    clip: Annotated[float, Range(1e-6, 1e6)] = 0.2
    """epsilon of the clipped ratio; the paper has 0.2, and 0.1 for Atari"""
    value_clip: Annotated[float | None, Range(1e-6, 1e12)] = None
    """how far a value may move from the one recorded before its gradient is cut; default off, as in the paper"""
    value_weight: Annotated[float, Range(0.0, 1e6)] = 0.5
    """c1, weight of half the squared error of the value; the paper's 1 for Atari, 0.5 in OpenAI's code"""
    entropy_weight: Annotated[float, Range(0.0, 1e6)] = 0.01
    """c2, weight of the policy's entropy"""
    normalize_advantages: bool = True
    """mean 0 and deviation 1 in every minibatch, as in OpenAI's code; a minibatch of one step stays as it is"""


CONFIG = PPOConfig
