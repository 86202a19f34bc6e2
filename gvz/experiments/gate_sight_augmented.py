"""A gate: does augmentation help agents that learn what is in sight, and which loss should read augmented frames?"""

from gvz.experiments.gate import Gate

LOOKS = ("random_conv", "contrast", "gamma")
"""No shift: the flags of what is in sight are by column."""
SIGHT = {"agent.sight_weight": 0.1}
HALF = {"agent.augmentation_strength": 0.5}

EXPERIMENT = Gate(
    name="gate_sight_augmented",
    title="Gate: augmentation beside a loss of sight",
    question="Should the values and the loss of sight learn from augmented frames, or the loss of sight alone?",
    configs=("rainbow_general",),
    variants={
        "labels": SIGHT,
        "labels_augmented": SIGHT | HALF | {"agent.augmentations": LOOKS},
        "labels_sight_augmented": SIGHT | HALF | {"agent.sight_augmentations": LOOKS},
    },
    scenarios=("defend_the_center", "health_gathering"),
    max_processor_s=900.0,
    notes=("Labels are needed in training alone: agents act on the same grey frames.",),
)
