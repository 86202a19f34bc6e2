"""A gate: do agents keep what they have learned if the replay keeps all that they played?"""

from gvz.experiments.gate import Gate

_BEFORE = {"agent.discount": 0.99, "agent.game_variables": False}
"""of `rainbow_segmented` until `gate_horizon`"""

EXPERIMENT = Gate(
    name="gate_replay",
    title="Gate: a replay of a part of the run, or of all of it",
    question="Agents get worse in Defend the Center once their replay is full. Do they with one that does not fill up?",
    configs=("rainbow_segmented",),
    variants={
        "replay_100k": {"replay.capacity": 100_000, **_BEFORE},
        "replay_400k": {"replay.capacity": 400_000, **_BEFORE},
    },
    scenarios=("defend_the_center",),
    max_processor_s=900.0,
)
