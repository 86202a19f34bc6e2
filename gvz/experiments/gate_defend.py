"""A gate: do agents defend the center better if a shot costs nothing?"""

from gvz.experiments.gate import Gate

EXPERIMENT = Gate(
    name="gate_defend",
    title="Gate: the price of a shot in Defend the Center",
    question="Do agents defend the center better if a shot costs nothing?",
    configs=("rainbow_quick",),
    variants={
        "shots_cost": {},
        "shots_free": {"env.reward_weights": [["defend_the_center.ammo_spent", 0.0]]},
    },
    scenarios=("defend_the_center",),
    notes=(
        "By the thesis a shot costs 0.1 and a kill gives 1; by LevDoom 0.01. An episode has 26 rounds, and agents of "
        "general_short die with some of them left. Scores are the protocol's, whatever an agent was rewarded for.",
    ),
)
