"""Configuration of agent, replay and learner."""

from dataclasses import dataclass
from typing import Literal

from gvz.core.errors import ConfigError

Noisy = Literal["off", "factorized", "independent"]
ConvForm = Literal["auto", "direct", "shifted"]


def _check(prefix: str, config: object, ranges: dict[str, tuple[float, float]]) -> None:
    """Raises ConfigError for the first field outside its closed range; None passes (a value to be derived)."""
    for name, (low, high) in ranges.items():
        value = getattr(config, name)
        if value is not None and not low <= value <= high:
            raise ConfigError(f"{prefix}.{name}: got {value}, want {low:g}..{high:g}")


@dataclass(frozen=True, kw_only=True, slots=True)
class AgentConfig:
    """The agent. Every component of Rainbow is one switch; with all of them off it is DQN.

    Source: thesis Tables 5.1 and 5.2.
    """

    name: str = "rainbow"
    """module in learner/agents, or the path of a Python file (docs/AGENTS.md)"""
    double: bool = True
    """double Q-learning (thesis eq. 4.9)"""
    dueling: bool = True
    """dueling streams (eq. 4.10)"""
    noisy: Noisy = "factorized"
    """noisy linear layers (eq. 4.14); off explores by epsilon"""
    distributional: bool = True
    """categorical distributional loss (eq. 4.17); off uses the Huber loss"""
    n_steps: int = 3
    """n of the n-step return (eq. 4.15); 1 switches it off"""
    discount: float = 0.99
    """gamma of one decision"""
    num_atoms: int = 51
    """atoms of the return distribution"""
    v_min: float | None = None
    """smallest atom; default from the scenario's reward range"""
    v_max: float | None = None
    """largest atom; default from the scenario's reward range"""
    initial_value: float = 0.0
    """Q(s, a) of a fresh network, for every state and action; inside the atoms' range if distributional"""
    noisy_sigma: float = 0.017
    """initial sigma of the noisy layers"""
    hidden_units: int = 512
    """units of the hidden layer, per stream if dueling"""
    conv_channels: tuple[int, ...] = (32, 64, 64)
    """output channels of the convolutions"""
    conv_kernels: tuple[int, ...] = (8, 4, 3)
    """kernel sizes, pixels"""
    conv_strides: tuple[int, ...] = (4, 2, 1)
    """strides, pixels"""
    conv_form: ConvForm = "auto"
    """how convolutions are computed: shifted (matmul and shifted adds, for a CPU) or direct (nn.Conv)"""
    activation_dtype: Literal["float32", "bfloat16"] = "float32"
    """dtype of activations; parameters and losses stay float32"""
    task_conditioned: bool = False
    """give the policy the task's index, pi(a | s, z) (eq. 4.18)"""
    stack_size: int = 4
    """frames in an observation"""
    epsilon_start: float = 1.0
    """epsilon after warm-up, before decay; used when noisy is off"""
    epsilon_end: float = 0.001
    """epsilon after decay"""
    epsilon_decay_steps: int = 50_000
    """decisions over which epsilon falls linearly, counted after warm-up"""

    def __post_init__(self) -> None:
        _check(
            "agent",
            self,
            {
                "n_steps": (1, 64),
                "discount": (0.0, 0.99999),
                "num_atoms": (2, 1001),
                "noisy_sigma": (0.0, 10.0),
                "hidden_units": (1, 65536),
                "stack_size": (1, 16),
                "epsilon_start": (0.0, 1.0),
                "epsilon_end": (0.0, 1.0),
                "epsilon_decay_steps": (1, 10**12),
            },
        )
        if not len(self.conv_channels) == len(self.conv_kernels) == len(self.conv_strides) >= 1:
            raise ConfigError(
                "agent.conv_channels, conv_kernels, conv_strides: got lengths "
                f"{len(self.conv_channels)}, {len(self.conv_kernels)}, {len(self.conv_strides)}, want one equal length"
            )
        if min(*self.conv_channels, *self.conv_kernels, *self.conv_strides) < 1:
            raise ConfigError("agent.conv_channels, conv_kernels, conv_strides: want integers of at least 1")
        if self.v_min is not None and self.v_max is not None and not self.v_min < self.v_max:
            raise ConfigError(f"agent.v_min, v_max: got {self.v_min}, {self.v_max}, want v_min < v_max")

    def value_range(self, v_min: float, v_max: float) -> tuple[float, float]:
        """(v_min, v_max) as configured; what is left open is the given one, that of the scenario's returns."""
        return v_min if self.v_min is None else self.v_min, v_max if self.v_max is None else self.v_max


