"""Agents: the contract of all there are, DQN as Rainbow without its parts, each part's effect, agents in files."""

import copy
import re
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gvz.core.errors import ConfigError
from gvz.core.registry import discover
from learner.agents.base import OffPolicyAgent, epsilon_greedy, make_agent
from learner.augment import training_view
from learner.config import ValueConfig, agent_config_class, change_agent
from tests.learner.small_agents import ALL_OFF, RAINBOW, SPEC, A, B, batch, jitted, made_up_params

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


def test_a_loss_of_sight_does_not_learn_from_frames_that_are_moved_aside():
    replace(RAINBOW, sight_weight=0.1, augmentations=("shift",), sight_augmentations=("gamma", "vertical_shift"))
    for fields in ({"augmentations": ("shift",)}, {"sight_augmentations": ("gamma", "shift")}):
        with pytest.raises(ConfigError, match="sight_weight: got frames that `shift` moves aside"):
            replace(RAINBOW, sight_weight=0.1, **fields)


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
    for config, masked in ((ALL_OFF, False), (replace(ALL_OFF, task_conditioned=True), True)):
        rainbow, dqn = jitted(config), jitted(change_agent(config, "dqn"))
        assert jax.eval_shape(rainbow[0].init, jax.random.key(0)) == jax.eval_shape(dqn[0].init, jax.random.key(0))
        params, target, b = made_up_params(dqn[0], 0), made_up_params(dqn[0], 1), batch()
        if masked:
            best = np.asarray(dqn[2](target, b.obs_t).action)
            b = replace(b, obs_t=replace(b.obs_t, mask=jnp.asarray(best[:, None] != np.arange(A))))
        for epsilon in (0.0, 0.5):
            args = (params, jax.random.key(5), b.obs_t, jnp.float32(epsilon))
            np.testing.assert_array_equal(rainbow[1](*args)[0], dqn[1](*args)[0])
        ours, theirs = (agent[3](params, target, jax.random.key(2), b) for agent in (rainbow, dqn))
        jax.tree.map(np.testing.assert_array_equal, ours, theirs)
        ours, theirs = (agent[2](params, b.obs_t) for agent in (rainbow, dqn))
        jax.tree.map(np.testing.assert_array_equal, ours, theirs)


