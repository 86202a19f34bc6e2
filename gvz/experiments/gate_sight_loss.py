"""A gate: does it help to learn, beside the values, what is in sight?"""

from gvz.experiments.gate import Gate

EXPERIMENT = Gate(
    name="gate_sight_loss",
    title="Gate: a further loss that tells what is in sight",
    question="At equal processor time, do agents play better that also learn from the engine's labels what they see?",
    configs=("rainbow_general",),
    variants={"plain": {}, "sight_0.1": {"agent.sight_weight": 0.1}, "sight_1": {"agent.sight_weight": 1.0}},
    scenarios=("defend_the_center", "seek_and_kill"),
    notes=("Labels are needed in training alone: agents act on the same grey frames.",),
)
