"""A gate: what does a moving average of PPO's parameters give in evaluation?"""

from gvz.experiments.gate import Gate

EXPERIMENT = Gate(
    name="gate_average",
    title="Gate: PPO evaluated with averaged parameters",
    question="Rainbow is evaluated with a moving average of its parameters. Does PPO play better with one, too?",
    configs=("ppo_segmented",),
    variants={"average": {"learner.average_ema": 0.999}},
    scenarios=("defend_the_center", "seek_and_kill"),
    max_processor_s=900.0,
    notes=(
        "An average does not change training. So the agent to compare with is the same run with its last parameters, "
        "which `python -m benchmarks.last_parameters` writes.",
    ),
)
