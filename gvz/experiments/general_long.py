"""The experiment `general_sight_loss` with the time and the episodes of `general`."""

import dataclasses

from gvz.experiments.general import EXPERIMENT as GENERAL
from gvz.experiments.general_sight_loss import EXPERIMENT as SHORT

EXPERIMENT = dataclasses.replace(
    SHORT,
    name="general_long",
    title="Generalization with the engine's labels in training, within 90 minutes of one core",
    question="What do six times the time of general_sight_loss give?",
    seeds=(1111,),
    max_processor_s=GENERAL.max_processor_s,
    episodes=GENERAL.episodes,
    players=("random",),
)
