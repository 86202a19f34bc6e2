"""A gate: how often a decision is learned from, at equal processor time."""

from gvz.experiments.base import Experiment

EXPERIMENT = Experiment(
    name="gate_reuse",
    title="Gate: decisions per gradient step",
    source="docs/EXPERIMENTS.md, Gates",
    question="At equal processor time, how many new decisions should come with each gradient step of 32 transitions?",
    configs=("rainbow_quick",),
    variants={f"decisions_{n}": {"learner.env_steps_per_update": float(n)} for n in (4, 8, 16, 32)},
    scenarios=("defend_the_center", "dodge_projectiles"),
    trainings=("train4",),
    seeds=(1111, 2222),
    total_updates=60_000,
    max_processor_s=600.0,
    num_checkpoints=1,
    episodes=20,
    evaluate_on="gate",
    table_checkpoints=1,
    columns="config",
    notes=("A transition of `decisions_4` is drawn eight times on average, one of `decisions_32` once.",),
)
