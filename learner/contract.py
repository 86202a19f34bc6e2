"""Whether an agent's functions give what actors and learner take: looked at once, before anything is played.

Only shapes are worked out. Without this, the first errors would come after the warm-up, and some wrong shapes would
never be an error: JAX would broadcast a priority without axes over the batch, and a rollout's targets with their two
axes exchanged would go to other steps.
"""

from dataclasses import fields
from typing import Any

import jax
import jax.numpy as jnp

from gvz.core.errors import ConfigError
from learner.agents.base import AgentLoss, Evaluation, RolloutSteps, SampleLosses, Samples, Targets
from learner.networks import Params
from learner.replay import Transitions
from learner.rollout_step import MetricSums

_B, _T = 3, 2
"""samples of a batch, or games of a rollout, and its steps: two numbers, so that exchanged axes are seen"""


def check_agent(agent: Any, *, on_policy: bool) -> tuple[Params, int]:
    """Checks the functions of an agent, and that it can be hashed.

    Args:
        agent: what a file's `AGENT` has made.
        on_policy: whether its configuration says that it learns from rollouts.

    Returns:
        The shapes of its parameters, and how many numbers it wants to be recorded with an action.

    Raises:
        ConfigError: a function is missing, or gives something of another kind, shape or dtype.
    """
    learns_by = ("targets", "losses") if on_policy else ("loss",)
    names = ("spec", "epsilon", "init", "act", "evaluate", *learns_by)
    if missing := [name for name in names if not hasattr(agent, name)]:
        raise ConfigError(
            f"agent.name: {_name(agent)} has no {', '.join(missing)}, which an agent has whose configuration says "
            f"`on_policy = {on_policy}` (docs/AGENTS.md)"
        )
    try:
        hash(agent)
    except TypeError as error:
        raise ConfigError(
            f"agent.name: {_name(agent)} cannot be hashed ({error}); want a frozen dataclass, without lists in "
            "it or in its configuration"
        ) from error

    key, obs = jax.random.key(0), agent.spec.zeros(_B)
    params = jax.eval_shape(agent.init, key)
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        _check(agent.init, jax.tree_util.keystr(path), leaf, leaf.shape)
    acted = jax.eval_shape(agent.act, params, key, obs, jnp.float32(0))
    if not (isinstance(acted, tuple) and len(acted) == 2):
        raise ConfigError(f"agent.name: {_name(agent.act)} gives {_text(acted)}, want two arrays, (action, extras)")
    action, extras = acted
    num_extras: Any = extras.shape[1] if len(getattr(extras, "shape", ())) == 2 else "E"
    _check(agent.act, "action", action, (_B,), "int32")
    _check(agent.act, "extras", extras, (_B, num_extras))
    evaluation = _fields(agent.evaluate, Evaluation, jax.eval_shape(agent.evaluate, params, obs))
    _check(agent.evaluate, "action", evaluation["action"], (_B,), "int32")
    of_actions = (_B, agent.spec.num_actions)
    for name, shape in (("q_values", of_actions), ("policy", of_actions), ("value", (_B,))):
        if evaluation[name] is not None:
            _check(agent.evaluate, name, evaluation[name], shape)
    if on_policy:
        _check_rollouts(agent, params, obs, num_extras)
    else:
        _check_transitions(agent, params, obs)
    return params, num_extras


def _check_transitions(agent: Any, params: Any, obs: Any) -> None:
    numbers, C = jnp.zeros(_B), agent.spec.num_sights
    batch = Transitions(
        obs_tm1=obs,
        a_tm1=jnp.zeros(_B, jnp.int32),
        r_t=numbers,
        discount_t=numbers,
        obs_t=obs,
        sight_tm1=jnp.zeros((_B, C), jnp.uint8) if C else None,
    )
    found = jax.eval_shape(agent.loss, params, params, jax.random.key(0), batch)
    for name, values in _fields(agent.loss, AgentLoss, found).items():
        _check(agent.loss, name, values, (_B,))


def _check_rollouts(agent: Any, params: Any, obs: Any, num_extras: int) -> None:
    flags, noted = jnp.zeros((_T, _B), bool), jnp.zeros((_T, _B, num_extras))
    steps = RolloutSteps(jnp.zeros((_T, _B)), flags, flags, noted, noted)
    for name, values in _fields(agent.targets, Targets, jax.eval_shape(agent.targets, steps)).items():
        _check(agent.targets, name, values, (_T, _B))
    numbers = jnp.zeros(_B)
    batch = Samples(obs, jnp.zeros(_B, jnp.int32), noted[0], Targets(numbers, numbers), numbers)
    found = _fields(agent.losses, SampleLosses, jax.eval_shape(agent.losses, params, batch))
    _check(agent.losses, "loss", found["loss"], (_B,))
    if not isinstance(found["metrics"], dict):
        raise ConfigError(f"agent.name: {_name(agent.losses)} gives metrics {_text(found['metrics'])}, want dict")
    if taken := {field.name for field in fields(MetricSums)} & found["metrics"].keys():
        raise ConfigError(
            f"agent.name: {_name(agent.losses)} gives metrics named {', '.join(sorted(taken))}, want other names: "
            "these are the learner's own"
        )
    for name, values in found["metrics"].items():
        _check(agent.losses, f"metrics[{name!r}]", values, (_B,))


def _fields(function: Any, kind: Any, found: Any) -> dict[str, Any]:
    """What a function gave, by name."""
    if not isinstance(found, kind):
        raise ConfigError(
            f"agent.name: {_name(function)} gives {_text(found)}, want {kind.__name__}({', '.join(kind._fields)})"
        )
    return found._asdict()


def _check(function: Any, what: str, found: Any, shape: tuple[Any, ...], dtype: str = "float32") -> None:
    if _text(found) != (wanted := f"{dtype}[{', '.join(map(str, shape))}]"):
        raise ConfigError(
            f"agent.name: {_name(function)} gives {what} {_text(found)}, want {wanted}, where a batch has {_B} samples "
            f"and a rollout {_T} steps of {_B} games (docs/AGENTS.md)"
        )


def _text(found: Any) -> str:
    is_array = isinstance(found, jax.ShapeDtypeStruct)
    return f"{found.dtype}{list(found.shape)}" if is_array else type(found).__name__


def _name(thing: Any) -> str:
    return getattr(thing, "__qualname__", type(thing).__name__)
