"""The files of configurations: a Python file in configs/ or elsewhere, and the JSON of a run directory."""

import dataclasses
import importlib.util
import json
import os
import stat
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, get_args, get_type_hints

from gvz.core.env_config import typed
from gvz.core.errors import ConfigError, nearest
from gvz.core.registry import NO_OWN_FILES, OwnFiles, failed
from gvz.run.config import RunConfig, with_agent
from gvz.tasks import scenario_named
from learner.config import AgentConfig, LearnerConfig, OnPolicyConfig, agent_config_class

CONFIG_SCHEMA = 2
"""Raised by one whenever a saved config.json can no longer be read as before."""

Settings = dict[str, Any]
"""field of RunConfig, dotted ("learner.batch_size") -> value"""


def configs_directory() -> Path:
    """The installed configs package: beside gvz in a checkout and in a wheel."""
    spec = importlib.util.find_spec("configs")
    if spec is None or not spec.submodule_search_locations:
        raise ConfigError("configs: the package of config files is not installed beside gvz; reinstall gvizdoom")
    return Path(next(iter(spec.submodule_search_locations)))


def find_config_file(text: str) -> Path:
    """A bare name is found in configs/ (with or without .py); anything with a separator is a path.

    Raises:
        ConfigError: no such file; names the nearest.
    """
    path = Path(text)
    is_name = path.name == text
    if is_name:
        path = configs_directory() / (text if text.endswith(".py") else f"{text}.py")
    try:
        if stat.S_ISREG(path.stat().st_mode):
            return path
    except (FileNotFoundError, NotADirectoryError, ValueError):  # the last: a null byte
        pass  # said below
    except OSError as error:  # a name too long, a directory that may not be entered
        raise ConfigError(f"--config: {text!r} cannot be read: {error.strerror}") from error
    if not is_name:
        raise ConfigError(f"--config: no file {text!r} here ({Path.cwd()})")
    names = sorted(p.stem for p in configs_directory().glob("*.py") if p.stem != "__init__")
    hint = nearest(Path(text).stem, names)
    raise ConfigError(f"--config: no config {text!r}{hint}; there are {', '.join(names)} (or give a path: ./{text})")


def load_config(text: str, scenario: str | None = None) -> RunConfig:
    """Runs a config file and returns its `CONFIG`.

    Args:
        text: a name in configs/, or a path.
        scenario: whose settings count. A file may define `SCENARIO_SETTINGS`: scenario -> dotted field of RunConfig ->
            value. They hold for a run that plays tasks of this scenario alone, and flags come after them.

    Raises:
        ConfigError: no such file, it fails, it does not define `CONFIG: RunConfig`, or a setting does not fit.
    """
    path = find_config_file(text)
    try:
        namespace = _run(path, path.read_text())
        config = namespace.get("CONFIG")
        if not isinstance(config, RunConfig):
            raise ConfigError(f"got {type(config).__name__} for CONFIG, want `CONFIG = RunConfig(...)`")
        config = build_config(dataclasses.asdict(config), "CONFIG", type(config.agent))  # checks the types
        settings = namespace.get("SCENARIO_SETTINGS", {})
        for name in settings:
            scenario_named(name)  # or an error that names it
        return with_settings(config, settings.get(scenario, {}))
    except Exception as error:
        raise failed(error, path) from error


@lru_cache(maxsize=1)
def _run(path: Path, source: str) -> dict[str, Any]:
    """The names that a config file defines. It is run once, although a command reads it again for its scenario."""
    namespace: dict[str, Any] = {"__name__": f"configs.{path.stem}", "__file__": str(path)}
    exec(compile(source, str(path), "exec"), namespace)
    return namespace


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


def settings_flags(settings: Settings) -> tuple[str, ...]:
    """These values as words of the command line of `gvz train`."""
    return tuple(word for name, value in settings.items() for word in _flag(name.replace("_", "-"), value))


def _flag(name: str, value: Any) -> tuple[str, ...]:
    if isinstance(value, bool):
        group, _, field = name.rpartition(".")
        return (f"--{name}" if value else f"--{group}.no-{field}",)
    return (f"--{name}", *_words(value))


def _words(value: Any) -> tuple[str, ...]:
    return tuple(word for item in value for word in _words(item)) if isinstance(value, tuple | list) else (str(value),)


