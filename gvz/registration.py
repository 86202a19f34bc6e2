"""Gymnasium ids of the named tasks. Imports gvz.tasks; gymnasium when called."""

from gvz.scenarios.base import Task
from gvz.tasks import named_tasks

NAMESPACE = "GViZDoom"


def gymnasium_id(task: Task) -> str:
    """The id of a task: "GViZDoom/DefendTheCenter-Gore-MossyBricks-v0"."""
    scenario = task.scenario.title.title().replace(" ", "")
    words = [word.replace("_", " ").title().replace(" ", "") for word in task.name.split("+")]
    return f"{NAMESPACE}/{'-'.join([scenario, *words])}-v0"


def register_envs() -> None:
    """Makes every named task known to gymnasium.make. Gymnasium calls it by itself where gvizdoom is installed."""
    import gymnasium

    for task in named_tasks():
        name = gymnasium_id(task)
        if name not in gymnasium.registry:
            gymnasium.register(name, entry_point="gvz.env:DoomEnv", kwargs={"task": task.id})
