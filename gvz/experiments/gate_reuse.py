"""A gate: how often the main job learns from a decision, at equal processor time."""

from gvz.experiments.base import Experiment

EXPERIMENT = Experiment(
    name="gate_reuse",
    title="Gate: decisions per gradient step",
    source="docs/EXPERIMENTS.md, Gates",
    question="At equal processor time, how many new decisions should come with each gradient step of 32 transitions?",
    configs=("rainbow_4task",),
    variants={f"decisions_{n}": {"learner.env_steps_per_update": float(n)} for n in (4, 16, 64)},
    scenarios=("defend_the_center", "dodge_projectiles"),
    trainings=("train4",),
    seeds=(1111, 2222),
    total_updates=60_000,
    max_processor_s=1_200.0,
    num_checkpoints=1,
    episodes=20,
    evaluate_on="gate",
    table_checkpoints=1,
    columns="config",
    notes=("A transition of `decisions_4` is drawn eight times on average, one of `decisions_64` every second time.",),
)