def config_to_dict(config: RunConfig) -> dict[str, Any]:
    """The configuration with its derived values, as plain JSON types."""
    if config.group.num_processes > 1:  # who reads it may be elsewhere, without Slurm's variables
        config = dataclasses.replace(config, group=dataclasses.replace(config.group, process_id=config.group.own_id))
    return {
        "schema": CONFIG_SCHEMA,
        "config": json.loads(json.dumps(dataclasses.asdict(config), default=os.fspath)),  # a tuple becomes a list
        "resolved": {
            "tasks": list(config.table.ids),
            "num_actors": config.num_actors // max(1, config.cluster.hosts),
            "games_per_actor": config.games_per_actor,
            "support": config.support,
        },
    }


def config_from_dict(saved: Any, own_files: OwnFiles = NO_OWN_FILES) -> RunConfig:
    """The configuration that `config_to_dict` wrote, with the derived numbers it ran with made explicit.

    Args:
        saved: what was written.
        own_files: the Python files of the run, if it has any. They are executed; the paths that `saved` has are not.

    Raises:
        ConfigError: another schema, an unknown or missing key, a wrong type or value, or a file is missing.
    """
    schema = saved.get("schema") if isinstance(saved, dict) else None
    if schema != CONFIG_SCHEMA:
        raise ConfigError(f"saved configuration: got schema {schema!r:.20}, want a map with schema {CONFIG_SCHEMA}")
    plain, kind = saved.get("config"), AgentConfig
    match plain:
        case {"agent": {"name": str()} as agent}:
            plain = {**plain, "agent": _with_own_files(agent, own_files)}
            kind = agent_config_class(plain["agent"]["name"])
        case _:  # what is wrong is said below
            pass
    resolved = _from_plain(_Resolved, saved.get("resolved"), "resolved")
    match plain:  # what this machine has room for is no matter: the run had these
        case {"mode": "async", "actors": {**actors}}:
            numbers = {"num_actors": resolved.num_actors, "games_per_actor": resolved.games_per_actor}
            plain = {**plain, "actors": {**actors, **numbers}}
        case _:
            pass
    config = build_config(plain, "config", kind)
    if resolved.tasks != (tasks := config.table.ids):
        raise ConfigError(f"resolved.tasks: got {list(resolved.tasks)}, but the configuration has {list(tasks)}")
    return config.with_support(resolved.support)


def _with_own_files(agent: dict[str, Any], own_files: OwnFiles) -> dict[str, Any]:
    named = dict(agent)
    for what, field, file in (("agent", "name", own_files.agent), ("encoder", "encoder", own_files.encoder)):
        if file is not None and not file.is_file():
            raise ConfigError(f"--{what}: no file {file} here ({Path.cwd()})")
        if str(agent.get(field)).endswith(".py"):
            if file is None:
                raise ConfigError(
                    f"its {what} is a Python file ({agent[field]}), which is never executed only because a run "
                    f"directory names it; if you trust that file, name it: --{what} {agent[field]}"
                )
            named[field] = str(file)
    return named


def build_config(plain: Any, where: str, agent: type[AgentConfig]) -> RunConfig:
    """A RunConfig from a map of JSON types, whose agent is of this class.

    Raises:
        ConfigError: an unknown or missing key, or a wrong type or value; names the field behind `where`.
    """
    learner = OnPolicyConfig if agent.on_policy else LearnerConfig
    return _from_plain(RunConfig, plain, where, {"agent": agent, "learner": learner})


@dataclass(frozen=True, kw_only=True, slots=True)
class _Resolved:
    """What a run derived from its configuration and its machine."""

    tasks: tuple[str, ...]
    num_actors: int
    games_per_actor: int
    support: tuple[float, float] | None


def _from_plain(kind: Any, value: Any, where: str, kinds: Mapping[str, Any] = MappingProxyType({})) -> Any:
    """Builds a value of type `kind` from JSON types, strictly. `kinds`: the classes of fields that may have several."""
    if type(None) in get_args(kind):
        if value is None:
            return None
        kind = next(arg for arg in get_args(kind) if arg is not type(None))
    if not dataclasses.is_dataclass(kind) or not isinstance(kind, type):
        return typed(kind, value, where)
    if not isinstance(value, dict):
        raise ConfigError(f"{where}: got {type(value).__name__}, want a map")
    hints = {**get_type_hints(kind), **kinds}
    if unknown := sorted(value.keys() - hints.keys()):
        raise ConfigError(f"{where}.{unknown[0]}: unknown key{nearest(unknown[0], hints)}")
    needed = {f.name for f in dataclasses.fields(kind) if f.default is f.default_factory is dataclasses.MISSING}
    if missing := sorted(needed - value.keys()):
        raise ConfigError(f"{where}.{missing[0]}: missing")
    return kind(**{key: _from_plain(hints[key], item, f"{where}.{key}") for key, item in value.items()})
