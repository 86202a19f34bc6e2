"""The experiment `general_compositions` with three times the time."""

import dataclasses

from gvz.experiments.general_compositions import EXPERIMENT as SHORT

EXPERIMENT = dataclasses.replace(
    SHORT,
    name="general_compositions_long",
    title="Generalization when attributes come together in training, within 45 minutes of one core",
    question="What do three times the time of general_compositions give?",
    max_processor_s=2_700.0,
)
"""Runs of `general_compositions` in the same results directory go on from where they ended. Its plan.json must be moved
aside first: in one plan, a run has one budget."""
