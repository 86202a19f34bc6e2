"""A gate: which training world teaches most about looks that the agent has not seen, at equal processor time."""

from gvz.experiments.base import Experiment

EXPERIMENT = Experiment(
    name="gate_world",
    title="Gate: training on four tasks, eight tasks or varied maps",
    source="docs/EXPERIMENTS.md, Gates",
    question="Do more training tasks, or maps whose look is drawn for every episode, help on tasks not trained on?",
    configs=("rainbow_quick",),
    scenarios=("defend_the_center", "dodge_projectiles"),
    trainings=("train4", "train8", "varied"),
    seeds=(1111, 2222),
    total_updates=60_000,
    max_processor_s=400.0,
    num_checkpoints=1,
    episodes=20,
    evaluate_on="gate",
    table_checkpoints=1,
    columns="training",
)
