"""`general_segmented_varied_long` with networks that have seen varied maps."""

import dataclasses

from gvz.experiments.general_segmented_varied_long import EXPERIMENT as VARIED_LONG

EXPERIMENT = dataclasses.replace(
    VARIED_LONG,
    name="general_segmented_varied_network",
    title="Generalization from varied maps with a segmentation network of varied maps, within 90 minutes of one core",
    question="How well does an agent play unseen tasks if it trains on varied maps and its network has seen such maps?",
    variants={"varied_network": {"env.segmenter": "varied"}},
    notes=(
        "The networks come with GViZDoom. Each learned from the engine's labels for 1,500 seconds of processor time, "
        "on the eight training tasks of its scenario and on varied maps, with attributes and without. The agents "
        "train on varied maps. All other settings were chosen by runs on eight training tasks.",
    ),
)
