"""Configuration of agents, replay and learners. jax is not imported here: `--help` and errors are to be quick."""

import dataclasses
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, Self

from gvz.core.errors import ConfigError
from gvz.core.ranges import Range, Share, check_ranges
from gvz.core.registry import find

ConvForm = Literal["auto", "direct", "shifted", "paired"]
Augmentation = Literal["shift", "vertical_shift", "random_conv", "contrast", "gamma", "inversion", "cutout", "grey"]
"""a function of learner/augment.py"""
MOST_UPDATES = 2**31 - 1
"""gradient steps of a run: they are counted with 32 bits"""
_Kept = Annotated[float | None, Range(0.0, 0.99999)]
"""share of itself that a moving average keeps. With 1 it never changes; near 1, float32 rounds its changes to 0."""


def unused(prefix: str, config: Any, other: str, *names: str) -> list[str]:
    """A line for each of these fields that is not at its default: `other` leaves it without effect."""
    because = f"which has no effect with {prefix}.{other} {getattr(config, other)}"
    return [
        f"{prefix}.{field.name}: got {got}, {because}; want {field.default}, or another {prefix}.{other}"
        for field in dataclasses.fields(config)
        if field.name in names and (got := getattr(config, field.name)) != field.default
    ]


def refuse_unused(prefix: str, config: Any, other: str, *names: str) -> None:
    """Raises ConfigError for the first of `unused`.

    Not for what a configuration has at hand for a part that another one, made of it by one field, switches on or off,
    such as `noisy_sigma`. A run only says so (`gvz.run.config.without_effect`).
    """
    for text in unused(prefix, config, other, *names):
        raise ConfigError(text)


@dataclass(frozen=True, kw_only=True, slots=True)
class AgentConfig:
    """What every agent has: what it observes, and its network. Each agent adds its own, in learner/agents/configs."""

    on_policy: ClassVar[bool] = False
    """it learns from rollouts (`OnPolicyConfig`, no replay), not from a replay"""

    name: str
    """module in learner/agents, or the path of a Python file (docs/AGENTS.md)"""
    discount: Annotated[float, Range(0.0, 0.99999)] = 0.99
    """gamma of one decision"""
    stack_size: Annotated[int, Range(1, 16)] = 4
    """frames in an observation"""
    past_actions: Annotated[int, Range(0, 64)] = 0
    """last actions in an observation"""
    game_variables: bool = False
    """observe the scenario's game variables (health, ammunition, ...)"""
    task_conditioned: bool = False
    """give the policy the task's index, pi(a | s, z) (eq. 4.18)"""
    scale_rewards: bool = False
    """scale each task's rewards so that the largest absolute value of its discounted returns is 1, for tasks of several
    scenarios; records and scores stay as they are"""
    encoder: str = "nature"
    """module in learner/encoders, or the path of a Python file: what makes features of frames"""
    conv_channels: tuple[int, ...] = (32, 64, 64)
    """output channels of the convolutions. The encoders small, impala, impala_height_pool and impoola have layers of
    fixed sizes: for them, conv_channels, conv_kernels and conv_strides have no effect"""
    conv_kernels: tuple[int, ...] = (8, 4, 3)
    """kernel sizes, pixels"""
    conv_strides: tuple[int, ...] = (4, 2, 1)
    """strides, pixels"""
    conv_form: ConvForm = "auto"
    """how convolutions are computed: shifted (matmul and shifted adds, for a CPU), direct (nn.Conv), or paired (direct,
    two images at a time); auto: actors paired, the learner shifted on a CPU and direct elsewhere"""
    hidden_units: Annotated[int, Range(1, 65536)] = 512
    """units of the hidden layer, per stream if dueling"""
    activation_dtype: Literal["float32", "bfloat16"] = "float32"
    """dtype of activations; parameters and losses stay float32"""

    def __post_init__(self) -> None:
        check_ranges("agent", self)
        if not len(self.conv_channels) == len(self.conv_kernels) == len(self.conv_strides) >= 1:
            raise ConfigError(
                "agent.conv_channels, conv_kernels, conv_strides: got lengths "
                f"{len(self.conv_channels)}, {len(self.conv_kernels)}, {len(self.conv_strides)}, want one equal length"
            )
        if min(*self.conv_channels, *self.conv_kernels, *self.conv_strides) < 1:
            raise ConfigError("agent.conv_channels, conv_kernels, conv_strides: want integers of at least 1")

    @property
    def learns_sight(self) -> bool:
        """Transitions are to have what was in sight (`EnvConfig.sight`), for a loss of the agent."""
        return False

    def epsilon(self, env_steps: int) -> float:
        """Probability of a uniformly random action after this number of decisions since warm-up."""
        return 0.0

    def support(self, v_min: float, v_max: float) -> tuple[float, float] | None:
        """The range of the atoms of an agent that learns return distributions; None for any other agent.

        Args:
            v_min: smallest return of the run's tasks.
            v_max: largest return.
        """
        return None

    def with_support(self, v_min: float, v_max: float) -> Self:
        """The same with atoms of this range, if it has atoms."""
        return self


