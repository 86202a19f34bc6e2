"""What all gates have in common (docs/EXPERIMENTS.md, Gates)."""

from functools import partial

from gvz.experiments.base import Experiment

Gate = partial(
    Experiment,
    source="docs/EXPERIMENTS.md, Gates",
    trainings=("train8",),
    seeds=(1111, 2222),
    total_updates=60_000,
    max_processor_s=400.0,
    num_checkpoints=1,
    episodes=20,
    evaluate_on="gate",
    table_checkpoints=1,
    columns="config",
)
"""An experiment of short runs with equal processor time, scored on the gate tasks and those of training: by default the
eight."""
