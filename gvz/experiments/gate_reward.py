"""A gate: whether Seek and Kill's reward for walking keeps agents from fighting, at equal processor time."""

from gvz.experiments.gate import Gate

EXPERIMENT = Gate(
    name="gate_reward",
    title="Gate: the reward for walking in Seek and Kill",
    question="At equal processor time, does a smaller reward for walking help in Seek and Kill?",
    configs=("rainbow_quick",),
    variants={
        "thesis": {},
        "tenth": {"env.reward_weights": [["seek_and_kill.moved", 0.0005]]},
    },
    scenarios=("seek_and_kill",),
    notes=(
        "An agent that walks straight on gets some 0.2 a decision for it, as much as for a kill in five decisions. "
        "Scores are the protocol's, whatever an agent was rewarded for.",
    ),
)