@dataclass(frozen=True, kw_only=True, slots=True)
class EpsilonConfig(AgentConfig):
    """An agent that learns action values, and acts at random with probability epsilon."""

    initial_value: float = 0.0
    """Q(s, a) of a fresh network, for every state and action; inside the atoms' range if distributional"""
    epsilon_start: Share = 1.0
    """epsilon after warm-up, before decay; used when there is no noise"""
    epsilon_end: Share = 0.001
    """epsilon after decay"""
    epsilon_decay_steps: Annotated[int, Range(1, 10**12)] = 50_000
    """decisions over which epsilon falls linearly, counted after warm-up; PQN's code has a tenth of all"""

    def epsilon(self, env_steps: int) -> float:
        progress = min(1.0, env_steps / self.epsilon_decay_steps)
        return self.epsilon_start + progress * (self.epsilon_end - self.epsilon_start)


@dataclass(frozen=True, kw_only=True, slots=True)
class ValueConfig(EpsilonConfig):
    """An agent that learns from n-step transitions. Source: thesis Tables 5.1 and 5.2."""

    n_steps: Annotated[int, Range(1, 64)] = 1
    """n of the n-step return (eq. 4.15); 1 switches it off"""
    augmentations: tuple[Augmentation, ...] = ()
    """random changes of the online network's frames in training (learner/augment.py), in this order. Targets see clean
    frames"""
    augmentation_strength: Share = 1.0
    """0..1, of every augmentation"""
    augmentation_clean_share: Share = 0.5
    """share of a batch that stays clean"""
    hidden_input_share: Share = 0.0
    """share of a batch whose game variables and past actions are hidden from the online network in training"""

    def __post_init__(self) -> None:
        EpsilonConfig.__post_init__(self)  # super() knows no class with slots
        if self.hidden_input_share and not (self.game_variables or self.past_actions):
            raise ConfigError(
                f"agent.hidden_input_share: got {self.hidden_input_share:g} with nothing to hide; set "
                "agent.game_variables or agent.past_actions"
            )


def agent_config_class(name: str) -> type[AgentConfig]:
    """The configuration class of an agent: `CONFIG` of a module in learner/agents/configs, or of the agent's own file.

    Args:
        name: a module's name, or the path of a Python file, which is executed.

    Raises:
        ConfigError: no such agent, or what its file sets is no such class.
    """
    kind = find("learner.agents.configs", "CONFIG", name, "agent.name")
    if not (isinstance(kind, type) and issubclass(kind, AgentConfig)):
        raise ConfigError(
            f"agent.name: {name} sets CONFIG to {kind!r}, want a class made from one of learner/config.py, such as "
            "ValueConfig"
        )
    for field in dataclasses.fields(kind):
        if field.name != "name" and dataclasses.MISSING is field.default is field.default_factory:
            raise ConfigError(f"agent.name: {field.name} of {kind.__name__} in {name} has no default, want one")
    return kind


