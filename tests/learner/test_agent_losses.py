"""The loss of each agent that learns from a replay: its equations in float64 numpy, its gradient, its noise."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gvz.core.env_config import SIGHT_CLASSES
from learner import losses
from learner.agents.base import make_agent
from learner.agents.configs.rainbow import Noisy
from learner.agents.rainbow import Rainbow
from learner.config import ValueConfig, change_agent
from learner.networks import add_noise
from learner.replay import Transitions
from tests.learner import reference
from tests.learner.small_agents import ALL_OFF, RAINBOW, SPEC, A, B, batch, jitted, made_up_params

SIGHT = replace(RAINBOW, sight_weight=0.7, stack_size=2), replace(SPEC, num_sights=len(SIGHT_CLASSES) * 4)
"""configuration and sizes of an agent that learns what is in sight"""
SEEN = jnp.asarray(np.random.default_rng(5).integers(0, 2, (B, len(SIGHT_CLASSES) * 4), dtype=np.uint8))
with_noise = jax.jit(add_noise, static_argnums=2)


def values(config: ValueConfig, params, obs, atoms=None) -> tuple[np.ndarray, np.ndarray]:
    """(logits, Q) in float64, of the network whose weights are the means of `params`."""
    logits = reference.network(config, params["params"], obs, A, SPEC.num_tasks)
    return logits, logits[:, :, 0] if atoms is None else reference.softmax(logits) @ atoms


@pytest.mark.isa
@pytest.mark.parametrize("task_conditioned", [False, True])
def test_dqn_loss_is_algorithm_1_with_the_huber_loss_in_float64(task_conditioned: bool):
    config = change_agent(replace(ALL_OFF, task_conditioned=task_conditioned), "dqn")
    assert isinstance(config, ValueConfig)
    agent, _, _, loss = jitted(config)
    params, target, b = made_up_params(agent, 0), made_up_params(agent, 1), batch()
    result = loss(params, target, jax.random.key(0), b)
    q_tm1 = values(config, params, b.obs_tm1)[1]
    td = reference.td(q_tm1, b.a_tm1, b.r_t, b.discount_t, values(config, target, b.obs_t)[1])
    np.testing.assert_allclose(result.td_error, td, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(result.priority, np.abs(td), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(result.loss, reference.huber(td), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(result.q_tm1, q_tm1[np.arange(B), b.a_tm1], rtol=1e-5, atol=1e-6)


@pytest.mark.isa
@pytest.mark.parametrize(
    ("double", "distributional", "dueling", "noisy"),
    [
        (True, True, True, "factorized"),
        (False, True, False, "independent"),
        (True, False, True, "factorized"),
    ],
)
def test_rainbow_loss_is_its_equations_in_float64_with_a_noise_each_for_online_target_and_choice(
    double: bool, distributional: bool, dueling: bool, noisy: Noisy
):
    """A network whose means are the noisy weights, applied without noise, is the noisy network."""
    config = replace(RAINBOW, double=double, distributional=distributional, dueling=dueling, noisy=noisy)
    agent, _, _, loss = jitted(config)
    params, target, b = made_up_params(agent, 0), made_up_params(agent, 1), batch()
    result = loss(params, target, jax.random.key(7), b)

    key_online, key_target, key_selector = jax.random.split(jax.random.key(7), 3)
    atoms = np.linspace(SPEC.v_min, SPEC.v_max, config.num_atoms) if distributional else None
    online, moved_target, chooser = (
        with_noise(p, key, noisy) for p, key in ((params, key_online), (target, key_target), (params, key_selector))
    )
    logits_tm1, q_tm1 = values(config, online, b.obs_tm1, atoms)
    logits_t, q_t = values(config, moved_target, b.obs_t, atoms)
    selector = values(config, chooser, b.obs_t, atoms)[1] if double else None
    td = reference.td(q_tm1, b.a_tm1, b.r_t, b.discount_t, q_t, selector)
    if distributional:
        wanted, priority = reference.categorical(logits_tm1, b.a_tm1, b.r_t, b.discount_t, logits_t, atoms, selector)
    else:
        wanted, priority = reference.huber(td), np.abs(td)
    np.testing.assert_allclose(result.td_error, td, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(result.q_tm1, q_tm1[np.arange(B), b.a_tm1], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(result.loss, wanted, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(result.priority, priority, rtol=1e-3, atol=1e-5)


def test_online_target_and_choice_of_the_next_action_have_independent_noise():
    """Where Q is nothing but the output biases' noise, a loss shows the three draws. Margins are five deviations."""
    agent = make_agent(replace(RAINBOW, dueling=False, distributional=False), SPEC)
    nothing = jax.tree.map(np.zeros_like, made_up_params(agent, 0))["params"]
    output, ones = nothing["q_output"], np.ones(A, np.float32)
    noise_alone = {"params": nothing | {"q_output": output | {"bias_sigma": ones}}}
    names_its_actions = {"params": nothing | {"q_output": output | {"bias": np.arange(A, dtype=np.float32)}}}
    zeros = SPEC.zeros(A)
    every_action = Transitions(
        obs_tm1=zeros,
        a_tm1=jnp.arange(A),
        r_t=jnp.zeros(A),
        discount_t=jnp.ones(A),
        obs_t=zeros,
    )

    @jax.jit
    @jax.vmap
    def draws(key):
        into_names = agent.loss(noise_alone, names_its_actions, key, every_action)
        into_noise = agent.loss(noise_alone, noise_alone, key, every_action)
        targets = [(result.td_error + result.q_tm1)[0] for result in (into_names, into_noise)]
        return into_noise.q_tm1, jnp.round(targets[0]).astype(int), targets[1]

    K = 900
    online, chosen, target = map(np.asarray, draws(jax.random.split(jax.random.key(0), K)))
    share_error = 5 * np.sqrt(1 / A * (1 - 1 / A) / K)
    np.testing.assert_allclose(np.bincount(chosen, minlength=A) / K, 1 / A, atol=share_error)
    assert (online.argmax(1) == chosen).mean() == pytest.approx(1 / A, abs=share_error)
    # of the chosen action, the target's noise is as often above 0 as below, and goes with no other noise
    assert target.mean() == pytest.approx(0.0, abs=5 * target.std() / np.sqrt(K))
    for other in (online[np.arange(K), chosen], *online.T):
        assert np.corrcoef(target, other)[0, 1] == pytest.approx(0.0, abs=5 / np.sqrt(K))


