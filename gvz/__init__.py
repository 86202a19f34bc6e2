"""GViZDoom: graded visual generalization in Doom, and a trainer for it."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gvz.env import DoomEnv

__version__ = "0.1.0"
__all__ = ["__version__", "make", "register_envs"]


def make(task: str, **options: Any) -> "DoomEnv":
    """The Gymnasium environment of a task.

    Args:
        task: "<scenario>/<attribute>+<attribute>...", for example "defend_the_center/gore+mossy_bricks".
        **options: arguments of gvz.env.DoomEnv and fields of gvz.specs.EnvConfig.
    """
    from gvz.env import DoomEnv  # here, so that `import gvz` loads nothing

    return DoomEnv(task, **options)


def register_envs() -> None:
    """Makes every named task known to gymnasium.make, where the installed plugin has not done it already."""
    from gvz.registration import register_envs

    register_envs()