def change_agent(config: AgentConfig, name: str) -> AgentConfig:
    """The configuration of another agent, with what `config` sets otherwise than by default, where both have it.

    Raises:
        ConfigError: no such agent, or its configuration does not take these values.
    """
    kind = agent_config_class(name)
    wanted = {field.name for field in dataclasses.fields(kind)} - {"name"}
    default = type(config)(name=config.name)
    values = {f.name: getattr(config, f.name) for f in dataclasses.fields(config) if f.name in wanted}
    shared: dict[str, Any] = {name: value for name, value in values.items() if value != getattr(default, name)}
    try:
        return kind(name=name, **shared)
    except ConfigError as error:
        raise ConfigError(
            f"{error}. The values are those of the config file, which agent.name keeps; give a config file that fits"
        ) from error


@dataclass(frozen=True, kw_only=True, slots=True)
class ReplayConfig:
    """The prioritized replay. Source: thesis 4.1.1, eq. 4.11-4.13, Table 5.2."""

    capacity: Annotated[int, Range(64, 10**9)] = 100_000
    """step records kept on the learner's device, over all games"""
    prioritized: bool = True
    """sample in proportion to priority; off samples uniformly"""
    equal_shares: bool = False
    """every game gives the same share of a batch; priorities choose within a game. For tasks whose errors differ in
    size, such as those of several scenarios"""
    priority_exponent: Annotated[float, Range(0.0, 2.0)] = 0.6
    """omega: 0 is uniform, 1 fully proportional"""
    importance_sampling_exponent: Share = 0.4
    """beta at the start of training"""
    importance_sampling_exponent_end: Share = 1.0
    """beta at the end of training"""
    min_priority: Annotated[float, Range(1e-8, 100.0)] = 0.01
    """added to a TD error before the exponent"""
    num_newest: Annotated[int, Range(0, 10**6)] = 0
    """newest transitions at the end of every batch (combined experience replay)"""

    def __post_init__(self) -> None:
        check_ranges("replay", self)
        if not self.prioritized:
            refuse_unused("replay", self, "prioritized", "priority_exponent", "min_priority")


@dataclass(frozen=True, kw_only=True, slots=True)
class LearnerConfig:
    """The update loop. A gradient step is one update; steps are decisions of the agent. Source: Tables 5.1, 5.2."""

    total_updates: Annotated[int, Range(1, MOST_UPDATES)] = 200_000
    """gradient steps of the whole run"""
    warmup_steps: Annotated[int, Range(1, 10**12)] = 10_000
    """decisions gathered before the first update, by uniformly random actions"""
    env_steps_per_update: Annotated[float, Range(0.001, 10**6)] = 16.0
    """decisions (all games together) per gradient step after warm-up. A gate chose 16 (docs/FINDINGS.md); the thesis
    gives none, and Rainbow for Atari has 4"""
    step_tolerance: Annotated[int, Range(1, 10**9)] = 256
    """decisions by which learner and actors may run apart"""
    batch_size: Annotated[int, Range(1, 65536)] = 32
    """transitions a gradient step"""
    devices: Annotated[int, Range(1, 1024)] = 1
    """devices of this machine that learn together, each with the replay of an equal part of the games and an equal part
    of a batch (docs/CLUSTER.md)"""
    num_updates_per_call: Annotated[int | None, Range(1, 10**4)] = None
    """gradient steps in one jitted call; default 1 on a CPU, 8 on a GPU"""
    learning_rate: Annotated[float, Range(1e-12, 10.0)] = 1e-4
    """Adam"""
    adam_eps: Annotated[float, Range(1e-16, 1.0)] = 1e-7
    """Adam"""
    max_grad_norm: Annotated[float | None, Range(1e-12, 1e12)] = None
    """clip the global gradient norm; default off, as in the thesis"""
    weight_decay: Annotated[float, Range(0.0, 10.0)] = 0.0
    """Adam's decoupled decay of all weights (AdamW), times the learning rate"""
    target_ema: _Kept = None
    """share of themselves that target parameters keep at a gradient step (0.995: a moving average); default: copies
    every target_period_updates"""
    average_ema: _Kept = None
    """likewise of a moving average of the parameters, which checkpoints keep for evaluation; default: no average"""
    target_period_updates: Annotated[int, Range(1, MOST_UPDATES)] = 3_000
    """gradient steps between copies into the target network"""
    publish_period_updates: Annotated[int, Range(1, 10**9)] = 10
    """gradient steps between publications of the parameters to the actors"""
    kpi_weighting: bool = False
    """scale a sample's loss by max KPI / KPI of its task (eq. 4.19, 4.20)"""
    kpi_window_episodes: Annotated[int, Range(1, 10**6)] = 30
    """episodes in the running mean of a task's score"""
    kpi_max_weight: Annotated[float, Range(1.0, 10**6)] = 10.0
    """bound of a task's weight"""

    def __post_init__(self) -> None:
        check_ranges("learner", self)
        if not self.kpi_weighting:
            refuse_unused("learner", self, "kpi_weighting", "kpi_window_episodes", "kpi_max_weight")


