"""A gate: which training world teaches most about looks that the agent has not seen, at equal processor time."""

from gvz.experiments.gate import Gate

EXPERIMENT = Gate(
    name="gate_world",
    title="Gate: training on four tasks, eight tasks or varied maps",
    question="Do more training tasks, or maps whose look is drawn for every episode, help on tasks not trained on?",
    configs=("rainbow_quick",),
    scenarios=("defend_the_center", "dodge_projectiles"),
    trainings=("train4", "train8", "varied"),
    columns="training",
)
