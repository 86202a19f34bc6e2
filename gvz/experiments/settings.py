"""Settings of a run that differ from its config file: dotted fields of RunConfig -> values."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from gvz.core.errors import ConfigError
from gvz.run.config import RunConfig, with_agent
from gvz.run.config_files import build_config

Settings = dict[str, Any]
"""field of RunConfig, dotted ("learner.batch_size") -> value"""


def with_settings(config: RunConfig, settings: Mapping[str, Any]) -> RunConfig:
    """The configuration with these values. "agent.name" changes the agent, and then its other fields.

    Raises:
        ConfigError: an unknown field, or a value that the configuration refuses.
    """
    if (agent := settings.get("agent.name")) is not None:
        config = with_agent(config, agent)
    plain = dataclasses.asdict(config)
    for name, value in settings.items():
        *groups, field = name.split(".")
        part: Any = plain
        for group in groups:
            part = part.get(group) if isinstance(part, dict) else None
        if not isinstance(part, dict) or field not in part or isinstance(part[field], dict):
            raise ConfigError(f"settings: got {name}, want a field of RunConfig, for example learner.batch_size")
        part[field] = value
    return build_config(plain, "settings", type(config.agent))
