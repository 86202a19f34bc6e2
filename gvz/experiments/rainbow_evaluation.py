"""Thesis 5.2.4: Rainbow, trained on four tasks, on all tasks by level."""

from gvz.experiments.base import RECIPE_NOTE, Experiment

EXPERIMENT = Experiment(
    name="rainbow_evaluation",
    title="Rainbow evaluation",
    source="thesis 5.2.4, Table 5.6, Figure 5.6",
    question="How does an agent trained on levels 0 and 1 do as the level rises?",
    configs=("rainbow_4task",),
    trainings=("train4",),
    evaluate_on="all",
    columns="level",
    published={
        "thesis": {
            "defend_the_center": (76.38, 71.25, 66.70, 52.27, 35.48),
            "health_gathering": (98.55, 71.53, 43.13, 27.32, 18.99),
            "seek_and_kill": (74.66, 60.70, 45.62, 31.80, 18.59),
            "dodge_projectiles": (79.37, 63.07, 52.85, 24.68, 22.40),
        }
    },
    notes=("The runs are those of training_set_size and algorithm_comparison with four training tasks.", RECIPE_NOTE),
)
