"""A gate: do varied maps beside the eight training tasks help an agent on segmented frames, at equal processor time?"""

from gvz.experiments.gate import Gate

EXPERIMENT = Gate(
    name="gate_varied",
    title="Gate: varied maps beside eight training tasks",
    question="Do agents on segmented frames play unseen tasks better if they train on varied maps, too?",
    configs=("rainbow_segmented",),
    variants={"varied_network": {"env.segmenter": "varied"}},
    trainings=("train8", "train8_varied"),
    columns="training",
    max_processor_s=900.0,
    notes=("The segmentation networks have seen varied maps in both, so only play can gain.",),
)
