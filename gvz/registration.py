"""Gymnasium ids of the named tasks."""

import sys
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import ModuleType
from typing import TYPE_CHECKING

from gvz.core.errors import ConfigError

if TYPE_CHECKING:
    from gvz.scenarios.base import Task

NAMESPACE = "GViZDoom"


def gymnasium_id(task: "Task") -> str:
    """The id of a task: "GViZDoom/DefendTheCenter-Gore-MossyBricks-v0"."""
    scenario = task.scenario.title.title().replace(" ", "")
    words = [word.replace("_", " ").title().replace(" ", "") for word in task.name.split("+")]
    return f"{NAMESPACE}/{'-'.join([scenario, *words])}-v0"


def register_envs() -> None:
    """Registers the named tasks of every suite in Gymnasium.

    Raises:
        ConfigError: two tasks would have one id, because their scenarios have one title.
    """
    import gymnasium

    from gvz.tasks import all_scenarios, named_tasks

    for task in (task for scenario in all_scenarios() for task in named_tasks(scenario)):
        name = gymnasium_id(task)
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point="gvz.env:DoomEnv",
                vector_entry_point="gvz.vector.env:of_task",
                kwargs={"task": task.id},
            )
        elif (other := gymnasium.registry[name].kwargs.get("task")) != task.id:
            raise ConfigError(f"{task.id}: got the id {name} in Gymnasium, which {other} has; want another title")


def register_with_gymnasium() -> None:
    """Calls `register_envs` now if gymnasium is loaded, else as soon as it is loaded.

    Gymnasium 1 has no plugins: a package registers its tasks when it is imported. But loading gymnasium takes half a
    second, which the learner and `--help` can save.
    """
    if "gymnasium" in sys.modules:
        register_envs()
    elif not any(isinstance(finder, _GymnasiumFinder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _GymnasiumFinder())


class _GymnasiumFinder:
    """An import hook: finds gymnasium as usual, and registers the tasks after gymnasium is loaded."""

    def find_spec(self, name: str, _path: object = None, _target: object = None) -> ModuleSpec | None:
        if name != "gymnasium":
            return None
        sys.meta_path.remove(self)
        try:
            spec = find_spec(name)
        finally:
            sys.meta_path.insert(0, self)  # who asks may only want to know whether there is a gymnasium
        if spec is not None and spec.loader is not None:
            load = spec.loader.exec_module

            def load_and_register(module: ModuleType) -> None:
                load(module)
                if self in sys.meta_path:
                    sys.meta_path.remove(self)
                register_envs()

            spec.loader.exec_module = load_and_register
        return spec
