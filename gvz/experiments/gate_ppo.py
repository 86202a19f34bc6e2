"""A gate: why does PPO stop gaining on segmented frames, where Rainbow goes on?"""

from gvz.experiments.gate import Gate

EXPERIMENT = Gate(
    name="gate_ppo",
    title="Gate: PPO with a longer horizon, and with more entropy",
    question="In Defend the Center PPO survives for less and less time after ten minutes, and in Dodge Projectiles it "
    "stays below Rainbow. Does it if it looks further ahead, or explores more?",
    configs=("ppo_segmented",),
    variants={
        "plain": {},
        "discount_99": {"agent.discount": 0.99},
        "entropy_03": {"agent.entropy_weight": 0.03},
        "both": {"agent.discount": 0.99, "agent.entropy_weight": 0.03},
    },
    scenarios=("defend_the_center", "dodge_projectiles"),
    trainings=("train8",),
    max_processor_s=900.0,
    notes=("`plain` has a discount of 0.95 and a weight of the entropy of 0.01.",),
)
