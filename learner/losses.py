"""The losses of DQN, Rainbow, QR-DQN, IQN and Munchausen as pure functions over a batch, in the papers' symbols.

Every function returns one number (or distribution) per sample; means and weights are the train step's work.
Subscripts: `tm1` is time t - 1, where the action was taken; `t` is where the n-step window ended. `discount_t` is
gamma^n, and 0 where the episode terminated inside the window.
"""

import chex
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, UInt8


def q_learning_td(
    q_tm1: Float[Array, "B A"],
    a_tm1: Int[Array, " B"],
    r_t: Float[Array, " B"],
    discount_t: Float[Array, " B"],
    q_t_value: Float[Array, "B A"],
    q_t_selector: Float[Array, "B A"],
) -> Float[Array, " B"]:
    """TD error of (double, n-step) Q-learning: r + discount * Q'(s', argmax_a S(s', a)) - Q(s, a).

    Args:
        q_tm1: online action values at t - 1.
        a_tm1: actions taken, 0..A-1.
        r_t: (n-step) reward.
        discount_t: what multiplies the bootstrap; 0 where terminated.
        q_t_value: target network's action values at t.
        q_t_selector: who chooses the action at t: the online network's values for double Q-learning, else `q_t_value`.

    Returns:
        TD errors; no gradient flows through the target.

    Source: thesis eq. 4.1 with the missing plus sign, 4.7, 4.9 (double) and 4.16 (n-step).
    """
    chex.assert_rank([q_tm1, a_tm1, r_t, discount_t, q_t_value], [2, 1, 1, 1, 2])
    chex.assert_equal_shape([q_tm1, q_t_value, q_t_selector])
    target = r_t + discount_t * take_action(q_t_value, jnp.argmax(q_t_selector, axis=-1))
    return jax.lax.stop_gradient(target) - take_action(q_tm1, a_tm1)


def huber(td: Float[Array, "*batch"], delta: float = 1.0) -> Float[Array, "*batch"]:
    """0.5 td^2 inside [-delta, delta], linear outside with the same slope.

    Source: thesis 5.1.2 (Huber loss); Mnih et al. 2015 clip the error's derivative at 1, which is delta = 1.
    """
    inside = jnp.clip(td, -delta, delta)
    return inside * (td - 0.5 * inside)


def sight(logits: Float[Array, "B C"], seen: UInt8[Array, "B C"], num_classes: int) -> Float[Array, " B"]:
    """Cross-entropy of what is in sight, in nats: the sum over classes of the mean over columns.

    Args:
        logits: of each flag.
        seen: the flags, 0 or 1, by class and column.
        num_classes: classes of things.

    Source: Lample and Chaplot 2017 (game features). Differs: there a flag says whether a thing is anywhere in sight;
        here each column of the frame has one.
    """
    chex.assert_equal_shape([logits, seen])
    return num_classes * optax.sigmoid_binary_cross_entropy(logits, seen).mean(axis=1)


def take_action(values: Float[Array, "B A *rest"], actions: Int[Array, " B"]) -> Float[Array, " B *rest"]:
    """values[i, actions[i]] for every i of the batch."""
    return jax.vmap(lambda value, action: value[action])(values, actions)


def support(v_min: float, v_max: float, num_atoms: int) -> Float[Array, " N"]:
    """The atoms z_i = v_min + (i - 1) (v_max - v_min) / (N - 1). Source: thesis 4.2.6."""
    return jnp.linspace(v_min, v_max, num_atoms, dtype=jnp.float32)


def project(
    shifted_atoms: Float[Array, "B N"], probabilities: Float[Array, "B N"], atoms: Float[Array, " N"]
) -> Float[Array, "B N"]:
    """Projects a distribution on moved atoms onto the evenly spaced support, sharing mass between neighbours.

    (Phi z)_i = sum_j clip(1 - |clip(z'_j, v_min, v_max) - z_i| / dz, 0, 1) p_j

    Args:
        shifted_atoms: r + discount * z, anywhere on the real line.
        probabilities: their masses.
        atoms: the evenly spaced support, rising.

    Returns:
        Masses on `atoms`: same total, and the same mean where nothing was clipped.

    Source: Bellemare et al. 2017, eq. 7; thesis 4.2.6.
    """
    chex.assert_equal_shape([shifted_atoms, probabilities])
    chex.assert_shape(atoms, shifted_atoms.shape[1:])
    width = (atoms[-1] - atoms[0]) / (atoms.shape[0] - 1)
    moved = jnp.clip(shifted_atoms, atoms[0], atoms[-1])
    share = jnp.clip(1.0 - jnp.abs(moved[:, None, :] - atoms[None, :, None]) / width, 0.0, 1.0)  # [B, N, N]
    return jnp.einsum("bij,bj->bi", share, probabilities, precision=jax.lax.Precision.HIGHEST)


