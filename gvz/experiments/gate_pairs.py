"""A gate: do pairs of attributes in training help an agent on segmented frames, at equal processor time?"""

from gvz.experiments.gate import Gate

EXPERIMENT = Gate(
    name="gate_pairs",
    title="Gate: pairs of attributes beside segmented frames",
    question="Do agents on segmented frames play unseen tasks better if training has pairs of its attributes, too?",
    configs=("rainbow_segmented",),
    trainings=("train8", "pairs"),
    columns="training",
    max_processor_s=900.0,
    notes=("The segmentation networks learned from the eight training tasks in both, so only play can gain.",),
)
