"""What each attribute costs a trained agent, alone and in pairs."""

from gvz.experiments.base import Experiment

EXPERIMENT = Experiment(
    name="attribute_effects",
    title="Attribute effects",
    source="docs/EXPERIMENTS.md, Attribute effects",
    question="How much of its score does an agent lose to each attribute, and do two cost more than their sum?",
    configs=("rainbow_general",),
    trainings=("train1",),
    total_updates=500_000,
    max_processor_s=5_400.0,
    num_checkpoints=1,
    episodes=50,
    evaluate_on="attributes",
    table_checkpoints=1,
    columns="level",
    players=("random", "scripted"),
    notes=("Trained on the default task alone, so that every attribute is new to the agent.",),
)
