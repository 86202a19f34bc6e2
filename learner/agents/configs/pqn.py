"""What can be set of PQN."""

from dataclasses import dataclass
from typing import ClassVar

from gvz.core.ranges import Share
from learner.config import EpsilonConfig


@dataclass(frozen=True, kw_only=True, slots=True)
class PQNConfig(EpsilonConfig):
    """PQN. Source: Gallici et al. 2024, Atari's settings in its published code (pqn_atari.yaml)."""

    on_policy: ClassVar[bool] = True

    name: str = "pqn"
    """module in learner/agents, or the path of a Python file (docs/AGENTS.md)"""
    encoder: str = "layer_norm"
    """module in learner/encoders, or the path of a Python file: what makes features of frames"""
    layer_norm: bool = True
    """normalize the hidden layer, too: without a target network, it is what keeps bootstrapping from diverging"""
    td_lambda: Share = 0.65
    """lambda of the returns Q(lambda): 0 looks one step ahead, 1 to the end of the window"""


CONFIG = PQNConfig
