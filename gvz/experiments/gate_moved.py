"""A gate: does an agent dodge new missiles better if it gets a reward for moving?"""

from gvz.experiments.gate import Gate

PLAIN = {"agent.augmentations": []}
"""without the shifted frames of `rainbow_segmented` in Dodge Projectiles"""

EXPERIMENT = Gate(
    name="gate_moved",
    title="Gate: a reward for moving in Dodge Projectiles",
    question="New enemies hit the sweep less than agents; it walks from side to side. Does a small reward for moving "
    "make agents dodge better?",
    configs=("rainbow_segmented",),
    variants={
        "plain": {"env.reward_weights": [["dodge_projectiles.moved", 0.0]], **PLAIN},
        "moved": {"env.reward_weights": [["dodge_projectiles.moved", 0.0002]], **PLAIN},
        "moved_more": {"env.reward_weights": [["dodge_projectiles.moved", 0.0005]], **PLAIN},
        "moved_most": {"env.reward_weights": [["dodge_projectiles.moved", 0.002]], **PLAIN},
        "shift_moved": {
            "env.reward_weights": [["dodge_projectiles.moved", 0.005]],
            "agent.augmentations": ["shift"],
            "agent.augmentation_strength": 0.5,
        },
    },
    scenarios=("dodge_projectiles",),
    trainings=("train8",),
    max_processor_s=900.0,
    notes=("`shift_moved` also shifts frames; `shift` of `gate_shift` is the same with 0.002.",),
)
