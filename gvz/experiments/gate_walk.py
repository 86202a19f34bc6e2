"""A gate: whether agents that are rewarded for walking dodge better, at equal processor time."""

from gvz.experiments.gate import Gate

EXPERIMENT = Gate(
    name="gate_walk",
    title="Gate: a reward for walking in Dodge Projectiles",
    question="At equal processor time, do agents dodge missiles that are new to them better if they are rewarded for "
    "walking?",
    configs=("rainbow_segmented",),
    variants={
        "no_reward": {"env.reward_weights": []},
        "walking": {"env.reward_weights": [["dodge_projectiles.moved", 0.0001]]},
    },
    scenarios=("dodge_projectiles",),
    trainings=("train8",),
    max_processor_s=900.0,
    notes=(
        "A player that walks from one end of the strip to the other and looks at nothing has 92 on `arachnotron`, a "
        "gate task. An agent that walks straight on gets some 0.012 a decision for it. To live gives 0.01, and a hit "
        "costs 1. Scores are the protocol's, whatever an agent was rewarded for.",
    ),
)
