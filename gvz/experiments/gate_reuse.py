"""A gate: how often the main job learns from a decision, at equal processor time."""

from gvz.experiments.gate import Gate

EXPERIMENT = Gate(
    name="gate_reuse",
    title="Gate: decisions per gradient step",
    question="At equal processor time, how many new decisions should come with each gradient step of 32 transitions?",
    configs=("rainbow_4task",),
    variants={f"decisions_{n}": {"learner.env_steps_per_update": float(n)} for n in (4, 16, 64)},
    scenarios=("defend_the_center", "dodge_projectiles"),
    trainings=("train4",),
    max_processor_s=1_200.0,
    notes=("A transition of `decisions_4` is drawn eight times on average, one of `decisions_64` every second time.",),
)
