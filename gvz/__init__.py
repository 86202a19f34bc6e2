"""GViZDoom: a benchmark of visual generalization in Doom, and a trainer for it.

Tier 1. The modules beside this file belong to the benchmark, except the commands `launch` and `cli`, which are tier 3.

`import gvz` registers every named task in Gymnasium: gymnasium.make("GViZDoom/DefendTheCenter-Gore-v0").
"""

from typing import TYPE_CHECKING, Any

from gvz.core.env_config import LABEL_CLASSES
from gvz.registration import register_with_gymnasium

if TYPE_CHECKING:
    from gvz.env import DoomEnv
    from gvz.scenarios.base import Task

__version__ = "0.1.0"
__all__ = ["LABEL_CLASSES", "__version__", "make"]


def make(task: "str | Task", **options: Any) -> "DoomEnv":
    """The Gymnasium environment of a task.

    Args:
        task: `<scenario>/<attribute>+<attribute>...`, for example "defend_the_center/gore+mossy_bricks".
        **options: arguments of gvz.env.DoomEnv and fields of gvz.core.env_config.EnvConfig.
    """
    from gvz.env import DoomEnv  # here, so that `import gvz` is quick

    return DoomEnv(task, **options)


register_with_gymnasium()
