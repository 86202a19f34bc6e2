"""The defaults are the thesis's tables, and every ready configuration is Rainbow less what its name says."""

import json
import re
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from gvz.core.errors import ConfigError
from gvz.run.config import RunConfig
from gvz.run.config_files import config_to_dict, configs_directory, load_config
from gvz.run.curriculum_config import CurriculumConfig
from learner.agents.configs.ppo import PPOConfig
from learner.agents.configs.pqn import PQNConfig
from learner.agents.configs.rainbow import RainbowConfig
from learner.config import LearnerConfig, OnPolicyConfig, ReplayConfig

PAGE = (Path(__file__).parents[2] / "docs" / "AGENTS.md").read_text()
RESULTS = Path(__file__).parents[2] / "results"


def settings(config: RunConfig) -> dict[str, object]:
    parts = {"agent": config.agent, "replay": config.replay, "learner": config.learner}
    return {f"{part}.{name}": value for part, values in parts.items() for name, value in asdict(values).items()}


def test_defaults_are_tables_5_1_and_5_2():
    values = settings(RunConfig(name="defaults"))
    table_5_1 = {
        "learner.target_period_updates": 3000,
        "learner.warmup_steps": 10_000,  # "gathering experience"
        "agent.epsilon_decay_steps": 50_000,
        "agent.epsilon_start": 1.0,
        "agent.epsilon_end": 0.001,
        "agent.discount": 0.99,
        "learner.learning_rate": 1e-4,
        "learner.adam_eps": 1e-7,
        "learner.batch_size": 32,
    }
    table_5_2 = {
        "replay.capacity": 100_000,  # section 5.1.2
        "agent.n_steps": 3,
        "agent.noisy_sigma": 0.017,
        "replay.priority_exponent": 0.6,
        "replay.importance_sampling_exponent": 0.4,
        "replay.importance_sampling_exponent_end": 1.0,
        "replay.min_priority": 0.01,
        "agent.num_atoms": 51,
    }
    off_by_default = {"learner.kpi_weighting": False, "replay.num_newest": 0}  # 4.3.2, 4.1.1: rainbow_4task_thesis
    for name, wanted in {**table_5_1, **table_5_2, **off_by_default}.items():
        assert values[name] == wanted, name
    assert RunConfig(name="defaults").env.frame_skip == 4
    assert load_config("dqn_4task").replay.capacity == 50_000


ALL_OFF = RainbowConfig(double=False, dueling=False, noisy="off", distributional=False)
DQN = {
    "agent.name": "dqn",
    "agent.n_steps": 1,
    "replay.prioritized": False,
    "replay.capacity": 50_000,
}


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("rainbow_no_double", {"agent.double": False}),
        ("rainbow_no_dueling", {"agent.dueling": False}),
        ("rainbow_no_noisy", {"agent.noisy": "off"}),
        ("rainbow_no_distributional", {"agent.distributional": False}),
        ("rainbow_no_n_step", {"agent.n_steps": 1}),
        ("rainbow_no_prioritized", {"replay.prioritized": False}),
        ("rainbow_hidden_4096", {"agent.hidden_units": 4096}),
        ("rainbow_4task_thesis", {"learner.kpi_weighting": True, "replay.num_newest": 3}),
        ("dqn_4task", DQN),
    ],
)
def test_a_ready_configuration_differs_from_rainbow_by_what_its_name_says(name: str, changes: dict[str, object]):
    rainbow, config = load_config("rainbow_4task"), load_config(name)
    before, after = settings(rainbow), settings(config)
    assert {field: after[field] for field in after if after[field] != before[field]} == changes
    same = {part: getattr(rainbow, part) for part in ("name", "agent", "replay", "learner")}
    assert replace(config, **same) == rainbow


@pytest.mark.parametrize("name", ["rainbow_4task", "rainbow_4task_thesis", "dqn_4task"])
def test_parts_beyond_the_thesis_are_off_in_its_configurations(name: str):
    """The flags of the page's table. Strength and clean share have no effect without an augmentation."""
    (section,) = re.findall(r"## Parts beyond the thesis\n(.*?)\n## ", PAGE, re.DOTALL)
    flags = {flag.replace("-", "_") for flag in re.findall(r"--((?:agent|env|learner)\.[a-z-]+)", section)}
    assert len(flags) >= 18
    config = load_config(name)
    values = {flag: getattr(getattr(config, part), field, None) for flag in flags for part, field in [flag.split(".")]}
    without_effect = {"agent.augmentation_strength": 1.0, "agent.augmentation_clean_share": 0.5}
    on = {flag: value for flag, value in values.items() if value}
    assert on == {"agent.encoder": "nature", "learner.adam_eps": 1e-7} | without_effect
    assert config.env.frames == "screen"


@pytest.mark.parametrize(
    "pattern",
    [
        "rainbow_quick/*",
        "rainbow_4task/*",
        "rainbow_all",
        "general/**",
        "general_gpu/**",
        "general_on_policy/**",
        "gates/runs/p*_quick+plain/**",
    ],
)
def test_a_configuration_has_the_settings_of_its_published_runs(pattern: str):
    """But for the number of gradient steps: processor time ends these runs. Variants of an experiment have a plus."""
    saved = [json.loads(file.read_text())["config"] for file in RESULTS.glob(f"{pattern}/config.json")]
    plain = [run for run in saved if "+" not in run["name"].removesuffix("+plain")]
    assert plain
    for run in plain:
        task = (run["tasks"] or [run["scenario"]])[0]
        config = config_to_dict(load_config(run["name"].removesuffix("+plain"), task.partition("/")[0]))["config"]
        for part in ("env", "agent", "replay", "learner"):
            now = json.loads(json.dumps(config[part])) or {}
            assert now | (run[part] or {}) | {"total_updates": 0} == now | {"total_updates": 0}, run["name"]


