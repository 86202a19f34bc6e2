"""What can be set of DQN."""

from dataclasses import dataclass

from learner.config import ValueConfig


@dataclass(frozen=True, kw_only=True, slots=True)
class DQNConfig(ValueConfig):
    """DQN (thesis 4.1)."""

    name: str = "dqn"
    """module in learner/agents, or the path of a Python file (docs/AGENTS.md)"""


CONFIG = DQNConfig
