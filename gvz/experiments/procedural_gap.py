"""How the gap between training and test maps closes with the number of training maps."""

from gvz.experiments.base import Experiment

EXPERIMENT = Experiment(
    name="procedural_gap",
    title="Procedural maps: training on 10, 100, 1,000 or unlimited maps",
    source="docs/benchmark/drawn-maps.md, Procedural maps",
    question="How do the scores on training maps and on unseen test maps change with the number of training maps?",
    configs=("rainbow_quick",),
    trainings=("procedural-train-10", "procedural-train-100", "procedural-train-1000", "procedural-train"),
    seeds=(1111, 2222, 3333),
    total_updates=60_000,
    max_processor_s=1_800.0,
    num_checkpoints=1,
    table_checkpoints=1,
    evaluate_on="procedural",
    columns="training",
    notes=(
        "The test maps have layouts, textures, decorations and tints that no training map has. The gap is the score on "
        "the maps trained on minus the score on the test maps. Source of the design: Cobbe et al. 2020, Procgen.",
    ),
)
