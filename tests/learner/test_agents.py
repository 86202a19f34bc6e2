"""Agents: the contract of all there are, DQN as Rainbow without its parts, each part's effect, agents in files."""

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gvz.core.env_config import SIGHT_CLASSES
from gvz.core.errors import ConfigError
from gvz.core.registry import discover
from learner import losses
from learner.agents.base import Agent, AgentSpec, OffPolicyAgent, epsilon_greedy, make_agent
from learner.agents.configs.rainbow import RainbowConfig
from learner.agents.rainbow import Rainbow
from learner.config import ValueConfig, agent_config_class, change_agent
from learner.networks import add_noise
from learner.observation import Observation
from learner.replay import Transitions
from tests.learner import reference

B, A = 6, 3
SPEC = AgentSpec(
    obs_shape=(10, 10, 2), num_actions=A, num_tasks=2, v_min=-2.0, v_max=3.0, num_variables=2, num_past_actions=3
)
RAINBOW = RainbowConfig(
    conv_channels=(4,), conv_kernels=(4,), conv_strides=(2,), hidden_units=8, num_atoms=11, noisy_sigma=0.3
)
ALL_OFF = replace(RAINBOW, double=False, dueling=False, noisy="off", distributional=False)
AGENT_NAMES = [
    name
    for name, module in discover("learner.agents").items()
    if hasattr(module, "AGENT") and not agent_config_class(name).on_policy
]
"""those that learn from a replay; the others are test_on_policy_agents'"""


def plain_config(name: str) -> ValueConfig:
    """A small configuration that agent `name` accepts."""
    config = change_agent(replace(ALL_OFF, n_steps=1), name)
    assert isinstance(config, ValueConfig)
    return RAINBOW if name == "rainbow" else config


@pytest.fixture(scope="session")
def agent_file(tmp_path_factory) -> Path:
    """The agent that docs/AGENTS.md writes, as a file."""
    page = Path(__file__).parents[2] / "docs" / "AGENTS.md"
    (example,) = re.findall(r"```python\n(.*?)```", page.read_text(), flags=re.DOTALL)
    file = tmp_path_factory.mktemp("agents") / "munchausen.py"
    file.write_text(example)
    return file


@pytest.fixture(params=[*AGENT_NAMES, "in a file"])
def agent_name(request, agent_file: Path) -> str:
    """Every agent there is: those discovered by file name, and the documented one by its path."""
    return str(agent_file) if request.param == "in a file" else request.param


def batch(seed: int = 0) -> Transitions:
    rng = np.random.default_rng(seed)
    obs = rng.integers(0, 256, (2, B, *SPEC.obs_shape), dtype=np.uint8)
    task = jnp.asarray(rng.integers(0, 2, B), jnp.int32)
    actions = rng.integers(-1, A, (2, B, SPEC.num_past_actions))
    vector = rng.normal(0, 50, (2, B, SPEC.num_variables))
    obs_tm1, obs_t = (
        Observation(
            frames=jnp.asarray(obs[i]),
            vector=jnp.asarray(vector[i], jnp.float32),
            actions=jnp.asarray(actions[i], jnp.int32),
            task=task,
        )
        for i in range(2)
    )
    return Transitions(
        obs_tm1=obs_tm1,
        a_tm1=jnp.asarray(rng.integers(0, A, B), jnp.int32),
        r_t=jnp.asarray(rng.normal(size=B), jnp.float32),
        discount_t=jnp.asarray(rng.choice([0.0, 0.97], B), jnp.float32),
        obs_t=obs_t,
    )


@cache
def jitted(config: ValueConfig):
    """The agent, and its functions compiled when first called."""
    agent = make_agent(config, SPEC)
    return agent, jax.jit(agent.act), jax.jit(agent.evaluate), jax.jit(agent.loss)


def made_up_params(agent: Agent, seed: int, sigma: float = 0.3):
    """Parameters without the compilation of `init`."""
    rng = np.random.default_rng(seed)

    def leaf(path, shape):
        noisy = "sigma" in jax.tree_util.keystr(path)
        return np.full(shape.shape, sigma, np.float32) if noisy else rng.normal(0, 0.2, shape.shape).astype(np.float32)

    return jax.tree_util.tree_map_with_path(leaf, jax.eval_shape(agent.init, jax.random.key(0)))


