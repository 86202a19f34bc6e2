"""An own agent that gives wrong things is refused before anything is played, and the error says what and where."""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import pytest

from gvz.core.errors import ConfigError
from gvz.core.registry import discover
from gvz.run.assemble import assemble
from gvz.run.config_files import load_config
from learner.agents.base import AgentSpec, make_agent
from learner.agents.configs.dqn import DQNConfig
from learner.agents.configs.ppo import PPOConfig
from learner.agents.dqn import DQN
from learner.agents.ppo import PPO
from learner.config import agent_config_class
from learner.contract import check_agent

SPEC = AgentSpec(obs_shape=(8, 8, 2), num_actions=4, num_tasks=2, v_min=-1.0, v_max=1.0, num_variables=2, masked=True)
SIZES: dict[str, Any] = {"conv_channels": (4,), "conv_kernels": (4,), "conv_strides": (2,), "hidden_units": 8}


def without_axes(x: jax.Array) -> jax.Array:
    return x.mean()


def one_column(x: jax.Array) -> jax.Array:
    return x[:, None]


def of(field: str, change: Callable[[jax.Array], Any]) -> Callable[[Any], Any]:
    """Changes one field of what a function gives."""
    return lambda found: found._replace(**{field: change(getattr(found, field))})


@pytest.mark.parametrize("name", [name for name, one in discover("learner.agents").items() if hasattr(one, "AGENT")])
def test_every_agent_of_the_package_passes(name: str):
    kind = agent_config_class(name)
    for spec in (SPEC, replace(SPEC, masked=False, num_variables=0, num_past_actions=2)):
        check_agent(make_agent(kind(name=name, **SIZES), spec), on_policy=kind.on_policy)


@pytest.mark.parametrize(
    ("kind", "function", "change", "message"),
    [
        (DQN, "loss", of("loss", one_column), "gives loss float32[3, 1], want float32[3], where a batch has 3 samples"),
        (DQN, "loss", of("loss", lambda x: x.astype(jnp.bfloat16)), "gives loss bfloat16[3], want float32[3]"),
        (DQN, "loss", of("priority", without_axes), "gives priority float32[], want float32[3]"),
        (DQN, "loss", of("td_error", lambda _: None), "gives td_error NoneType, want float32[3]"),
        (DQN, "loss", tuple, "gives tuple, want AgentLoss(loss, priority, q_tm1, td_error)"),
        (
            DQN,
            "init",
            lambda x: jax.tree.map(lambda w: w.astype(jnp.bfloat16), x),
            "gives ['params']['conv_0']['bias'] ",
        ),
        (DQN, "act", lambda x: x[0], "gives int32[3], want two arrays, (action, extras)"),
        (DQN, "act", lambda x: (x[0][:, None], x[1]), "gives action int32[3, 1], want int32[3]"),
        (DQN, "act", lambda x: (x[0].astype(jnp.float32), x[1]), "gives action float32[3], want int32[3]"),
        (DQN, "act", lambda x: (x[0], None), "gives extras NoneType, want float32[3, E]"),
        (DQN, "act", lambda x: (x[0], jnp.zeros(3)), "gives extras float32[3], want float32[3, E]"),
        (DQN, "evaluate", lambda x: x.action, "gives int32[3], want Evaluation(action, q_values"),
        (DQN, "evaluate", of("action", lambda x: x[0]), "gives action int32[], want int32[3]"),
        (DQN, "evaluate", of("q_values", jnp.transpose), "gives q_values float32[4, 3], want float32[3, 4]"),
        (PPO, "evaluate", of("value", one_column), "gives value float32[3, 1], want float32[3]"),
        (PPO, "targets", of("returns", jnp.transpose), "gives returns float32[3, 2], want float32[2, 3]"),
        (PPO, "targets", of("advantages", jnp.ravel), "gives advantages float32[6], want float32[2, 3]"),
        (PPO, "losses", of("loss", without_axes), "gives loss float32[], want float32[3]"),
        (PPO, "losses", of("metrics", lambda _: {"x": jnp.zeros(())}), "gives metrics['x'] float32[], want float32[3]"),
        (PPO, "losses", lambda x: x._replace(metrics={"loss": x.loss}), "gives metrics named loss, want other names"),
        (PPO, "losses", of("metrics", lambda _: None), "gives metrics NoneType, want dict"),
    ],
)
def test_what_a_function_gives_wrong_is_named(kind: Any, function: str, change: Callable[[Any], Any], message: str):
    def wrong(self: Any, *arguments: Any) -> Any:
        return change(getattr(kind, function)(self, *arguments))

    wrong.__qualname__ = f"Mine.{function}"
    mine = dataclass(frozen=True)(type("Mine", (kind,), {function: wrong}))
    config = (DQNConfig if kind is DQN else PPOConfig)(**SIZES)
    with pytest.raises(ConfigError, match=re.escape(f"agent.name: Mine.{function} {message}")):
        check_agent(mine(config, SPEC), on_policy=config.on_policy)


