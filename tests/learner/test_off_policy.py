"""The learner of a replay as a run uses it: whose parameters evaluation and actors get, weights of tasks, epsilon."""

from dataclasses import dataclass, replace
from pathlib import Path

import jax
import numpy as np

from learner.checkpoint import Restored
from learner.off_policy import OffPolicyLearner
from tests.learner.sharded import TASKS, LinearQ, parts_of, records, saved
from tests.oracles import step_block


@dataclass(frozen=True)
class Exploring(LinearQ):
    def epsilon(self, env_steps):
        return 0.5 - env_steps / 1000


def make_learner(
    tmp_path: Path, restored: Restored | None = None, num_updates_per_call: int = 1, **config
) -> OffPolicyLearner:
    parts = replace(parts_of(1, agent=Exploring(), **config), num_updates_per_call=num_updates_per_call)
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


def test_metrics_say_how_full_the_replay_is_and_of_which_tasks_its_records_are(tmp_path: Path):
    learner, stored = parts_of(1).make(jax.random.key(5), TASKS, tmp_path), records(60)
    learner.add([step_block(stored)], 0)
    found = learner.take_metrics()
    assert found["replay/fill_share"] == 60 / (4 * 40)
    shares = [sum(record.task == i for record in stored) / 60 for i in range(len(TASKS))]
    np.testing.assert_allclose([found[f"replay/share/{task}"] for task in TASKS], shares, rtol=1e-6)


def test_warm_up_is_by_chance_and_the_agents_epsilon_begins_at_its_end(tmp_path: Path):
    learner = make_learner(tmp_path, warmup_steps=200)
    assert [learner.epsilon(env_steps) for env_steps in (0, 199, 200, 300)] == [1.0, 1.0, 0.5, 0.4]


def test_the_last_call_does_no_more_gradient_steps_than_the_run_has(tmp_path: Path):
    learner = make_learner(tmp_path, num_updates_per_call=4, total_updates=6)
    assert [learner.update() for _ in range(2)] == [4, 2]
    assert int(learner.arrays()["learner"].num_updates) == 6
