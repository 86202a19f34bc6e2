"""A gate: how far is an agent of Health Gathering to look ahead?"""

from gvz.experiments.gate import Gate

EXPERIMENT = Gate(
    name="gate_discount",
    title="Gate: a longer horizon in Health Gathering",
    question="On the map of `supreme` the next kit may be behind a wall. Does it help to look further ahead?",
    configs=("rainbow_segmented",),
    variants={"near": {"agent.discount": 0.95}, "far": {"agent.discount": 0.98}},
    scenarios=("health_gathering",),
    max_processor_s=900.0,
)
