"""GViZDoom: graded visual generalization in Doom, and a trainer for it.

`import gvz` makes every named task known to Gymnasium: gymnasium.make("GViZDoom/DefendTheCenter-Gore-v0").
"""

from typing import TYPE_CHECKING, Any

from gvz.registration import register_with_gymnasium
from gvz.specs import LABEL_CLASSES

if TYPE_CHECKING:
    from gvz.env import DoomEnv
    from gvz.scenarios.base import Task

__version__ = "0.1.0"
__all__ = ["LABEL_CLASSES", "__version__", "make"]


def make(task: "str | Task", **options: Any) -> "DoomEnv":
    """The Gymnasium environment of a task.

    Args:
        task: `<scenario>/<attribute>+<attribute>...`, for example "defend_the_center/gore+mossy_bricks".
        **options: arguments of gvz.env.DoomEnv and fields of gvz.specs.EnvConfig.
    """
    from gvz.env import DoomEnv  # here, so that `import gvz` loads nothing

    return DoomEnv(task, **options)


register_with_gymnasium()
