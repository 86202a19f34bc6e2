"""The learner of a replay as a run uses it: whose parameters evaluation and actors get, and weights of tasks."""

from pathlib import Path

import jax
import numpy as np

from learner.checkpoint import Restored
from learner.off_policy import OffPolicyLearner
from tests.learner.sharded import TASKS, LinearQ, parts_of, records, saved
from tests.oracles import step_block


def make_learner(tmp_path: Path, restored: Restored | None = None, **config) -> OffPolicyLearner:
    parts = parts_of(1, agent=LinearQ(), **config)
    learner = parts.make(jax.random.key(5), TASKS, tmp_path, restored)
    if restored is None:
        learner.add([step_block(records(400))], 0)
    return learner


def test_evaluation_gets_the_average_of_parameters_and_actors_get_the_last(tmp_path: Path):
    learner = make_learner(tmp_path, average_ema=0.9, learning_rate=0.1)
    for _ in range(5):
        assert learner.update() == 1
    state = learner.arrays()["learner"]
    last, average = (np.asarray(params["w"]) for params in (state.params, state.average_params))
    assert np.abs(last - average).max() > 0.01
    np.testing.assert_array_equal(learner.params["w"], average)
    np.testing.assert_array_equal(learner.acting_params(), last.ravel())


def test_scores_of_episodes_weigh_the_losses_of_tasks_also_after_a_resume(tmp_path: Path):
    """Half the score: twice the loss. Nothing was drawn before, so all priorities, and all importances, are equal."""
    learner = make_learner(tmp_path, kpi_weighting=True)
    learner.add_episode(0, 80.0)
    learner.add_episode(1, 40.0)
    for one in (make_learner(tmp_path, saved(learner, tmp_path), kpi_weighting=True), learner):
        assert one.update() == 1
        found = one.take_metrics()
        easy, hard = (found[f"learner/sample_share/{task}"] * found[f"learner/loss/{task}"] for task in TASKS)
        assert min(easy, hard) > 0
        np.testing.assert_allclose(found["learner/loss"], easy + 2 * hard, rtol=1e-4)