def categorical_q_learning(
    logits_tm1: Float[Array, "B A N"],
    a_tm1: Int[Array, " B"],
    r_t: Float[Array, " B"],
    discount_t: Float[Array, " B"],
    logits_t_value: Float[Array, "B A N"],
    atoms: Float[Array, " N"],
    q_t_selector: Float[Array, "B A"],
) -> tuple[Float[Array, " B"], Float[Array, " B"]]:
    """Cross-entropy between the projected target distribution and the online one, and their KL divergence.

    Args:
        logits_tm1: online logits of the return distribution at t - 1.
        a_tm1: actions taken.
        r_t: (n-step) reward.
        discount_t: 0 where terminated.
        logits_t_value: target network's logits at t.
        atoms: the support.
        q_t_selector: action values that choose the action at t: means of the online network (double) or of the target.

    Returns:
        (cross-entropy, KL divergence), one each per sample. Both have the same gradient; the KL divergence is 0 for
        a perfect prediction, so it is what priorities are made of (Hessel et al. 2018, "The Integrated Agent": p_t is
        proportional to the KL loss to the power omega).

    Source: thesis eq. 4.17 and 4.2.6; Bellemare et al. 2017, Algorithm 1; Hessel et al. 2018.
    """
    chex.assert_rank([logits_tm1, a_tm1, r_t, discount_t, logits_t_value], [3, 1, 1, 1, 3])
    chex.assert_equal_shape([logits_tm1, logits_t_value])
    p_t = take_action(jax.nn.softmax(logits_t_value), jnp.argmax(q_t_selector, axis=-1))  # [B, N]
    target = project(r_t[:, None] + discount_t[:, None] * atoms[None], p_t, atoms)
    target = jax.lax.stop_gradient(target)
    log_p_tm1 = jax.nn.log_softmax(take_action(logits_tm1, a_tm1))
    cross_entropy = -jnp.sum(target * log_p_tm1, axis=-1)
    entropy = -jnp.sum(jax.scipy.special.xlogy(target, target), axis=-1)
    return cross_entropy, jnp.maximum(cross_entropy - entropy, 0.0)


def expectation(probabilities: Float[Array, "*batch N"], atoms: Float[Array, " N"]) -> Float[Array, "*batch"]:
    """Mean of a distribution on the atoms: Q(s, a) = E[Z(s, a)]. Source: thesis 4.2.6."""
    return jnp.einsum("...n,n->...", probabilities, atoms, precision=jax.lax.Precision.HIGHEST)


def quantile_midpoints(num_quantiles: int) -> Float[Array, "1 N"]:
    """QR-DQN's fractions (2i - 1) / 2N. Source: Dabney et al. 2018 (QR-DQN), Lemma 2."""
    return ((jnp.arange(num_quantiles, dtype=jnp.float32) + 0.5) / num_quantiles)[None]


def quantile_target(
    r_t: Float[Array, " B"],
    discount_t: Float[Array, " B"],
    z_t_value: Float[Array, "B A M"],
    q_t_selector: Float[Array, "B A"],
) -> Float[Array, "B M"]:
    """r + discount * Z'(s', argmax_a S(s', a)), quantile by quantile; no gradient flows through it.

    Args:
        r_t: (n-step) reward.
        discount_t: 0 where terminated.
        z_t_value: target network's quantile values at t; M of QR-DQN, or at M fractions that IQN sampled.
        q_t_selector: action values that choose the action at t: means of the online network (double) or of the target.

    Source: Dabney et al. 2018 (QR-DQN), Algorithm 1; Dabney et al. 2018 (IQN), eq. 2.
    """
    chex.assert_rank([r_t, discount_t, z_t_value], [1, 1, 3])
    chex.assert_equal_shape([q_t_selector, z_t_value[:, :, 0]])
    z_t = take_action(z_t_value, jnp.argmax(q_t_selector, axis=-1))
    return jax.lax.stop_gradient(r_t[:, None] + discount_t[:, None] * z_t)


