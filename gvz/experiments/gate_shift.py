"""A gate: do agents on segmented frames play unseen tasks better if their frames are shifted in training?"""

from gvz.experiments.gate import Gate
from gvz.experiments.gate_moved import EXPERIMENT as MOVED

EXPERIMENT = Gate(
    name="gate_shift",
    title="Gate: shifted segmented frames",
    question="Enemies of another size, and eyes at another height, are elsewhere on the frame. Do agents play better "
    "with them if half of a batch is shifted by up to two pixels of 24 and 42, or only up and down?",
    configs=("rainbow_segmented",),
    variants={
        "moved_most": MOVED.variants["moved_most"],
        "shift": {"agent.augmentations": ["shift"], "agent.augmentation_strength": 0.5},
        "vertical": {"agent.augmentations": ["vertical_shift"], "agent.augmentation_strength": 0.5},
    },
    scenarios=("dodge_projectiles", "defend_the_center", "health_gathering"),
    max_processor_s=900.0,
    notes=("`moved_most` is `rainbow_segmented` without shifted frames.",),
)
