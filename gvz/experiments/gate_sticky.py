"""A gate: does an agent dodge new missiles better if it learned with sticky actions?"""

from gvz.experiments.gate import Gate
from gvz.experiments.gate_moved import EXPERIMENT as MOVED

_BEFORE = MOVED.variants["plain"]
"""of `rainbow_segmented` until `gate_moved`"""

EXPERIMENT = Gate(
    name="gate_sticky",
    title="Gate: sticky actions in training",
    question="An agent whose actions may come late must move before a missile is near. Does it dodge faster ones?",
    configs=("rainbow_segmented",),
    variants={
        "plain": _BEFORE,
        "sticky_25": {"env.repeat_action_probability": 0.25, **_BEFORE},
        "sticky_50": {"env.repeat_action_probability": 0.5, **_BEFORE},
    },
    scenarios=("dodge_projectiles",),
    max_processor_s=900.0,
    notes=("Evaluations have no sticky actions.",),
)