def test_both_examples_are_discovered():
    assert {"rainbow", "dqn"} <= set(AGENT_NAMES)


def test_every_agent_keeps_the_contract(agent_name: str):
    agent, act, evaluate, loss = jitted(plain_config(agent_name))
    init = jax.jit(agent.init)
    assert agent == make_agent(plain_config(agent_name), SPEC), "two agents of one configuration are equal"
    assert hash(agent) == hash(make_agent(plain_config(agent_name), SPEC))
    assert agent.spec == SPEC
    params, target = init(jax.random.key(0)), init(jax.random.key(1))
    jax.tree.map(np.testing.assert_array_equal, params, init(jax.random.key(0)))
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(params))
    b = batch()
    action, extras = act(params, jax.random.key(2), b.obs_t, jnp.float32(0.5))
    assert extras.shape == (B, 0)
    assert action.shape == (B,)
    assert action.dtype == jnp.int32
    assert set(np.asarray(action).tolist()) <= set(range(A))
    evaluation = evaluate(params, b.obs_t)
    assert evaluation.q_values.shape == (B, A)
    np.testing.assert_array_equal(evaluation.action, np.asarray(evaluation.q_values).argmax(-1))
    np.testing.assert_allclose(evaluation.q_values, 0.0, atol=2e-6)  # agent.initial_value
    result = loss(params, target, jax.random.key(3), b)
    for value in result:
        assert value.shape == (B,)
        assert np.isfinite(value).all()
    assert (np.asarray(result.priority) >= 0).all()


def test_no_gradient_reaches_the_target_parameters(agent_name: str):
    agent, _, _, _ = jitted(plain_config(agent_name))
    params, target = (made_up_params(agent, seed) for seed in (0, 1))

    def total(online, target):
        return agent.loss(online, target, jax.random.key(3), batch()).loss.sum()

    into_online, into_target = jax.jit(jax.grad(total, argnums=(0, 1)))(params, target)
    assert all(not np.any(leaf) for leaf in jax.tree.leaves(into_target))
    assert all(np.any(leaf) for leaf in jax.tree.leaves(into_online))


