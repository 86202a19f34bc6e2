"""KPI weights: hand-worked numbers, bounds, state."""

import numpy as np
import pytest

from learner.config import LearnerConfig
from learner.kpi import TaskKpis

CONFIG = LearnerConfig(kpi_weighting=True, kpi_window_episodes=3, kpi_max_weight=10.0)


def played(*episodes: tuple[int, float], config: LearnerConfig = CONFIG, num_tasks: int = 3) -> TaskKpis:
    kpis = TaskKpis(num_tasks, config)
    for task, score in episodes:
        kpis.add(task, score)
    return kpis


def test_a_task_without_an_episode_has_weight_one_and_no_part_in_the_others():
    """As with `curriculum.kind` level, whose harder tasks are not played for long."""
    np.testing.assert_array_equal(played().weights(), [1, 1, 1])
    np.testing.assert_array_equal(played((1, 5.0)).weights(), [1, 1, 1])
    np.testing.assert_array_equal(played((0, 5.0), (1, 1.0)).weights(), [1, 5, 1])


def test_weight_is_the_largest_kpi_over_the_own():
    # eq. 4.19: means 6, 3, 2; eq. 4.20: 6/6, 6/3, 6/2
    kpis = played((0, 4.0), (0, 8.0), (1, 3.0), (2, 2.0))
    np.testing.assert_allclose(kpis.kpis(), [6, 3, 2])
    np.testing.assert_allclose(kpis.weights(), [1, 2, 3])
    assert kpis.weights().dtype == np.float32


def test_kpi_is_the_mean_of_the_last_episodes_only():
    kpis = played((0, 100.0), (0, 1.0), (0, 2.0), (0, 6.0), (1, 3.0), (2, 3.0))
    np.testing.assert_allclose(kpis.kpis(), [3, 3, 3])


def test_weight_is_bounded_also_where_the_kpi_is_zero():
    np.testing.assert_allclose(played((0, 100.0), (1, 0.0), (2, 1.0)).weights(), [1, 10, 10])
    np.testing.assert_allclose(played((0, 0.0), (1, 0.0), (2, 0.0)).weights(), [1, 1, 1])


def test_weights_are_one_when_switched_off_while_kpis_are_still_measured():
    kpis = played((0, 4.0), (1, 2.0), (2, 1.0), config=LearnerConfig())
    np.testing.assert_array_equal(kpis.weights(), [1, 1, 1])
    np.testing.assert_allclose(kpis.kpis(), [4, 2, 1])


def test_task_without_an_episode_has_no_kpi():
    np.testing.assert_array_equal(np.isnan(played((1, 2.0)).kpis()), [True, False, True])


def test_restored_kpis_go_on_as_the_original_would():
    kpis = played((0, 1.0), (0, 2.0), (0, 3.0), (0, 4.0), (1, 5.0), (2, 5.0))
    other = TaskKpis(3, CONFIG)
    other.restore(kpis.state())
    for one in (kpis, other):
        one.add(0, 10.0)
    np.testing.assert_array_equal(kpis.kpis(), other.kpis())
    np.testing.assert_allclose(kpis.kpis()[0], (3 + 4 + 10) / 3)


def test_state_is_a_copy():
    kpis = played((0, 1.0))
    state = kpis.state()
    kpis.add(0, 9.0)
    assert state["num_episodes"][0] == 1


def test_wrong_episodes_and_states_are_refused():
    kpis = TaskKpis(2, CONFIG)
    with pytest.raises(ValueError, match=r"got task 2, want 0\.\.1"):
        kpis.add(2, 1.0)
    for score in (-1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match=r"got score .* for task 0, want a finite number >= 0"):
            kpis.add(0, score)
    with pytest.raises(ValueError, match=r"scores has shape \(3, 3\), want \(2, 3\)"):
        kpis.restore(TaskKpis(3, CONFIG).state())
