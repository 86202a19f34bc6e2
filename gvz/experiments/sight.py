"""The experiment `general_short` with frames that show what each pixel is, not what it looks like."""

import dataclasses

from gvz.experiments.general_short import EXPERIMENT as SHORT

EXPERIMENT = dataclasses.replace(
    SHORT,
    name="sight",
    title="Frames of classes in place of the screen",
    source="docs/EXPERIMENTS.md, General",
    question="How well does an agent play unseen tasks when it need not recognize what it sees?",
    variants={"classes": {"env.frames": "classes"}},
    seeds=(1111,),
    columns="config",
    players=(),
    published={},
    notes=(
        "A pixel has one of 11 grey levels: wall, floor, enemy, projectile and so on (CLASS_GREYS). What these "
        "runs have more than those of general_short is what sight costs there.",
    ),
)