def test_rainbow_with_every_part_off_is_dqn_to_the_last_bit():
    for config in (ALL_OFF, replace(ALL_OFF, task_conditioned=True)):
        rainbow, dqn = jitted(config), jitted(change_agent(config, "dqn"))
        assert jax.eval_shape(rainbow[0].init, jax.random.key(0)) == jax.eval_shape(dqn[0].init, jax.random.key(0))
        params, target, b = made_up_params(dqn[0], 0), made_up_params(dqn[0], 1), batch()
        for epsilon in (0.0, 0.5):
            args = (params, jax.random.key(5), b.obs_t, jnp.float32(epsilon))
            np.testing.assert_array_equal(rainbow[1](*args)[0], dqn[1](*args)[0])
        ours, theirs = (agent[3](params, target, jax.random.key(2), b) for agent in (rainbow, dqn))
        jax.tree.map(np.testing.assert_array_equal, ours, theirs)
        ours, theirs = (agent[2](params, b.obs_t) for agent in (rainbow, dqn))
        jax.tree.map(np.testing.assert_array_equal, ours, theirs)


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
    ("double", "distributional", "dueling"), [(True, True, True), (False, True, False), (True, False, True)]
)
def test_rainbow_loss_is_its_equations_in_float64_with_a_noise_each_for_online_target_and_choice(
    double: bool, distributional: bool, dueling: bool
):
    """A network whose means are the noisy weights, applied without noise, is the noisy network."""
    config = replace(RAINBOW, double=double, distributional=distributional, dueling=dueling)
    agent, _, _, loss = jitted(config)
    params, target, b = made_up_params(agent, 0), made_up_params(agent, 1), batch()
    result = loss(params, target, jax.random.key(7), b)

    key_online, key_target, key_selector = jax.random.split(jax.random.key(7), 3)
    atoms = np.linspace(SPEC.v_min, SPEC.v_max, config.num_atoms) if distributional else None
    online, moved_target, chooser = (
        add_noise(p, key, "factorized")
        for p, key in ((params, key_online), (target, key_target), (params, key_selector))
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
    config = replace(
        RAINBOW,
        noisy="off",
        distributional=num_quantiles > 0,
        num_quantiles=num_quantiles,
        munchausen=munchausen,
        munchausen_temperature=0.5,
    )
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
            reward = float(b.r_t[i]) + 0.9 * max(-1.0, 0.5 * log_pi_past[action])
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
    C = len(SIGHT_CLASSES) * 4
    agent = make_agent(replace(RAINBOW, sight_weight=0.7), replace(SPEC, num_sights=C))
    _, act, _, plain_loss = jitted(RAINBOW)
    assert isinstance(agent, OffPolicyAgent)
    params, target = made_up_params(agent, 0), made_up_params(agent, 1)
    plain, plain_target = ({"params": {k: v for k, v in p["params"].items() if k != "sight"}} for p in (params, target))
    seen = np.random.default_rng(5).integers(0, 2, (B, C), dtype=np.uint8)
    key, b = jax.random.key(3), replace(batch(), sight_tm1=jnp.asarray(seen))
    found, without = jax.jit(agent.loss)(params, target, key, b), plain_loss(plain, plain_target, key, batch())

    conv, head = ({k: np.asarray(w, np.float64) for k, w in params["params"][n].items()} for n in ("conv_0", "sight"))
    x = reference.convolve(np.asarray(b.obs_tm1.frames, np.float64) / 255, conv["kernel"], conv["bias"], 2)
    x = np.maximum(x, 0).reshape(B, -1)
    x = (x - x.mean(1, keepdims=True)) / np.sqrt(x.var(1, keepdims=True) + 1e-6)
    p = 1 / (1 + np.exp(-(x @ head["kernel"] + head["bias"])))
    nats = -np.where(seen, np.log(p), np.log(1 - p)).reshape(B, len(SIGHT_CLASSES), 4).mean(axis=2).sum(axis=1)
    np.testing.assert_allclose(found.loss, without.loss + 0.7 * nats, rtol=1e-4, atol=1e-5)
    for name in ("priority", "q_tm1", "td_error"):
        np.testing.assert_allclose(getattr(found, name), getattr(without, name), rtol=1e-4, atol=1e-5)
    acted = [f(p, key, b.obs_tm1, jnp.float32(0)) for f, p in ((jax.jit(agent.act), params), (act, plain))]
    jax.tree.map(np.testing.assert_array_equal, *acted)


def test_augmentations_of_sight_change_the_frames_of_the_loss_of_sight_alone():
    """Each sample's loss of sight is that of its clean or of its inverted frames; values and priorities stay."""
    C = len(SIGHT_CLASSES) * 4
    clean_config = replace(RAINBOW, sight_weight=0.7, stack_size=2)
    config = replace(clean_config, sight_augmentations=("inversion",), augmentation_clean_share=0.0)
    agent, clean_agent = (Rainbow(config=c, spec=replace(SPEC, num_sights=C)) for c in (config, clean_config))
    params, target = made_up_params(agent, 0), made_up_params(agent, 1)
    seen = np.random.default_rng(5).integers(0, 2, (B, C), dtype=np.uint8)
    b = replace(batch(), sight_tm1=jnp.asarray(seen))
    inverted = replace(b, obs_tm1=replace(b.obs_tm1, frames=255 - b.obs_tm1.frames))
    clean_loss, key = jax.jit(clean_agent.loss), jax.random.key(3)
    found, clean = jax.jit(agent.loss)(params, target, key, b), clean_loss(params, target, key, b)
    for name in ("priority", "q_tm1", "td_error"):
        np.testing.assert_allclose(getattr(found, name), getattr(clean, name), rtol=1e-5, atol=1e-6)

    change = np.asarray(found.loss - clean.loss)
    logits, inverted_logits = (agent.outputs_and_sight(params, x.obs_tm1)[1] for x in (b, inverted))
    assert logits is not None
    assert inverted_logits is not None
    sight, inverted_sight = (losses.sight(x, jnp.asarray(seen), len(SIGHT_CLASSES)) for x in (logits, inverted_logits))
    wanted = 0.7 * np.asarray(inverted_sight - sight)
    is_inverted = np.isclose(change, wanted, rtol=1e-3, atol=1e-5)
    assert (is_inverted | np.isclose(change, 0, atol=1e-5)).all()
    assert 0 < is_inverted.sum() < B
    assert np.abs(wanted).min() > 1e-3, "the two cannot be told apart"


def test_only_the_online_network_sees_augmented_frames_and_hidden_inputs(agent_name: str):
    """At strength 0, and with nothing hidden, the loss is as without; else its targets stay as they were."""
    plain = plain_config(agent_name)
    if getattr(plain, "noisy", "off") != "off":
        plain = replace(plain, noisy="off")
    plain = replace(plain, stack_size=2)
    changed = replace(plain, augmentations=("inversion", "shift"), augmentation_clean_share=0.0, hidden_input_share=1.0)
    none = replace(changed, augmentation_strength=0.0, hidden_input_share=0.0)
    params, target = (made_up_params(jitted(plain)[0], seed) for seed in (0, 1))
    found = [jitted(config)[3](params, target, jax.random.key(3), batch()) for config in (plain, none, changed)]
    jax.tree.map(np.testing.assert_array_equal, found[0], found[1])
    if agent_name.endswith(".py"):
        return  # a user's agent need not look at these settings
    assert np.abs(np.asarray(found[0].q_tm1 - found[2].q_tm1)).max() > 0.01
    before, after = (np.asarray(result.td_error + result.q_tm1) for result in (found[0], found[2]))
    np.testing.assert_allclose(before, after, rtol=1e-4, atol=1e-5)


def test_parts_that_do_not_fit_together_are_refused():
    with pytest.raises(ConfigError, match=r"agent\.sight_augmentations: got inversion without a loss that reads them"):
        replace(RAINBOW, sight_augmentations=("inversion",))
    with pytest.raises(ConfigError, match=r"agent\.munchausen: got True with atoms, for which no form is published"):
        replace(RAINBOW, munchausen=True)
    with pytest.raises(ConfigError, match=r"agent\.num_quantiles: got quantiles of no distribution"):
        replace(RAINBOW, distributional=False, num_quantiles=5)


def test_gradient_of_the_whole_rainbow_loss_equals_finite_differences():
    """Through noise, dueling streams and convolutions, along random directions; a rectifier's kink is rarely met."""
    agent, _, _, loss = jitted(RAINBOW)
    params, target, b = made_up_params(agent, 0), made_up_params(agent, 1), batch()

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


def test_distribution_masses_sum_to_one_and_their_mean_is_q():
    agent, _, evaluate, _ = jitted(RAINBOW)
    result = evaluate(made_up_params(agent, 0), batch().obs_t)
    np.testing.assert_allclose(result.atoms, np.linspace(-2, 3, 11), atol=1e-6)
    probabilities = np.asarray(result.probabilities)
    np.testing.assert_allclose(probabilities.sum(-1), 1.0, rtol=1e-5)
    np.testing.assert_allclose(probabilities @ np.asarray(result.atoms), result.q_values, atol=1e-5)


@pytest.mark.parametrize(
    "config", [RAINBOW, replace(RAINBOW, dueling=False), change_agent(ALL_OFF, "dqn")], ids=["rainbow", "flat", "dqn"]
)
def test_a_fresh_agent_gives_every_state_and_action_the_initial_value(config: ValueConfig):
    """2.5 is far from the middle of the atoms, 0.5. That the default is 0 is a part of the agents' contract."""
    agent, _, evaluate, _ = jitted(replace(config, initial_value=2.5))
    fresh = evaluate(jax.jit(agent.init)(jax.random.key(1)), batch().obs_t)
    np.testing.assert_allclose(fresh.q_values, 2.5, atol=2e-6)


def test_an_initial_value_that_no_distribution_has_is_refused():
    for value in (-2.0, 3.0, 5.0):
        with pytest.raises(ConfigError, match=rf"initial_value: got {value}, want more than v_min -2\.0 and less than"):
            make_agent(replace(RAINBOW, initial_value=value), SPEC)
    make_agent(replace(RAINBOW, initial_value=5.0, distributional=False), SPEC)


def test_configured_value_range_overrides_the_scenario_range():
    agent = make_agent(replace(RAINBOW, v_max=10.0), SPEC)
    np.testing.assert_allclose(np.asarray(agent.atoms)[[0, -1]], [-2.0, 10.0])
    with pytest.raises(ConfigError, match=r"v_min, v_max: got 3\.5, 3\.0, want v_min < v_max"):
        make_agent(replace(RAINBOW, v_min=3.5), SPEC)


@pytest.mark.parametrize("noisy", ["factorized", "independent"])
def test_acting_draws_fresh_noise_every_step(noisy):
    agent, act, evaluate, _ = jitted(replace(RAINBOW, noisy=noisy))
    params, b = made_up_params(agent, 0, sigma=3.0), batch()
    acts = np.stack([act(params, jax.random.key(i), b.obs_t, jnp.float32(0))[0] for i in range(20)])
    assert all(len(set(column)) > 1 for column in acts.T), "noise this large must change every game's action"
    greedy = [evaluate(params, b.obs_t).action for _ in range(2)]
    np.testing.assert_array_equal(*greedy)


def test_games_of_one_call_have_noise_of_their_own():
    agent, act, _, _ = jitted(RAINBOW)
    same = jax.tree.map(lambda leaf: jnp.repeat(leaf[:1], B, axis=0), batch().obs_t)
    acts, _ = act(made_up_params(agent, 0, sigma=3.0), jax.random.key(1), same, jnp.float32(0))
    assert len(set(np.asarray(acts).tolist())) > 1


def test_epsilon_is_the_share_of_uniformly_random_actions():
    q = np.tile(np.float32([[0.0, 0.0, 1.0]]), (6000, 1))
    draw = jax.jit(epsilon_greedy)
    assert (np.asarray(draw(jax.random.key(0), q, jnp.float32(0.0))) == 2).all()
    for epsilon in (0.3, 1.0):
        counts = np.bincount(draw(jax.random.key(1), q, jnp.float32(epsilon)), minlength=3) / 6000
        np.testing.assert_allclose(counts, [epsilon / 3, epsilon / 3, 1 - 2 * epsilon / 3], atol=0.025)


def test_unknown_agent_is_refused_with_the_known_ones():
    with pytest.raises(
        ConfigError, match=r"got 'rainbw' \(did you mean 'rainbow'\?\), want one of dqn, ppo, pqn, rainbow, or"
    ):
        make_agent(replace(RAINBOW, name="rainbw"), SPEC)


def test_a_file_that_is_no_agent_is_refused(tmp_path: Path):
    with pytest.raises(ConfigError, match=r"agent\.name: no file .*/mine\.py; give a path from here"):
        make_agent(replace(RAINBOW, name=str(tmp_path / "mine.py")), SPEC)
    (tmp_path / "mine.py").write_text("class Mine: ...\n")
    with pytest.raises(ConfigError, match=r"mine\.py does not set CONFIG, want a line `CONFIG = \.\.\.`"):
        make_agent(replace(RAINBOW, name=str(tmp_path / "mine.py")), SPEC)


def test_a_path_from_here_names_the_same_agent(agent_file: Path, monkeypatch):
    from_anywhere = make_agent(plain_config(str(agent_file)), SPEC)
    monkeypatch.chdir(agent_file.parent)
    assert type(make_agent(plain_config("./munchausen.py"), SPEC)) is type(from_anywhere)


def test_a_configuration_of_another_agent_is_refused():
    with pytest.raises(ConfigError, match=r"agent\.name: got 'dqn' in a RainbowConfig, want a DQNConfig"):
        make_agent(replace(RAINBOW, name="dqn"), SPEC)


def test_another_agent_keeps_what_both_have():
    dqn = change_agent(replace(RAINBOW, discount=0.9, hidden_units=7), "dqn")
    assert (dqn.name, dqn.discount, dqn.hidden_units) == ("dqn", 0.9, 7)
    assert not hasattr(dqn, "num_atoms")


def test_wrong_spec_is_refused():
    with pytest.raises(ConfigError, match=r"AgentSpec\.v_min, v_max: got 1\.0, 1\.0"):
        replace(SPEC, v_min=1.0, v_max=1.0)
    with pytest.raises(ConfigError, match=r"AgentSpec\.num_actions: got 0, want at least 1"):
        replace(SPEC, num_actions=0)
    with pytest.raises(ConfigError, match=r"conv_kernels\[0\]: got 4, want at most 3"):
        jax.eval_shape(make_agent(RAINBOW, replace(SPEC, obs_shape=(3, 10, 2))).init, jax.random.key(0))


def test_agents_meet_the_protocol():
    assert all(isinstance(make_agent(plain_config(name), SPEC), OffPolicyAgent) for name in AGENT_NAMES)
