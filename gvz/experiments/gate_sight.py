"""A gate: which encoder and which augmentations help on looks that the agent has not seen, at equal processor time."""

from gvz.experiments.base import Experiment

STRONG = ("random_conv", "contrast", "gamma", "shift")
AUGMENTED = {"agent.augmentations": STRONG, "agent.augmentation_strength": 0.5}
POOLED = {"agent.encoder": "height_pool"}

EXPERIMENT = Experiment(
    name="gate_sight",
    title="Gate: encoders and augmentation",
    source="docs/EXPERIMENTS.md, Gates",
    question="At equal processor time, which encoder or augmentation helps on tasks that were not trained on?",
    configs=("rainbow_quick",),
    variants={
        "plain": {},
        "height_pool": POOLED,
        "augmented": AUGMENTED,
        "height_pool_augmented": POOLED | AUGMENTED,
        "memory": {"agent.past_actions": 16, "agent.game_variables": True, "agent.hidden_input_share": 0.2},
        "layer_norm": {"agent.encoder": "layer_norm"},
    },
    scenarios=("dodge_projectiles", "health_gathering", "defend_the_center"),
    trainings=("train8",),
    seeds=(1111, 2222),
    total_updates=60_000,
    max_processor_s=400.0,
    num_checkpoints=1,
    episodes=20,
    evaluate_on="gate",
    table_checkpoints=1,
    columns="config",
    notes=(
        "Dodge Projectiles and Health Gathering are learned in this time: what is lost on the gate tasks is sight. In "
        "Defend the Center it is play, too.",
    ),
)