@dataclass(frozen=True, kw_only=True, slots=True)
class OnPolicyConfig:
    """The learner of agents without a replay: rollouts of all games, each learnt from and dropped.

    Defaults: PPO's for Atari, Schulman et al. 2017, Table 5 (its 3 epochs, and batches of a quarter of a rollout), but
    for the learning rate, which falls there to 0. Adam's epsilon and the clipping are those of OpenAI's published code.
    """

    total_updates: Annotated[int, Range(1, MOST_UPDATES)] = 200_000
    """gradient steps of the whole run"""
    rollout_steps: Annotated[int, Range(1, 10**6)] = 128
    """steps of a window; a rollout is as many windows as there are games"""
    num_epochs: Annotated[int, Range(1, 1000)] = 3
    """passes over a rollout"""
    num_minibatches: Annotated[int, Range(1, 10**6)] = 4
    """equal parts of a rollout, a gradient step each"""
    learning_rate: Annotated[float, Range(1e-12, 10.0)] = 2.5e-4
    """Adam"""
    learning_rate_decay: bool = False
    """the learning rate falls linearly, to 0 at total_updates"""
    optimizer: Literal["adam", "radam"] = "adam"
    """radam is rectified Adam, as in PQN's published code"""
    adam_eps: Annotated[float, Range(1e-16, 1.0)] = 1e-5
    """Adam"""
    max_grad_norm: Annotated[float | None, Range(1e-12, 1e12)] = 0.5
    """clip the global gradient norm"""
    average_ema: _Kept = None
    """share of itself that a moving average of the parameters keeps at a gradient step. Evaluation plays with the
    average; default: no average"""
    devices: int = 1
    """always 1: several devices are for agents that learn from a replay"""

    def __post_init__(self) -> None:
        check_ranges("learner", self)
        if self.devices != 1:
            raise ConfigError(
                f"learner.devices: got {self.devices} for an agent that learns on-policy, want 1: several devices are "
                "for agents that learn from a replay"
            )

    @property
    def updates_per_rollout(self) -> int:
        """Gradient steps that a rollout is learnt from by."""
        return self.num_epochs * self.num_minibatches

    @property
    def publish_period_updates(self) -> int:
        """Gradient steps between publications of the parameters: one after each rollout."""
        return self.updates_per_rollout

    @property
    def warmup_steps(self) -> int:
        """Decisions by chance before the first update: none, the agent explores from the start."""
        return 0
