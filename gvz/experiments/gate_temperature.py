"""A gate: does an agent play better where looks are new if it sees weak signs of enemies better?"""

from gvz.experiments.gate import Gate

EXPERIMENT = Gate(
    name="gate_temperature",
    title="Gate: the temperature of segmented frames",
    question="The network is less sure of enemies with new looks. Does an agent play better if it sees weak signs?",
    configs=("rainbow_segmented",),
    variants={
        "temperature_1": {"env.segmenter_temperature": 1.0},
        "temperature_2": {"env.segmenter_temperature": 2.0},
    },
    scenarios=("seek_and_kill", "health_gathering"),
    max_processor_s=900.0,
)
