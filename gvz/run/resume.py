"""What may change in the configuration of a run that is resumed."""

from pathlib import PurePath
from typing import Any

from gvz.core.env_config import leaves
from gvz.run.config import RunConfig
from learner.config import OnPolicyConfig

_MAY_CHANGE = (
    "run_dir",
    "name",
    "max_processor_s",
    "learner.total_updates",
    "actors.placement",
    "actors.inference",
    "actors.ring_capacity",
    "actors.start_timeout_s",
    "actors.heartbeat_timeout_s",
    "actors.max_restarts",
    "actors.restart_window_s",
    "actors.recycle_episodes",
    "learner.num_updates_per_call",
    "learner.devices",
    "group.process_id",
    "group.coordinator",
    "agent.conv_form",
    "cluster.*",
    "checkpoint.*",
    "log.*",
)
"""Fields that leave a run what it was; of a longer one, `changed_schedules` tells. The others change its meaning."""


def may_change(name: str) -> bool:
    """Whether this field of a configuration, a dotted name, leaves a run what it was."""
    return name in _MAY_CHANGE or f"{name.split('.')[0]}.*" in _MAY_CHANGE


def differences(old: RunConfig, new: RunConfig) -> list[str]:
    """`field: old -> new` for every difference that would change the meaning of a run that goes on.

    Args:
        old: as it was saved, with the range of its atoms (`config_from_dict`).
        new: as it was given: an open range is what it is derived to be now.
    """

    before, after = _values(old), _values(new.with_support(new.support))
    names = [name for name in {**before, **after} if not may_change(name)]
    changed = [f"{k}: {before.get(k)} -> {after.get(k)}" for k in names if before.get(k) != after.get(k)]
    if new.learner.total_updates < old.learner.total_updates:
        changed.append(
            f"learner.total_updates: {old.learner.total_updates} -> {new.learner.total_updates} (it may only grow)"
        )
    return changed


def changed_schedules(old: RunConfig, new: RunConfig) -> list[str]:
    """What goes by the number of gradient steps of the whole run and so has other values from now on, a line each."""
    before, after = old.learner.total_updates, new.learner.total_updates
    if before == after:
        return []
    found: list[str] = []
    if isinstance(new.learner, OnPolicyConfig) and new.learner.learning_rate_decay:
        found.append("the learning rate, which falls to 0 at its end,")
    replay = new.replay
    # a draw without priorities is not uniform where games or devices have equal shares of it, whatever they hold
    if replay is not None and (replay.prioritized or replay.equal_shares or new.learner.devices > 1):
        first, last = replay.importance_sampling_exponent, replay.importance_sampling_exponent_end
        if first != last:
            found.append(f"the importance-sampling exponent, which goes from {first:g} to {last:g} by its end,")
    return [
        f"learner.total_updates: {before} -> {after}: {what} is from now on that of a run of {after} gradient steps"
        for what in found
    ]


def _values(config: RunConfig) -> dict[str, Any]:
    """Every field by its dotted name, with the tasks and sizes that follow from the fields."""
    derived = {
        "tasks": config.table.ids,
        "actors.num_actors": config.num_actors,
        "actors.games_per_actor": config.games_per_actor,
        "agent.name": str(PurePath(config.agent.name)),  # of a file, ./own.py and own.py are one
        "agent.encoder": str(PurePath(config.agent.encoder)),
    }
    return {k: v for k, v in {**dict(leaves(config)), **derived}.items() if k not in ("scenario", "training_set")}
