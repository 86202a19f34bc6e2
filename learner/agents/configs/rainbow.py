"""What can be set of Rainbow."""

import dataclasses
from dataclasses import dataclass
from typing import Annotated, Literal, Self

from gvz.core.errors import ConfigError
from gvz.core.ranges import Range, Share
from learner.config import Augmentation, ValueConfig, refuse_unused

Noisy = Literal["off", "factorized", "independent"]


@dataclass(frozen=True, kw_only=True, slots=True)
class RainbowConfig(ValueConfig):
    """Rainbow (thesis 4.2). Each of its parts is one switch; with all of them off it is DQN.

    Source: thesis Tables 5.1 and 5.2.
    """

    name: str = "rainbow"
    """module in learner/agents, or the path of a Python file (docs/AGENTS.md)"""
    double: bool = True
    """double Q-learning (thesis eq. 4.9). Munchausen's target takes no maximum, so it cannot be off there"""
    dueling: bool = True
    """dueling streams (eq. 4.10)"""
    noisy: Noisy = "factorized"
    """noisy linear layers (eq. 4.14); off explores by epsilon"""
    distributional: bool = True
    """categorical distributional loss (eq. 4.17); off uses the Huber loss"""
    n_steps: int = 3
    """n of the n-step return (eq. 4.15); 1 switches it off"""
    num_atoms: Annotated[int, Range(2, 1001)] = 51
    """atoms of the return distribution"""
    num_quantiles: Annotated[int, Range(0, 1000)] = 0
    """quantiles of the return distribution in place of atoms: quantile regression needs no range; 0: atoms"""
    munchausen: bool = False
    """add the clipped log-probability of the action to the reward, and bootstrap softly (not with atoms)"""
    munchausen_alpha: Share = 0.9
    """scale of that bonus"""
    munchausen_temperature: Annotated[float, Range(1e-6, 100.0)] = 0.03
    """temperature of the softmax policy, in units of the return"""
    v_min: float | None = None
    """smallest atom, if there are atoms; default from the scenario's reward range"""
    v_max: float | None = None
    """largest atom, if there are atoms; default from the scenario's reward range"""
    noisy_sigma: Annotated[float, Range(0.0, 10.0)] = 0.017
    """initial sigma of the noisy layers"""
    noisy_period_steps: Annotated[int, Range(1, 10**6)] = 1
    """decisions of each game for which an actor keeps one draw of noise. 1: every decision has its own, and with
    factorized noise every game. More: all games of an actor share the draw, which is folded into the weights, so that
    acting costs as much as without noise. Each decision's noise has the same distribution, but within a stretch the
    policy is deterministic"""
    sight_weight: Annotated[float, Range(0.0, 1000.0)] = 0.0
    """weight of a further loss: tell from the encoder's features what is in sight, by class and column, as the engine's
    labels have it (game features, Lample and Chaplot 2017). Labels are needed in training alone; 0: off"""
    sight_augmentations: tuple[Augmentation, ...] = ()
    """random changes of the frames that this loss alone learns from, as `augmentations`, and with their strength and
    clean share. The values learn from frames without these. Empty: this loss reads what the values read"""
    noisy_epsilon: Share = 0.0
    """probability of a uniformly random action beside the noise; without noise it is epsilon_end"""

    def __post_init__(self) -> None:
        ValueConfig.__post_init__(self)  # super() knows no class with slots
        if self.num_quantiles and not self.distributional:
            raise ConfigError("agent.num_quantiles: got quantiles of no distribution; want agent.distributional True")
        if self.munchausen and self.has_atoms:
            raise ConfigError(
                "agent.munchausen: got True with atoms, for which no form is published; set agent.num_quantiles, or "
                "agent.distributional False"
            )
        if self.munchausen:
            refuse_unused("agent", self, "munchausen", "double")
        else:
            refuse_unused("agent", self, "munchausen", "munchausen_alpha", "munchausen_temperature")
        if not self.has_atoms:
            without = "num_quantiles" if self.distributional else "distributional"
            refuse_unused("agent", self, without, "v_min", "v_max")
        if self.noisy == "off":
            refuse_unused("agent", self, "noisy", "noisy_period_steps", "noisy_epsilon")
        if self.sight_augmentations and not self.learns_sight:
            raise ConfigError(
                f"agent.sight_augmentations: got {' '.join(self.sight_augmentations)} without a loss that reads them; "
                "set agent.sight_weight, such as 0.1"
            )
        if self.learns_sight and "shift" in (self.sight_augmentations or self.augmentations):
            raise ConfigError(
                "agent.sight_weight: got frames that `shift` moves aside, while what is in sight of a column stays; "
                "want agent.sight_augmentations without shift, such as vertical_shift"
            )
        if self.v_min is not None and self.v_max is not None and not self.v_min < self.v_max:
            raise ConfigError(f"agent.v_min, v_max: got {self.v_min}, {self.v_max}, want v_min < v_max")

    @property
    def has_atoms(self) -> bool:
        """The return distribution is categorical."""
        return self.distributional and self.num_quantiles == 0

    @property
    def learns_sight(self) -> bool:
        return self.sight_weight > 0.0

    def value_range(self, v_min: float, v_max: float) -> tuple[float, float]:
        """(v_min, v_max) as configured; what is left open is the given one, that of the run's returns."""
        return v_min if self.v_min is None else self.v_min, v_max if self.v_max is None else self.v_max

    def support(self, v_min: float, v_max: float) -> tuple[float, float] | None:
        return self.value_range(v_min, v_max) if self.has_atoms else None

    def with_support(self, v_min: float, v_max: float) -> Self:
        return dataclasses.replace(self, v_min=v_min, v_max=v_max) if self.has_atoms else self

    def epsilon(self, env_steps: int) -> float:
        return ValueConfig.epsilon(self, env_steps) if self.noisy == "off" else self.noisy_epsilon


CONFIG = RainbowConfig