@pytest.mark.isa
@pytest.mark.parametrize(("num_quantiles", "munchausen"), [(7, False), (7, True), (0, True)])
def test_quantiles_and_munchausen_are_their_equations_in_float64(num_quantiles: int, munchausen: bool):
    """Rainbow without noise. Dabney et al. 2018 (QR-DQN), eq. 10; Vieillard et al. 2020, eq. 2."""
    config = replace(RAINBOW, noisy="off", distributional=num_quantiles > 0, num_quantiles=num_quantiles)
    if munchausen:
        config = replace(config, munchausen=True, munchausen_alpha=0.7, munchausen_temperature=0.5)
    agent, _, evaluate, loss = jitted(config)
    params, target, b = made_up_params(agent, 0), made_up_params(agent, 1), batch()
    result, N = loss(params, target, jax.random.key(7), b), max(1, num_quantiles)
    z_tm1, z_t, z_choice, z_past = (
        reference.network(config, p["params"], obs, A, SPEC.num_tasks)
        for p, obs in ((params, b.obs_tm1), (target, b.obs_t), (params, b.obs_t), (target, b.obs_tm1))
    )
    np.testing.assert_allclose(evaluate(params, b.obs_tm1).q_values, z_tm1.mean(-1), rtol=1e-4, atol=1e-5)
    for i in range(B):
        action, discount = int(b.a_tm1[i]), float(b.discount_t[i])
        if munchausen:
            log_pi_t = np.log(reference.softmax(z_t[i].mean(-1) / 0.5))
            log_pi_past = np.log(reference.softmax(z_past[i].mean(-1) / 0.5))
            value = sum(np.exp(log_pi_t[a]) * (z_t[i, a] - 0.5 * log_pi_t[a]) for a in range(A))
            reward = float(b.r_t[i]) + 0.7 * max(-1.0, 0.5 * log_pi_past[action])
        else:
            value, reward = z_t[i, z_choice[i].mean(-1).argmax()], float(b.r_t[i])
        targets = reward + discount * value
        u = targets[None] - z_tm1[i, action][:, None]
        fraction = ((np.arange(N) + 0.5) / N)[:, None]
        td = targets.mean() - z_tm1[i, action].mean()
        wanted = (
            (np.abs(fraction - (u < 0)) * reference.huber(u)).mean(1).sum() if num_quantiles else reference.huber(td)
        )
        np.testing.assert_allclose(result.loss[i], wanted, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(result.priority[i], abs(td), rtol=1e-4, atol=1e-5)


@pytest.mark.isa
def test_the_loss_of_sight_is_the_cross_entropy_of_logits_on_the_encoders_features():
    """In float64 numpy. It is added to the loss alone: priorities and actions are those of the agent without it."""
    agent, sight_act, _, sight_loss = jitted(*SIGHT)
    _, act, _, plain_loss = jitted(RAINBOW)
    params, target = made_up_params(agent, 0), made_up_params(agent, 1)
    plain, plain_target = ({"params": {k: v for k, v in p["params"].items() if k != "sight"}} for p in (params, target))
    key, b = jax.random.key(3), replace(batch(), sight_tm1=SEEN)
    found, without = sight_loss(params, target, key, b), plain_loss(plain, plain_target, key, batch())

    conv, head = ({k: np.asarray(w, np.float64) for k, w in params["params"][n].items()} for n in ("conv_0", "sight"))
    x = reference.convolve(np.asarray(b.obs_tm1.frames, np.float64) / 255, conv["kernel"], conv["bias"], 2)
    x = np.maximum(x, 0).reshape(B, -1)
    x = (x - x.mean(1, keepdims=True)) / np.sqrt(x.var(1, keepdims=True) + 1e-6)
    p = 1 / (1 + np.exp(-(x @ head["kernel"] + head["bias"])))
    nats = -np.where(SEEN, np.log(p), np.log(1 - p)).reshape(B, len(SIGHT_CLASSES), 4).mean(axis=2).sum(axis=1)
    np.testing.assert_allclose(found.loss, without.loss + 0.7 * nats, rtol=1e-4, atol=1e-5)
    for name in ("priority", "q_tm1", "td_error"):
        np.testing.assert_allclose(getattr(found, name), getattr(without, name), rtol=1e-4, atol=1e-5)
    acted = [f(p, key, b.obs_tm1, jnp.float32(0)) for f, p in ((sight_act, params), (act, plain))]
    jax.tree.map(np.testing.assert_array_equal, *acted)


def test_augmentations_of_sight_change_the_frames_of_the_loss_of_sight_alone():
    """Each sample's loss of sight is that of its clean or of its inverted frames; values and priorities stay."""
    config, spec = SIGHT
    agent = Rainbow(replace(config, sight_augmentations=("inversion",), augmentation_clean_share=0.0), spec)
    params, target = made_up_params(agent, 0), made_up_params(agent, 1)
    b = replace(batch(), sight_tm1=SEEN)
    inverted = replace(b, obs_tm1=replace(b.obs_tm1, frames=255 - b.obs_tm1.frames))
    augmented_loss, clean_loss, key = jax.jit(agent.loss), jitted(*SIGHT)[3], jax.random.key(3)
    found, clean = augmented_loss(params, target, key, b), clean_loss(params, target, key, b)
    for name in ("priority", "q_tm1", "td_error"):
        np.testing.assert_allclose(getattr(found, name), getattr(clean, name), rtol=1e-5, atol=1e-6)

    change = np.asarray(found.loss - clean.loss)
    logits, inverted_logits = (agent.outputs_and_sight(params, x.obs_tm1)[1] for x in (b, inverted))
    assert logits is not None
    assert inverted_logits is not None
    sight, inverted_sight = (losses.sight(x, SEEN, len(SIGHT_CLASSES)) for x in (logits, inverted_logits))
    wanted = 0.7 * np.asarray(inverted_sight - sight)
    is_inverted = np.isclose(change, wanted, rtol=1e-3, atol=1e-5)
    assert (is_inverted | np.isclose(change, 0, atol=1e-5)).all()
    assert 0 < is_inverted.sum() < B
    other = jax.random.key(4)
    again = np.asarray(augmented_loss(params, target, other, b).loss - clean_loss(params, target, other, b).loss)
    assert (is_inverted != np.isclose(again, wanted, rtol=1e-3, atol=1e-5)).any(), "each key chooses others"
    assert np.abs(wanted).min() > 1e-3, "the two cannot be told apart"


def test_gradient_of_the_whole_rainbow_loss_equals_finite_differences():
    """Through noise, both streams, sight and convolutions, along random directions; a rectifier's kink is rare."""
    agent, _, _, loss = jitted(*SIGHT)
    params, target = made_up_params(agent, 0), made_up_params(agent, 1)
    b = replace(batch(), sight_tm1=SEEN)

    def mean_loss(params):
        return loss(params, target, jax.random.key(3), b).loss.mean()

    grads, step = jax.jit(jax.grad(mean_loss))(params), 1e-3
    for seed in range(4):
        toward = made_up_params(agent, seed + 10, sigma=0.2)
        above = jax.tree.map(lambda p, d: p + step * d, params, toward)
        below = jax.tree.map(lambda p, d: p - step * d, params, toward)
        slope = (float(mean_loss(above)) - float(mean_loss(below))) / (2 * step)
        along = sum(np.vdot(g, d) for g, d in zip(jax.tree.leaves(grads), jax.tree.leaves(toward), strict=True))
        np.testing.assert_allclose(along, slope, rtol=0.02, atol=2e-3)


def test_bfloat16_activations_change_the_loss_little_and_keep_its_gradient_float32():
    params, target = (made_up_params(jitted(RAINBOW)[0], seed) for seed in (0, 1))
    found = []
    for dtype in ("float32", "bfloat16"):
        agent = make_agent(replace(RAINBOW, activation_dtype=dtype), SPEC)

        @jax.jit
        def slope(params, agent=agent):
            return jax.grad(lambda p: agent.loss(p, target, jax.random.key(3), batch()).loss.mean())(params)

        found.append(np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(slope(params))]))
    full, half = found
    assert half.dtype == np.float32
    assert np.linalg.norm(half - full) < 0.1 * np.linalg.norm(full)
