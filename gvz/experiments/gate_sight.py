"""A gate: which encoder and which augmentations help on looks that the agent has not seen, at equal processor time."""

from gvz.experiments.gate import Gate

STRONG = ("random_conv", "contrast", "gamma", "shift")
AUGMENTED = {"agent.augmentations": STRONG, "agent.augmentation_strength": 0.5}
POOLED = {"agent.encoder": "height_pool"}

EXPERIMENT = Gate(
    name="gate_sight",
    title="Gate: encoders and augmentation",
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
    notes=(
        "Dodge Projectiles and Health Gathering are learned in this time: what is lost on the gate tasks is sight. In "
        "Defend the Center it is play, too.",
    ),
)
