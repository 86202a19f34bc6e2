"""A gate: whether the price of a shot keeps agents from fighting in Seek and Kill, at equal processor time."""

from gvz.experiments.gate import Gate

EXPERIMENT = Gate(
    name="gate_ammo",
    title="Gate: the price of a shot in Seek and Kill",
    question="At equal processor time, do agents fight better in Seek and Kill if a shot costs nothing?",
    configs=("rainbow_quick",),
    variants={
        "shots_cost": {"env.reward_weights": [["seek_and_kill.moved", 0.0005]]},
        "shots_free": {"env.reward_weights": [["seek_and_kill.ammo_spent", 0.0], ["seek_and_kill.moved", 0.0005]]},
    },
    scenarios=("seek_and_kill",),
    notes=(
        "By the thesis a shot costs 0.1 and a kill gives 1; LevDoom's shots are free. Scores are the protocol's, "
        "whatever an agent was rewarded for.",
    ),
)
