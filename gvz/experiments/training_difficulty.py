"""Thesis 5.2.1: every task trained alone, by level."""

from gvz.experiments.base import EACH_TASK, RECIPE_NOTE, Experiment

EXPERIMENT = Experiment(
    name="training_difficulty",
    title="Training difficulty",
    source="thesis 5.2.1, Table 5.3, Figures 5.2 and 5.3",
    question="Is a task harder to learn the more attributes it has?",
    configs=("rainbow_4task",),
    trainings=(EACH_TASK,),
    total_updates=500_000,
    evaluate_on="own",
    table_checkpoints=20,
    columns="level",
    published={
        "thesis": {
            "defend_the_center": (87.48, 60.11, 40.35, 34.46, 29.69),
            "health_gathering": (86.68, 78.60, 55.64, 36.13, 27.43),
            "seek_and_kill": (59.69, 42.02, 28.87, 24.11, 13.92),
            "dodge_projectiles": (86.10, 84.18, 46.79, 28.66, 28.21),
        }
    },
    notes=(
        "The thesis averages the scores of training, every 5,000 gradient steps; here all checkpoints are evaluated, "
        "greedily and on the same episodes as everything else. The curves of training itself are of episodes.jsonl.",
        RECIPE_NOTE,
    ),
)
