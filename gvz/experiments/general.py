"""The recipe of rainbow_general on all scenarios: four tasks, eight tasks, varied maps."""

from gvz.experiments.base import Experiment

EXPERIMENT = Experiment(
    name="general",
    title="Generalization on all scenarios",
    source="docs/EXPERIMENTS.md, General",
    question="How does an agent of two cores and 45 minutes play tasks that it was not trained on?",
    configs=("rainbow_general",),
    trainings=("train4", "train8", "varied"),
    total_updates=500_000,
    max_processor_s=5_400.0,
    num_checkpoints=1,
    evaluate_on="all",
    table_checkpoints=1,
    columns="training",
    players=("random", "sweep", "scripted"),
    notes=(
        "The thesis's Rainbow has 41.84 as the mean over the four scenarios, after 200,000 gradient steps of the full "
        "network, with eight training tasks in Defend the Center and four elsewhere; with four everywhere 38.22. "
        "LevDoom's best agents have 48.5 to 52 after 10 million decisions.",
        "Differs from the thesis: grey frames of 48x84, two small convolutions, 128 hidden units, 16 decisions for "
        "each gradient step.",
    ),
)
