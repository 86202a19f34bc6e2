"""A gate: how often an agent on segmented frames learns from a decision, at equal processor time."""

from gvz.experiments.gate import Gate

EXPERIMENT = Gate(
    name="gate_samples",
    title="Gate: decisions per gradient step beside segmented frames",
    question="A decision costs more with a segmentation network. At equal processor time, how many should come with "
    "each gradient step of 32 transitions? Or should a gradient step have more transitions?",
    configs=("rainbow_segmented",),
    variants={
        **{f"decisions_{n}": {"learner.env_steps_per_update": float(n)} for n in (4, 8, 16)},
        "batch_64": {"learner.batch_size": 64},
    },
    scenarios=("defend_the_center",),
    seeds=(1111,),
    max_processor_s=900.0,
    notes=(
        "`decisions_16` is `rainbow_segmented`. With it a transition is drawn twice on average, with `decisions_8` and "
        "`batch_64` four times, with `decisions_4` eight times.",
    ),
)
