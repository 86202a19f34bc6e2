"""A gate: does an agent dodge new missiles better if it gets a reward for moving?"""

from gvz.experiments.gate import Gate

_UNSHIFTED = {"agent.augmentations": []}
"""without the shifted frames of `rainbow_segmented` in Dodge Projectiles"""

EXPERIMENT = Gate(
    name="gate_moved",
    title="Gate: a reward for moving in Dodge Projectiles",
    question="New enemies hit the sweep less than agents; it walks from side to side. Does a small reward for moving "
    "make agents dodge better?",
    configs=("rainbow_segmented",),
    variants={
        "plain": {"env.reward_weights": [["dodge_projectiles.moved", 0.0]], **_UNSHIFTED},
        "moved": {"env.reward_weights": [["dodge_projectiles.moved", 0.0002]], **_UNSHIFTED},
        "moved_more": {"env.reward_weights": [["dodge_projectiles.moved", 0.0005]], **_UNSHIFTED},
        "moved_most": {"env.reward_weights": [["dodge_projectiles.moved", 0.002]], **_UNSHIFTED},
        "shift_moved": {"env.reward_weights": [["dodge_projectiles.moved", 0.005]]},
    },
    scenarios=("dodge_projectiles",),
    max_processor_s=900.0,
    notes=("`shift_moved` shifts frames, as `rainbow_segmented` does. `shift` of `gate_shift` has 0.002.",),
)