def munchausen_target(
    q_tm1: Float[Array, "B A"],
    a_tm1: Int[Array, " B"],
    r_t: Float[Array, " B"],
    discount_t: Float[Array, " B"],
    z_t: Float[Array, "B A M"],
    q_t: Float[Array, "B A"],
    alpha: float = 0.9,
    temperature: float = 0.03,
    lowest: float = -1.0,
) -> Float[Array, "B M"]:
    """r + alpha [T ln pi(a|s)] + discount * sum over a' of pi(a'|s') (Z'(s', a') - T ln pi(a'|s')).

    pi = softmax(q / T); the bracket is clipped to [lowest, 0]. With n steps there is one such bonus, that of the first
    action, as in BTR.

    M = 1 is Munchausen-DQN (its TD error is the target's one column less Q(s, a)); more are quantiles, as M-IQN and BTR
    use it: pi comes of their means, and quantiles of one fraction are mixed over the actions. There is no form for
    categorical distributions: neither the paper nor BTR has one.

    Args:
        q_tm1: action values at t - 1 that pi(a|s) comes of: the target network's in the paper. BTR takes the online
            network's, which saves a forward pass. No gradient flows through them. Minus infinity for masked actions.
        a_tm1: actions taken.
        r_t: (n-step) reward.
        discount_t: 0 where terminated.
        z_t: target network's values at t.
        q_t: their means, which pi(.|s') comes of; minus infinity for masked actions, which pi never takes.
        alpha: scale of the bonus.
        temperature: T, the paper's tau; in units of the return.
        lowest: bound of the bonus, the paper's l0.

    Source: Vieillard, Pietquin and Geist 2020, eq. 1 and 2, appendix B (M-IQN, the default values); Clark et al. 2024
    (BTR).
    """
    chex.assert_rank([q_tm1, a_tm1, r_t, discount_t, z_t, q_t], [2, 1, 1, 1, 3, 2])
    chex.assert_equal_shape([q_tm1, z_t[:, :, 0], q_t])
    bonus = temperature * take_action(jax.nn.log_softmax(q_tm1 / temperature), a_tm1)
    pi_t = jax.nn.softmax(q_t / temperature)
    value = jnp.einsum("ba,bam->bm", pi_t, z_t, precision=jax.lax.Precision.HIGHEST)
    value += temperature * jax.scipy.special.entr(pi_t).sum(axis=1, keepdims=True)  # 0 ln 0 is 0 there
    reward = r_t + alpha * jnp.clip(bonus, lowest, 0.0)
    return jax.lax.stop_gradient(reward[:, None] + discount_t[:, None] * value)


def quantile_huber(
    z_tm1: Float[Array, "B N"], fractions: Float[Array, "#B N"], targets: Float[Array, "B M"], kappa: float = 1.0
) -> Float[Array, " B"]:
    """Quantile regression: sum over i of the mean over j of |f_i - 1(u_ij < 0)| huber(u_ij, kappa) / kappa.

    u_ij = target_j - z_i. QR-DQN and IQN share it: the fractions f are fixed there and sampled here.

    Args:
        z_tm1: online quantile values of the action taken.
        fractions: of which they are the quantiles, in 0..1; `quantile_midpoints(N)` in QR-DQN.
        targets: samples of the target distribution, constant: `quantile_target` or `munchausen_target`.
        kappa: where the loss becomes linear, > 0.

    Source: Dabney et al. 2018 (QR-DQN), eq. 10; Dabney et al. 2018 (IQN), eq. 3.
    """
    chex.assert_rank([z_tm1, fractions, targets], 2)
    u = jax.lax.stop_gradient(targets)[:, None, :] - z_tm1[:, :, None]  # [B, N, M]
    weight = jnp.abs(fractions[:, :, None] - (u < 0))
    return jnp.sum(jnp.mean(weight * huber(u, kappa) / kappa, axis=2), axis=1)
