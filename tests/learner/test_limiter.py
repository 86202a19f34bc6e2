"""The rate limiter: its ratio over long random schedules, that it never blocks both sides, and resumption."""

import itertools
from fractions import Fraction

import hypothesis.strategies as st
import numpy as np
from hypothesis import given, settings

from learner.limiter import RateLimiter

PARAMETERS = {
    "ratio": st.one_of(st.sampled_from([0.1, 0.25, 1 / 3, 1.0, 4.0, 1e-3, 1e6]), st.floats(0.001, 1e6)),
    "warmup": st.integers(0, 10_000),
    "tolerance": st.integers(0, 1000),
    "per_call": st.integers(1, 16),
}


def play(limiter: RateLimiter, rng: np.random.Generator, num_turns: int, per_call: int, max_block: int = 256) -> None:
    """Lets a random side go as far as it wants, in calls of per_call updates and drains of up to max_block."""
    for _ in range(num_turns):
        if rng.random() < 0.5:
            if limiter.num_updates_allowed() >= per_call:
                limiter.update(per_call)
        else:
            limiter.insert(min(limiter.num_steps_allowed(), int(rng.integers(max_block + 1))))


def lead(limiter: RateLimiter, ratio: float, warmup: int) -> Fraction:
    state = limiter.state()
    return state["env_steps"] - warmup - Fraction(str(ratio)) * state["updates"]


@settings(max_examples=300, derandomize=True)
@given(**PARAMETERS, seed=st.integers(0, 2**31))
def test_some_side_can_always_go(ratio, warmup, tolerance, per_call, seed):
    limiter, rng = RateLimiter(ratio, warmup, tolerance, per_call), np.random.default_rng(seed)
    for _ in range(30):
        assert limiter.num_updates_allowed() >= per_call or limiter.num_steps_allowed() >= 1
        play(limiter, rng, 1, per_call, max_block=10**7)


@settings(max_examples=300, derandomize=True)
@given(**PARAMETERS, seed=st.integers(0, 2**31))
def test_the_ratio_holds_over_long_random_schedules(ratio, warmup, tolerance, per_call, seed):
    """No update is done before its decisions came; decisions lead by the window, rounded up to a whole one."""
    limiter, rng = RateLimiter(ratio, warmup, tolerance, per_call), np.random.default_rng(seed)
    for _ in range(20):
        play(limiter, rng, 10, per_call)
        assert lead(limiter, ratio, warmup) < max(tolerance, Fraction(str(ratio)) * per_call) + 1
        if limiter.state()["updates"]:
            assert lead(limiter, ratio, warmup) >= 0


def test_a_long_run_ends_at_its_ratio():
    limiter = RateLimiter(4.0, 10_000, 256)
    play(limiter, np.random.default_rng(0), 20_000, per_call=1)
    state = limiter.state()
    assert state["updates"] > 5_000
    assert 0 <= state["env_steps"] - 10_000 - 4 * state["updates"] <= 256


def test_nothing_is_allowed_before_warm_up_is_over():
    limiter = RateLimiter(4.0, 100, 20)
    assert (limiter.num_updates_allowed(), limiter.num_steps_allowed()) == (0, 120)
    limiter.insert(103)
    assert (limiter.num_updates_allowed(), limiter.num_steps_allowed()) == (0, 17)
    limiter.insert(17)
    assert (limiter.num_updates_allowed(), limiter.num_steps_allowed()) == (5, 0)
    limiter.update(2)
    assert (limiter.num_updates_allowed(), limiter.num_steps_allowed()) == (3, 8)


def test_updates_come_in_whole_calls():
    """Eight updates cost 32 decisions: more than the tolerance, which must not keep them from ever being paid."""
    limiter = RateLimiter(4.0, 0, 10, num_updates_per_call=8)
    assert limiter.num_steps_allowed() == 32
    limiter.insert(31)
    assert (limiter.num_updates_allowed(), limiter.num_steps_allowed()) == (0, 1)
    limiter.insert(1)
    assert limiter.num_updates_allowed() == 8


def test_a_tenth_of_a_decision_for_each_update_is_exactly_that():
    limiter = RateLimiter(0.1, 0, 1)
    for num_steps in itertools.repeat(1, 1000):
        limiter.insert(num_steps)
        assert limiter.num_updates_allowed() == 10
        limiter.update(10)


@settings(max_examples=100, derandomize=True)
@given(**PARAMETERS, seed=st.integers(0, 2**31))
def test_a_restored_limiter_goes_on_as_the_first(ratio, warmup, tolerance, per_call, seed):
    first = RateLimiter(ratio, warmup, tolerance, per_call)
    play(first, np.random.default_rng(seed), 50, per_call)
    second = RateLimiter(ratio, warmup, tolerance, per_call)
    second.restore(first.state())
    for limiter in (first, second):
        play(limiter, np.random.default_rng(seed + 1), 50, per_call)
    assert first.state() == second.state()
    assert first.num_updates_allowed() == second.num_updates_allowed()
    assert first.num_steps_allowed() == second.num_steps_allowed()


def test_a_resume_brings_no_burst_and_no_second_warm_up():
    limiter = RateLimiter(4.0, 1000, 100)
    limiter.restore({"env_steps": 1000 + 4 * 500, "updates": 500})
    assert (limiter.num_updates_allowed(), limiter.num_steps_allowed()) == (0, 100)
    limiter.insert(4)
    assert limiter.num_updates_allowed() == 1
