"""What learners without a replay make of a rollout: lambda returns, advantages, and the losses of PPO.

Arrays are [T, B]: T steps in a row of B games. Step t begins at the observation of value `v_tm1`, takes an action, is
paid `r_t` and leads to the observation of value `v_t`. Functions of returns stop gradients; losses give one number
per step, and means and weights are the caller's work.

Where an episode ends inside a rollout, nothing of the next one flows back:

* terminated: nothing follows, and `v_t` does not count.
* truncated: the return goes on with `v_t`, so `v_t` must be the value of the episode's final observation and not of
  the next episode's first one. Step records hold it: an episode of T decisions is T + 1 records, so the value at
  record t + 1 is always right. Between the last record of an episode and the first of the next lies a step that
  nobody took: its loss must be weighted 0.
"""

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def lambda_returns(
    r_t: Float[Array, "T B"],
    v_t: Float[Array, "T B"],
    terminated: Bool[Array, "T B"],
    truncated: Bool[Array, "T B"],
    discount: float,
    lambda_: float,
) -> Float[Array, "T B"]:
    """G_t = r_t + discount * ((1 - lambda) v_t + lambda G_t+1), from the last step backwards.

    Args:
        r_t: reward of the step.
        v_t: value of the observation that the step led to. PQN's Q(lambda): its largest action value.
        terminated: the step ended its episode for good: G = r.
        truncated: the step ended its episode by time-out: G = r + discount * v_t.
        discount: gamma of one step.
        lambda_: 0 looks one step ahead, 1 to the end of the episode or rollout.

    Returns:
        Targets for Q(s, a) or V(s) at the step's beginning. As in PQN, traces are not cut after exploring actions.

    Source: Sutton and Barto 2018, section 12.1; Gallici et al. 2024 (PQN), whose lambda is 0.65 in Atari.
    """
    chex.assert_rank(r_t, 2)
    chex.assert_equal_shape([r_t, v_t, terminated, truncated])
    discount_t = jnp.where(terminated, 0.0, discount)
    lambda_t = jnp.where(truncated, 0.0, lambda_)

    def step(g: Array, at_t: tuple[Array, Array, Array, Array]) -> tuple[Array, Array]:
        r, v, d, mix = at_t
        g = r + d * ((1 - mix) * v + mix * g)
        return g, g

    _, returns = jax.lax.scan(step, v_t[-1], (r_t, v_t, discount_t, lambda_t), reverse=True)
    return jax.lax.stop_gradient(returns)


def generalized_advantages(
    r_t: Float[Array, "T B"],
    v_tm1: Float[Array, "T B"],
    v_t: Float[Array, "T B"],
    terminated: Bool[Array, "T B"],
    truncated: Bool[Array, "T B"],
    discount: float,
    lambda_: float,
) -> tuple[Float[Array, "T B"], Float[Array, "T B"]]:
    """GAE: the sum over k of (discount * lambda)^k delta_t+k, which is the lambda return less v_tm1.

    The arguments are those of `lambda_returns`, and v_tm1, the value of the observation where the step's action was
    taken. With `lambda_` 0 the advantage is the TD error, with 1 the return less the value.

    Returns:
        (advantages, lambda returns); the returns are what PPO's value loss aims at.

    Source: Schulman et al. 2016, eq. 16.
    """
    returns = lambda_returns(r_t, v_t, terminated, truncated, discount, lambda_)
    return jax.lax.stop_gradient(returns - v_tm1), returns


def clipped_surrogate_loss(
    log_p: Float[Array, "*batch"], log_p_old: Float[Array, "*batch"], advantages: Float[Array, "*batch"], clip: float
) -> Float[Array, "*batch"]:
    """-min(ratio * advantage, clip(ratio, 1 - clip, 1 + clip) * advantage) with ratio = p(a|s) / p_old(a|s).

    Args:
        log_p: log-probability of the action taken, by the policy that learns.
        log_p_old: the same by the policy that acted; constant.
        advantages: constant; normalizing them is the caller's work.
        clip: epsilon of the paper, 0.2 there.

    Source: Schulman et al. 2017 (PPO), eq. 7.
    """
    chex.assert_equal_shape([log_p, log_p_old, advantages])
    log_p_old, advantages = jax.lax.stop_gradient((log_p_old, advantages))
    ratio = jnp.exp(log_p - log_p_old)
    return -jnp.minimum(ratio * advantages, jnp.clip(ratio, 1 - clip, 1 + clip) * advantages)


def value_loss(
    v: Float[Array, "*batch"],
    returns: Float[Array, "*batch"],
    v_old: Float[Array, "*batch"] | None = None,
    clip: float | None = None,
) -> Float[Array, "*batch"]:
    """0.5 (returns - v)^2; with `clip`, the larger of it and the same for v within `clip` of `v_old`.

    Args:
        v: value that learns.
        returns: targets; constant.
        v_old: value at the time of acting; constant, needed for clipping only.
        clip: how far v may move before its gradient is cut. PPO's paper has none; OpenAI's code has.

    Source: Schulman et al. 2017, eq. 9; Engstrom et al. 2020, section 3 (clipping).
    """
    chex.assert_equal_shape([v, returns])
    returns = jax.lax.stop_gradient(returns)
    loss = 0.5 * jnp.square(returns - v)
    if clip is None:
        return loss
    if v_old is None:
        raise ValueError("value_loss.v_old: got None, want the values at the time of acting, because clip is given")
    v_old = jax.lax.stop_gradient(v_old)
    near = v_old + jnp.clip(v - v_old, -clip, clip)
    return jnp.maximum(loss, 0.5 * jnp.square(returns - near))


def entropy(logits: Float[Array, "*batch A"]) -> Float[Array, "*batch"]:
    """Entropy of the policy in nats; PPO's loss has it with a negative weight. Source: Schulman et al. 2017, eq. 9."""
    log_p = jax.nn.log_softmax(logits)
    return -jnp.sum(jnp.exp(log_p) * log_p, axis=-1)