def test_missing_functions_are_named():
    class Mine:
        spec, init, act, loss = SPEC, None, None, None

    for on_policy, missing in ((False, "epsilon, evaluate"), (True, "epsilon, evaluate, targets, losses")):
        with pytest.raises(ConfigError, match=rf"agent\.name: Mine has no {missing}, .* `on_policy = {on_policy}`"):
            check_agent(Mine(), on_policy=on_policy)


def test_an_agent_that_cannot_be_hashed_is_refused():
    class Mine(DQN):
        __hash__ = None  # pyright: ignore

    with pytest.raises(ConfigError, match=r"agent\.name: Mine cannot be hashed \(unhashable type: 'Mine'\); want a f"):
        check_agent(Mine(DQNConfig(**SIZES), SPEC), on_policy=False)


def test_a_run_of_a_wrong_agent_is_refused_before_it_plays(tmp_path: Path):
    file = tmp_path / "mine.py"
    file.write_text(
        "from learner.agents.configs.dqn import DQNConfig as CONFIG\n"
        "from learner.agents.dqn import DQN\n"
        "class Mine(DQN):\n"
        "    def loss(self, *arguments):\n"
        "        found = DQN.loss(self, *arguments)\n"
        "        return found._replace(priority=found.priority.max())\n"
        "AGENT = Mine\n"
    )
    config = load_config("dqn_quick")
    config = replace(config, agent=replace(config.agent, name=str(file)))
    with pytest.raises(ConfigError, match=re.escape("Mine.loss gives priority float32[], want float32[3]")):
        assemble(config, tmp_path)


def test_a_run_traces_how_an_agent_acts_once_to_check_it_and_once_for_its_actors(tmp_path: Path, monkeypatch: Any):
    act, batch_sizes = DQN.act, list[int]()

    def counted(self: Any, params: Any, key: Any, obs: Any, epsilon: Any) -> Any:
        batch_sizes.append(len(obs.task))
        return act(self, params, key, obs, epsilon)

    monkeypatch.setattr(DQN, "act", counted)
    config = load_config("dqn_quick")
    assemble(config, tmp_path)
    assert batch_sizes == [3, config.games_per_actor]


@pytest.mark.parametrize(
    ("features", "given"),
    [
        ("x", "float32[3, 8, 8, 2]"),
        ("x.mean((1, 2, 3))", "float32[3]"),
        ("x.reshape(1, -1)", "float32[1, 384]"),
        ("x.reshape(3, -1).astype('int32')", "int32[3, 128]"),  # weights of integers would be 0
        ("None", "NoneType[]"),
    ],
)
def test_an_encoder_without_a_row_of_floats_for_each_image_is_refused(tmp_path: Path, features: str, given: str):
    file = tmp_path / "flat.py"
    file.write_text(f"def ENCODER(x, config):\n    return {features}\nENCODER = ENCODER\n")
    agent = DQN(DQNConfig(encoder=str(file), **SIZES), SPEC)
    with pytest.raises(ConfigError, match=re.escape(f"flat.py' gives features {given}, want float32[B, F] with B = 3")):
        agent.network().init(jax.random.key(0), SPEC.zeros(3))