@dataclass(frozen=True, kw_only=True, slots=True)
class ReplayConfig:
    """The prioritized replay. Source: thesis 4.1.1, eq. 4.11-4.13, Table 5.2."""

    capacity: int = 100_000
    """step records kept on the learner's device, over all games"""
    prioritized: bool = True
    """sample in proportion to priority; off samples uniformly"""
    priority_exponent: float = 0.6
    """omega: 0 is uniform, 1 fully proportional"""
    importance_sampling_exponent: float = 0.4
    """beta at the start of training"""
    importance_sampling_exponent_end: float = 1.0
    """beta at the end of training"""
    min_priority: float = 0.01
    """added to a TD error before the exponent"""
    num_newest: int = 0
    """newest transitions at the end of every batch (combined experience replay)"""

    def __post_init__(self) -> None:
        _check(
            "replay",
            self,
            {
                "capacity": (64, 10**9),
                "priority_exponent": (0.0, 2.0),
                "importance_sampling_exponent": (0.0, 1.0),
                "importance_sampling_exponent_end": (0.0, 1.0),
                "min_priority": (1e-8, 100.0),
                "num_newest": (0, 10**6),
            },
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class LearnerConfig:
    """The update loop. A gradient step is one update; steps are decisions of the agent. Source: Tables 5.1, 5.2."""

    total_updates: int = 200_000
    """gradient steps of the whole run"""
    warmup_steps: int = 10_000
    """decisions gathered before the first update, by uniformly random actions"""
    env_steps_per_update: float = 4.0
    """decisions (all games together) per gradient step after warm-up; Rainbow's published ratio"""
    step_tolerance: int = 256
    """decisions by which learner and actors may run apart"""
    batch_size: int = 32
    """transitions a gradient step"""
    num_updates_per_call: int | None = None
    """gradient steps in one jitted call; default 1 on a CPU, 8 on a GPU"""
    learning_rate: float = 1e-4
    """Adam"""
    adam_eps: float = 1e-7
    """Adam"""
    max_grad_norm: float | None = None
    """clip the global gradient norm; default off, as in the thesis"""
    target_period_updates: int = 3_000
    """gradient steps between copies into the target network"""
    publish_period_updates: int = 10
    """gradient steps between publications of the parameters to the actors"""
    kpi_weighting: bool = False
    """scale a sample's loss by max KPI / KPI of its task (eq. 4.19, 4.20)"""
    kpi_window_episodes: int = 30
    """episodes in the running mean of a task's score"""
    kpi_max_weight: float = 10.0
    """bound of a task's weight"""

    def __post_init__(self) -> None:
        _check(
            "learner",
            self,
            {
                "total_updates": (1, 10**12),
                "warmup_steps": (1, 10**12),
                "env_steps_per_update": (0.001, 10**6),
                "step_tolerance": (1, 10**9),
                "batch_size": (1, 65536),
                "num_updates_per_call": (1, 10**4),
                "learning_rate": (1e-12, 10.0),
                "adam_eps": (1e-16, 1.0),
                "max_grad_norm": (1e-12, 1e12),
                "target_period_updates": (1, 10**12),
                "publish_period_updates": (1, 10**9),
                "kpi_window_episodes": (1, 10**6),
                "kpi_max_weight": (1.0, 10**6),
            },
        )