def test_the_page_says_what_each_configuration_has_of_the_recipe():
    written = {name: row.split(" | ") for name, row in re.findall(r"^\| `(\w+)` \| ((?:yes|no) .*) \|$", PAGE, re.M)}
    files = sorted(file.stem for file in configs_directory().glob("*.py") if file.stem != "__init__")
    names = [name for name in files if not load_config(name).agent.on_policy]
    assert list(written) == names

    def word(value: object) -> str:
        return {True: "yes", False: "no"}[value] if isinstance(value, bool) else str(value)

    for name in names:
        config = load_config(name)
        agent, replay = config.agent, config.replay
        rainbow = agent if isinstance(agent, RainbowConfig) else ALL_OFF
        parts = (rainbow.double, rainbow.dueling, rainbow.noisy == "factorized", rainbow.distributional, agent.n_steps)
        more = replay.prioritized, config.learner.kpi_weighting, replay.num_newest, agent.hidden_units
        assert written[name] == [word(value) for value in (*parts, *more)], name


def test_the_guide_says_what_each_configuration_is_for():
    guide = (Path(__file__).parents[2] / "docs" / "how-to" / "train.md").read_text()
    rows = re.findall(r"^\| (`.*?) \| (.*?) \| (.*) \|$", guide, re.M)
    lengths = {name: length for names, _, length in rows for name in re.findall(r"`([\w.]+)`", names)}
    for file in configs_directory().glob("[!_]*.py"):
        length = lengths["rainbow_no_..." if file.stem.startswith("rainbow_no_") else file.stem]
        assert f"{load_config(file.stem).learner.total_updates:,} gradient steps" in length or "decisions" in length


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: RainbowConfig(n_steps=0), r"agent\.n_steps: got 0, want 1\.\.64"),
        (lambda: RainbowConfig(conv_channels=(32,)), r"got lengths 1, 3, 3, want one equal length"),
        (lambda: RainbowConfig(conv_strides=(4, 0, 1)), r"conv_strides: want integers of at least 1"),
        (lambda: RainbowConfig(v_min=2.0, v_max=1.0), r"got 2\.0, 1\.0, want v_min < v_max"),
        (lambda: ReplayConfig(min_priority=0.0), r"replay\.min_priority: got 0\.0, want 1e-08\.\.100"),
        (lambda: LearnerConfig(max_grad_norm=0.0), r"learner\.max_grad_norm: got 0\.0, want 1e-12\.\.1e\+12"),
        (lambda: LearnerConfig(target_ema=1.0), r"learner\.target_ema: got 1\.0, want 0\.\.0\.99999"),
        (lambda: LearnerConfig(average_ema=1.0), r"learner\.average_ema: got 1\.0, want 0\.\.0\.99999"),
        (lambda: OnPolicyConfig(average_ema=1.0), r"learner\.average_ema: got 1\.0, want 0\.\.0\.99999"),
        (lambda: PQNConfig(td_lambda=1.5), r"agent\.td_lambda: got 1\.5, want 0\.\.1"),
        (lambda: PPOConfig(clip=0.0), r"agent\.clip: got 0\.0, want 1e-06\.\.1000000"),
    ],
)
def test_values_out_of_range_are_refused_by_name(make, message: str):
    with pytest.raises(ConfigError, match=message):
        make()


@pytest.mark.parametrize(
    ("make", "got", "other", "default"),
    [
        (
            lambda: RainbowConfig(munchausen=True, num_quantiles=5, double=False),
            "double: got False",
            "munchausen True",
            True,
        ),
        (lambda: RainbowConfig(munchausen_alpha=0.5), "munchausen_alpha: got 0.5", "munchausen False", 0.9),
        (lambda: RainbowConfig(num_quantiles=5, v_max=1.0), "v_max: got 1.0", "num_quantiles 5", None),
        (lambda: RainbowConfig(distributional=False, v_min=1.0), "v_min: got 1.0", "distributional False", None),
        (lambda: RainbowConfig(noisy="off", noisy_period_steps=9), "noisy_period_steps: got 9", "noisy off", 1),
        (lambda: RainbowConfig(noisy="off", noisy_epsilon=0.1), "noisy_epsilon: got 0.1", "noisy off", 0.0),
        (lambda: ReplayConfig(prioritized=False, min_priority=0.5), "min_priority: got 0.5", "prioritized False", 0.01),
        (lambda: LearnerConfig(kpi_max_weight=2.0), "kpi_max_weight: got 2.0", "kpi_weighting False", 10.0),
        (lambda: CurriculumConfig(window_episodes=5), "window_episodes: got 5", "kind fixed", 20),
        (lambda: CurriculumConfig(kind="uniform", window_episodes=5), "window_episodes: got 5", "kind uniform", 20),
        (lambda: CurriculumConfig(kind="level", temperature=2.0), "temperature: got 2.0", "kind level", 1.0),
        (
            lambda: CurriculumConfig(kind="progress", learned_percent=9.0),
            "learned_percent: got 9.0",
            "kind progress",
            50.0,
        ),
    ],
)
def test_a_setting_that_another_leaves_without_effect_is_refused(make, got: str, other: str, default: object):
    with pytest.raises(ConfigError) as raised:
        make()
    part, _, message = str(raised.value).partition(".")
    assert message == (
        f"{got}, which has no effect with {part}.{other}; want {default}, or another {part}.{other.split()[0]}"
    )
