"""DQN against Rainbow at a size that two CPU cores can run: small networks, a tenth of the gradient steps."""

from gvz.experiments.base import Experiment

EXPERIMENT = Experiment(
    name="quick_comparison",
    title="Quick comparison of DQN and Rainbow",
    source="the protocol of thesis 5.2.3 and 5.2.4, reduced",
    question="Does Rainbow generalize better than DQN within 20,000 gradient steps of a small network?",
    configs=("dqn_quick", "rainbow_quick"),
    scenarios=("defend_the_center",),
    trainings=("train4",),
    total_updates=20_000,
    num_checkpoints=2,
    episodes=25,
    evaluate_on="all",
    table_checkpoints=1,
    columns="config",
    players=("random", "idle", "scripted"),
    notes=(
        "A tenth of the thesis's gradient steps, grey frames of 48x84, a network of two small convolutions: not "
        "comparable with the thesis's numbers, only within itself.",
    ),
)
