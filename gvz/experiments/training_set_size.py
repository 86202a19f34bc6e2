"""Thesis 5.2.2: one, four and eight training tasks, tested on tasks of levels 2 to 4."""

from gvz.experiments.base import RECIPE_NOTE, Experiment

EXPERIMENT = Experiment(
    name="training_set_size",
    title="Training set size",
    source="thesis 5.2.2, Table 5.4, Figure 5.4",
    question="Does an agent do better on harder tasks it has never met if it was trained on more tasks?",
    configs=("rainbow_4task",),
    trainings=("train1", "train4", "train8"),
    evaluate_on="test",
    columns="training",
    published={
        "thesis": {
            "defend_the_center": (38.87, 41.56, 56.06),
            "health_gathering": (27.92, 35.75, 32.91),
            "seek_and_kill": (27.34, 33.25, 23.92),
            "dodge_projectiles": (35.21, 42.30, 36.42),
        }
    },
    notes=("The thesis does not name its training sets; ours are the training sets of gvz.tasks.", RECIPE_NOTE),
)
