"""What runs take: gradient steps, environment steps, episodes, and hours by measured rates."""

from dataclasses import dataclass

from gvz.experiments.base import TrainingRun
from gvz.experiments.plan import Evaluation
from gvz.experiments.rates import Rates
from gvz.experiments.scale import scaled_settings
from gvz.run.config import load_config
from gvz.tasks import scenario_named


@dataclass(frozen=True, kw_only=True, slots=True)
class Cost:
    """Of a run or of several."""

    updates: int = 0
    env_steps: int = 0
    """decisions in training"""
    episodes: int = 0
    """of evaluation"""
    evaluation_steps: int = 0
    """decisions in evaluation, at most: every episode goes on to its time-out"""
    hours: float = 0.0
    """of one job at a time"""

    def __add__(self, other: "Cost") -> "Cost":
        return Cost(**{name: getattr(self, name) + getattr(other, name) for name in Cost.__dataclass_fields__})


def run_cost(run: TrainingRun, evaluation: Evaluation, scale: float, rates: Rates) -> Cost:
    """What training and evaluating a run takes."""
    config = load_config(run.config)
    warmup = scaled_settings(config, run.total_updates, scale).get("learner.warmup_steps", config.learner.warmup_steps)
    per_update = config.learner.env_steps_per_update
    episodes = len(evaluation.tasks) * evaluation.episodes * run.num_checkpoints
    timeout_steps = scenario_named(run.scenario).timeout_frames(config.env.profile) // config.env.frame_skip
    # warm-up has no updates, so its decisions come no slower than those beside updates
    seconds = (run.total_updates + warmup / per_update) / rates.updates_per_s
    seconds += episodes * timeout_steps / rates.evaluation_steps_per_s
    return Cost(
        updates=run.total_updates,
        env_steps=warmup + round(per_update * run.total_updates),
        episodes=episodes,
        evaluation_steps=episodes * timeout_steps,
        hours=seconds / 3600,
    )
