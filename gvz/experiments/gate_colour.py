"""A gate: do agents see enemies sooner on frames with colour?"""

from gvz.experiments.gate import Gate
from gvz.experiments.gate_ammo import EXPERIMENT as AMMO

GREY = AMMO.variants["shots_free"]

EXPERIMENT = Gate(
    name="gate_colour",
    title="Gate: colour in Seek and Kill",
    question="At equal processor time, do agents play Seek and Kill better with colour than on grey frames?",
    configs=("rainbow_quick",),
    variants={"shots_free": GREY, "colour": {**GREY, "env.grayscale": False}},  # gate_ammo has the grey runs, too
    scenarios=("seek_and_kill",),
    notes=("A frame with colour has three channels, so the first convolution computes three times as much.",),
)
