"""GViZDoom: a benchmark of visual generalization in Doom, and a trainer for it.

Tier 1. The modules beside this file belong to the benchmark, except the commands `launch` and `cli`, which are tier 3.

`import gvz` registers every named task in Gymnasium: gymnasium.make("GViZDoom/DefendTheCenter-Gore-v0").
"""

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, overload

from gvz.core.env_config import LABEL_CLASSES
from gvz.registration import register_with_gymnasium

if TYPE_CHECKING:
    from collections.abc import Sequence

    from gvz.env import DoomEnv
    from gvz.multi_task import MultiTaskEnv
    from gvz.scenarios.base import Task
    from gvz.vector.env import DoomVectorEnv

__version__ = "0.1.0"
__all__ = ["LABEL_CLASSES", "__version__", "make", "make_vec"]


@overload
def make(task: "str | Task", **options: Any) -> "DoomEnv": ...
@overload
def make(task: "Sequence[str | Task]", **options: Any) -> "MultiTaskEnv": ...
def make(task: "str | Task | Sequence[str | Task]", **options: Any) -> "DoomEnv | MultiTaskEnv":
    """The Gymnasium environment of a task, or of several tasks.

    Args:
        task: `<scenario>/<attribute>+<attribute>...`, for example "defend_the_center/gore+mossy_bricks". With a list,
            every episode is of one of the tasks (gvz.multi_task.MultiTaskEnv).
        **options: arguments of gvz.env.DoomEnv and fields of gvz.core.env_config.EnvConfig; with a list of tasks,
            also of gvz.multi_task.MultiTaskEnv.
    """
    from gvz.env import DoomEnv  # here, so that `import gvz` is quick
    from gvz.multi_task import MultiTaskEnv

    if isinstance(task, Iterable) and not isinstance(task, str):
        return MultiTaskEnv(task, **options)
    return DoomEnv(task, **options)


def make_vec(
    tasks: "Task | str | Sequence[Task | str]", num_envs: int | None = None, **options: Any
) -> "DoomVectorEnv":
    """Several games as one Gymnasium vector environment, played by worker processes.

    Args:
        tasks: a task, or several; game i plays tasks[i % len(tasks)].
        num_envs: number of games; by default one for each task.
        **options: arguments of gvz.vector.env.DoomVectorEnv and fields of gvz.core.env_config.EnvConfig.
    """
    from gvz.vector.env import DoomVectorEnv

    return DoomVectorEnv(tasks, num_envs, **options)


register_with_gymnasium()
