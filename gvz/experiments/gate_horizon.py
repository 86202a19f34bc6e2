"""A gate: how far is an agent to look ahead, and does it play better if it sees the game variables?"""

import dataclasses

from gvz.experiments.gate_replay import EXPERIMENT as REPLAY

EXPERIMENT = dataclasses.replace(
    REPLAY,
    name="gate_horizon",
    title="Gate: a smaller discount, and game variables",
    question="Agents get worse in Defend the Center after a third of their time. Do they with a smaller discount, or "
    "if they see the game variables?",
    variants={
        "replay_100k": REPLAY.variants["replay_100k"],  # neither: the runs of `gate_replay`
        "discount_95": {"agent.discount": 0.95, "agent.game_variables": False},
        "game_variables": {"agent.discount": 0.99, "agent.game_variables": True},
        "both": {"agent.discount": 0.95, "agent.game_variables": True},
    },
)
