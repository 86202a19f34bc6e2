"""A gate: why does PPO stop gaining in Defend the Center, where Rainbow goes on?"""

from gvz.experiments.gate import Gate

EXPERIMENT = Gate(
    name="gate_ppo",
    title="Gate: PPO with a longer horizon, and with more entropy",
    question="After ten minutes PPO survives for less and less time in Defend the Center. Does it if it looks further "
    "ahead, or explores more?",
    configs=("ppo_segmented",),
    variants={
        "plain": {},
        "discount_99": {"agent.discount": 0.99},
        "entropy_03": {"agent.entropy_weight": 0.03},
        "both": {"agent.discount": 0.99, "agent.entropy_weight": 0.03},
    },
    scenarios=("defend_the_center",),
    max_processor_s=900.0,
    notes=("`plain` has a discount of 0.95 and a weight of the entropy of 0.01.",),
)