def test_only_the_online_network_sees_augmented_frames_and_hidden_inputs(agent_name: str):
    """At strength 0, and with nothing hidden, the loss is as without; else its targets stay as they were."""
    plain = plain_config(agent_name)
    if getattr(plain, "noisy", "off") != "off":
        plain = replace(plain, noisy="off")
    plain = replace(plain, stack_size=2, past_actions=SPEC.num_past_actions, game_variables=True)
    changed = replace(plain, augmentations=("inversion", "shift"), augmentation_clean_share=0.0, hidden_input_share=1.0)
    none = replace(changed, augmentation_strength=0.0, hidden_input_share=0.0)
    params, target = (made_up_params(jitted(plain)[0], seed) for seed in (0, 1))
    found = [jitted(config)[3](params, target, jax.random.key(3), batch()) for config in (plain, none, changed)]
    jax.tree.map(np.testing.assert_array_equal, found[0], found[1])
    again = jitted(changed)[3](params, target, jax.random.key(4), batch())
    for other in (found[0], again):  # clean, and augmented with other noise
        assert np.abs(np.asarray(other.q_tm1 - found[2].q_tm1)).max() > 0.01
    before, after = (np.asarray(result.td_error + result.q_tm1) for result in (found[0], found[2]))
    np.testing.assert_allclose(before, after, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    "parts",
    [
        {},
        {"double": True},
        {"distributional": True},
        {"distributional": True, "num_quantiles": 5},
        {"double": True, "munchausen": True},
        {"double": True, "distributional": True, "num_quantiles": 5, "munchausen": True},
        {"name": "in a file"},
    ],
    ids=str,
)
def test_no_target_reads_the_value_of_a_masked_action(parts: dict, agent_file: Path):
    """Another value of a masked action leaves loss and priority as they are, to the last bit."""
    config = plain_config(str(agent_file)) if "name" in parts else replace(ALL_OFF, **parts)
    agent, _, _, loss = jitted(config)
    params = made_up_params(agent, 0)
    of_last_action = slice(-(len(params["params"]["q_output"]["bias"]) // A), None)
    changed = copy.deepcopy(params)
    changed["params"]["q_output"]["kernel"][of_last_action] *= -20
    allowed = jnp.broadcast_to(jnp.arange(A) < A - 1, (B, A))
    open_to_all = batch()
    masked = replace(
        open_to_all,
        a_tm1=jnp.minimum(open_to_all.a_tm1, A - 2),
        obs_tm1=replace(open_to_all.obs_tm1, mask=allowed),
        obs_t=replace(open_to_all.obs_t, mask=allowed),
    )
    for b, is_equal in ((masked, True), (open_to_all, False)):
        before, after = (loss(p, p, jax.random.key(3), b) for p in (params, changed))
        assert np.isfinite(before.loss).all()
        assert np.array_equal(before.loss, after.loss) == is_equal
        assert np.array_equal(before.priority, after.priority) == is_equal


def test_a_masked_action_is_never_chosen(agent_name: str):
    """The best action of every sample is masked."""
    agent, act, evaluate, _ = jitted(plain_config(agent_name))
    params, obs = made_up_params(agent, 0), batch().obs_t
    best = np.asarray(evaluate(params, obs).action)
    masked = replace(obs, mask=jnp.asarray(best[:, None] != np.arange(A)))
    chosen = [evaluate(params, masked).action]
    chosen += [act(params, jax.random.key(n), masked, jnp.float32(n % 2))[0] for n in range(20)]
    assert not any(np.any(action == best) for action in chosen)


def test_parts_that_do_not_fit_together_are_refused():
    with pytest.raises(ConfigError, match=r"agent\.hidden_input_share: got 0\.2 with nothing to hide"):
        replace(RAINBOW, hidden_input_share=0.2)
    with pytest.raises(ConfigError, match=r"agent\.sight_augmentations: got inversion without a loss that reads them"):
        replace(RAINBOW, sight_augmentations=("inversion",))
    with pytest.raises(ConfigError, match=r"agent\.munchausen: got True with atoms, for which no form is published"):
        replace(RAINBOW, munchausen=True)
    with pytest.raises(ConfigError, match=r"agent\.num_quantiles: got quantiles of no distribution"):
        replace(RAINBOW, distributional=False, num_quantiles=5)


def test_distribution_masses_sum_to_one_and_their_mean_is_q():
    agent, _, evaluate, _ = jitted(RAINBOW)
    result = evaluate(made_up_params(agent, 0), batch().obs_t)
    np.testing.assert_allclose(result.atoms, np.linspace(-2, 3, 11), atol=1e-6)
    probabilities = np.asarray(result.probabilities)
    np.testing.assert_allclose(probabilities.sum(-1), 1.0, rtol=1e-5)
    np.testing.assert_allclose(probabilities @ np.asarray(result.atoms), result.q_values, atol=1e-5)


def test_a_fresh_agent_gives_every_state_and_action_the_initial_value(agent_name: str):
    """2.5 is far from the middle of the atoms, 0.5. That the default is 0 is a part of the agents' contract."""
    more = [replace(RAINBOW, dueling=False), replace(RAINBOW, num_quantiles=5)] if agent_name == "rainbow" else []
    for config in (plain_config(agent_name), *more):
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


def test_a_game_alone_explores_all_its_allowed_actions_alike():
    """The numbers that choose the action are others than the one that says whether it is by chance."""
    q, mask = jnp.zeros((1, 3)).at[0, 2].set(1.0), jnp.ones((1, 3), bool)
    draw = jax.jit(jax.vmap(lambda key: epsilon_greedy(key, q, jnp.float32(0.3), mask)[0]))
    counts = np.bincount(draw(jax.random.split(jax.random.key(1), 6000)), minlength=3) / 6000
    np.testing.assert_allclose(counts, [0.1, 0.1, 0.8], atol=0.025)


def test_noise_can_have_random_actions_beside_it():
    config = replace(RAINBOW, noisy="factorized", noisy_epsilon=0.3)
    assert [config.epsilon(steps) for steps in (0, 10**7)] == [0.3, 0.3]
    assert replace(config, noisy="off", noisy_epsilon=0.0).epsilon(10**7) == pytest.approx(config.epsilon_end)
    agent, act, _, _ = jitted(config)
    obs = jax.tree.map(lambda x: jnp.repeat(x[:1], 3000, axis=0), batch().obs_t)
    params = made_up_params(agent, 0, sigma=0.0)  # so that the noise alone would choose one action
    (greedy, _), (chosen, _) = (
        act(params, jax.random.key(1), obs, jnp.float32(epsilon)) for epsilon in (0.0, config.epsilon(0))
    )
    assert len(set(np.asarray(greedy).tolist())) == 1
    np.testing.assert_allclose(np.mean(np.asarray(chosen != greedy)), 0.3 * (A - 1) / A, atol=0.04)


def test_hidden_inputs_are_whole_samples_drawn_at_random():
    config = replace(
        plain_config("dqn"), past_actions=SPEC.num_past_actions, game_variables=True, hidden_input_share=0.2
    )
    obs = jax.tree.map(lambda x: jnp.ones((5000, *x.shape[1:]), x.dtype), batch().obs_t)
    seen = training_view(config, jax.random.key(1), obs)
    hidden = np.asarray(seen.vector == 0).all(1)
    np.testing.assert_allclose(hidden.mean(), 0.2, atol=0.025)
    assert (np.asarray(seen.vector == 0).any(1) == hidden).all()
    assert ((np.asarray(seen.actions) == -1) == hidden[:, None]).all()
    others = replace(seen, vector=obs.vector, actions=obs.actions)
    jax.tree.map(np.testing.assert_array_equal, others, obs)


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


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (
            "DQNConfig()",
            r"own\.py sets CONFIG to DQNConfig\(name='dqn', .*, want a class made from one of learner/config",
        ),
        ("int", r"own\.py sets CONFIG to <class 'int'>, want a class made from"),
        ("Lacking", r"agent\.name: alpha of Lacking in .*own\.py has no default, want one"),
    ],
)
def test_a_configuration_that_is_no_class_with_defaults_is_refused(tmp_path: Path, config: str, message: str):
    (tmp_path / "own.py").write_text(
        "from dataclasses import dataclass\n"
        "from learner.agents.configs.dqn import DQNConfig\n"
        "@dataclass(frozen=True, kw_only=True)\n"
        "class Lacking(DQNConfig):\n"
        "    alpha: float\n"
        f"CONFIG = {config}\n"
    )
    with pytest.raises(ConfigError, match=message):
        agent_config_class(str(tmp_path / "own.py"))


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
