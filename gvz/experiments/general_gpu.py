"""The experiment `general` with the configuration for a GPU."""

import dataclasses

from gvz.experiments.general import EXPERIMENT as GENERAL

EXPERIMENT = dataclasses.replace(
    GENERAL,
    name="general_gpu",
    title="Generalization on all scenarios, with a GPU",
    question="How does an agent of one GPU play tasks that it was not trained on?",
    configs=("rainbow_general_gpu",),
    total_updates=200_000,
    max_processor_s=None,
    notes=(
        GENERAL.notes[0],
        "Differs from the thesis: grey frames, IMPALA's encoder pooled over the height, batches of 256, 64 decisions "
        "for each gradient step.",
    ),
)
