"""The experiment `general_on_policy` with another training seed, evaluated with averaged parameters."""

import dataclasses

from gvz.experiments.general_on_policy import EXPERIMENT as LAST

EXPERIMENT = dataclasses.replace(
    LAST,
    name="general_on_policy_average",
    title="Generalization without a replay, with averaged parameters, within 90 minutes of one core",
    question="What does a moving average of PPO's parameters give after six times the time of gate_average?",
    variants={"average": {"learner.average_ema": 0.999}},
    seeds=(2222,),
    notes=(
        *LAST.notes,
        "An average does not change training. So the agent to compare with is the same run with its last parameters, "
        "which `python -m benchmarks.last_parameters` writes. That agent is a second seed of general_on_policy.",
    ),
)
