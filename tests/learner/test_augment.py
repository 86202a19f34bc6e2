"""Augmentations: what all of them promise, and each against slow numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gvz.core.errors import ConfigError
from learner import augment
from learner.agents.configs.dqn import DQNConfig
from learner.augment import AUGMENTATIONS, SHIFT_PIXELS
from learner.observation import Observation

H, W, S = 12, 16, 3
KINDS = [*((name, 3) for name in AUGMENTATIONS), ("random_conv", 1)]
augmented_by = jax.jit(augment.augment, static_argnums=(0, 3))


def stacks(batch: int, channels: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (batch, H, W, S * channels), dtype=np.uint8)


def run(name: str, frames: np.ndarray, channels: int, strength: float = 1.0, clean_share: float = 0.0, seed: int = 0):
    augmented = augmented_by((name,), jax.random.key(seed), jnp.asarray(frames), channels, strength, clean_share)
    assert augmented.dtype == jnp.uint8
    assert augmented.shape == frames.shape
    return np.asarray(augmented)


def apply(name: str, frames: np.ndarray, channels: int, strength: float = 1.0, seed: int = 0) -> np.ndarray:
    """The function itself, with a key of its own, so that an oracle can draw the same noise: [B, H, W, S, C]."""
    x = jnp.asarray(frames).reshape(*frames.shape[:3], -1, channels)
    return np.asarray(jax.jit(AUGMENTATIONS[name])(jax.random.key(seed), x, jnp.full(len(frames), strength)))


def uniform(shape: tuple[int, ...], low: float, seed: int = 0) -> np.ndarray:
    return np.asarray(jax.random.uniform(jax.random.key(seed), shape, minval=low), np.float64)


# --- what all of them promise -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "channels"), KINDS)
def test_strength_0_is_the_identity_of_every_value(name: str, channels: int):
    frames = stacks(20, channels)
    assert len(np.unique(frames)) == 256
    np.testing.assert_array_equal(run(name, frames, channels, strength=0.0), frames)


@pytest.mark.parametrize(("name", "channels"), KINDS)
def test_frames_of_a_stack_share_their_noise_and_samples_have_their_own(name: str, channels: int):
    one_frame = stacks(1, channels)[..., :channels]
    augmented = run(name, np.tile(one_frame, (20, 1, 1, S)), channels).reshape(20, H, W, S, channels)
    for s in range(1, S):
        np.testing.assert_array_equal(augmented[:, :, :, s], augmented[:, :, :, 0])
    distinct = {sample.tobytes() for sample in augmented}
    fewest, most = {"inversion": (2, 2), "vertical_shift": (5, 2 * SHIFT_PIXELS + 1)}.get(name, (11, 20))
    assert fewest <= len(distinct) <= most


@pytest.mark.parametrize(("name", "channels"), KINDS)
def test_the_share_of_clean_samples_is_exact_and_they_are_drawn_at_random(name: str, channels: int):
    frames = stacks(20, channels)
    clean = [(run(name, frames, channels, 1.0, 0.74, seed) == frames).all((1, 2, 3)) for seed in (1, 2)]
    # 14.8 of 20 are 15; shifts, inversion and grey may leave a sample as it is by chance; the others do not
    assert all(mask.sum() >= 15 for mask in clean)
    if name in ("random_conv", "contrast", "gamma"):
        assert all(mask.sum() == 15 for mask in clean)
        assert not np.array_equal(*clean)


def test_names_are_applied_in_their_order_with_noise_of_their_own():
    frames = stacks(200, 1)
    key_1, key_2 = jax.random.split(jax.random.key(0), 3)[1:]
    x, strength = jnp.asarray(frames)[..., None], jnp.ones(200)
    inversion, cutout = AUGMENTATIONS["inversion"], AUGMENTATIONS["cutout"]
    wanted = cutout(key_2, inversion(key_1, x, strength), strength)
    found = augmented_by(("inversion", "cutout"), jax.random.key(0), jnp.asarray(frames), 1)
    np.testing.assert_array_equal(found, wanted[..., 0])
    twice = augmented_by(("inversion", "inversion"), jax.random.key(0), jnp.asarray(frames), 1)
    assert 60 < (np.asarray(twice) == frames).all((1, 2, 3)).sum() < 140


def test_no_name_is_the_identity():
    frames = stacks(2, 3)
    np.testing.assert_array_equal(augment.augment((), jax.random.key(0), jnp.asarray(frames), 3), frames)


def test_strength_and_share_are_traced_and_all_work_together():
    names = tuple(AUGMENTATIONS)
    frames = jnp.asarray(stacks(8, 1))
    gentle = np.asarray(augmented_by(names, jax.random.key(0), frames, 1, 0.2, 0.0), int)
    strong = np.asarray(augmented_by(names, jax.random.key(0), frames, 1, 1.0, 0.0), int)
    np.testing.assert_array_equal(augmented_by(names, jax.random.key(0), frames, 1, 0.0, 0.0), frames)
    np.testing.assert_array_equal(augmented_by(names, jax.random.key(0), frames, 1, 1.0, 1.0), frames)
    assert np.abs(strong - np.asarray(frames)).mean() > np.abs(gentle - np.asarray(frames)).mean() > 0


def test_an_observation_has_the_strength_and_the_clean_share_of_the_configuration():
    config = DQNConfig(stack_size=S, augmentation_strength=0.5, augmentation_clean_share=0.25)
    frames, nothing = stacks(20, 3), jnp.zeros((20, 0))
    obs = Observation(frames=frames, vector=nothing, actions=nothing.astype(int), task=jnp.zeros(20, int))
    key, names = jax.random.key(1), ("contrast",)
    found = augment.with_augmented_frames(config, names, key, obs).frames
    np.testing.assert_array_equal(found, augmented_by(names, key, jnp.asarray(frames), 3, 0.5, 0.25))


def test_an_unknown_name_is_refused_with_the_nearest():
    with pytest.raises(ConfigError, match=r"augment: got 'shfit' \(did you mean 'shift'\?\), want some of shift, vert"):
        run("shfit", stacks(1, 1), 1)


def test_stacks_of_another_number_of_channels_are_refused():
    with pytest.raises(ValueError, match=r"augment\.frames: got 4 channels in a stack, want a multiple of channels, 3"):
        augment.augment(("shift",), jax.random.key(0), jnp.zeros((1, 8, 8, 4), jnp.uint8), 3)


# --- each of them -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["shift", "vertical_shift"])
@pytest.mark.parametrize(("strength", "reach"), [(1.0, SHIFT_PIXELS), (0.5, SHIFT_PIXELS // 2)])
def test_shift_is_a_crop_of_the_padded_image_and_reaches_every_offset(name: str, strength: float, reach: int):
    frames = stacks(600, 1)
    shifted = run(name, frames, 1, strength)
    padded = np.pad(frames, ((0, 0), (reach, reach), (reach, reach), (0, 0)), mode="edge")
    columns = range(2 * reach + 1) if name == "shift" else [reach]
    offsets = [(i, j) for i in range(2 * reach + 1) for j in columns]
    found = np.array([(padded[:, i : i + H, j : j + W] == shifted).all((1, 2, 3)) for i, j in offsets])
    np.testing.assert_array_equal(found.sum(0), 1)  # each sample is one of the crops
    assert found.sum(1).min() > 0, "some offset never comes"
    assert found.sum(1).max() < 4 * 600 / len(offsets)


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("strength", [1.0, 0.4])
def test_random_conv_is_the_defining_sum(channels: int, strength: float):
    frames = stacks(4, channels)
    weights = jax.random.normal(jax.random.key(0), (channels, channels, 3, 3, 4, 1, 1))  # [in, out, k, k, B, 1, 1]
    weights = np.asarray(weights, np.float64)[..., 0, 0]
    x = frames.reshape(4, H, W, S, channels).astype(np.float64)
    padded = np.pad(x, ((0, 0), (1, 1), (1, 1), (0, 0), (0, 0)), mode="edge") / 255
    wanted = np.empty_like(x)
    for b in range(4):
        for i in range(H):
            for j in range(W):
                window = padded[b, i : i + 3, j : j + 3]  # [3, 3, S, C]
                sums = np.einsum("ijsc,coij->so", window, weights[..., b])
                wanted[b, i, j] = (1 - strength) * x[b, i, j] + strength * 255 / (1 + np.exp(-sums))
    np.testing.assert_allclose(apply("random_conv", frames, channels, strength), wanted, atol=0.51)


@pytest.mark.parametrize("strength", [1.0, 0.4])
def test_contrast_is_a_clipped_line_about_mid_grey(strength: float):
    frames = stacks(100, 3)
    u = uniform((2, 100), -1.0) * strength
    factor, offset = (v[:, None, None, None, None] for v in (2 ** u[0], 64 * u[1]))
    wanted = np.clip((frames.reshape(100, H, W, S, 3) - 127.5) * factor + 127.5 + offset, 0, 255)
    np.testing.assert_allclose(apply("contrast", frames, 3, strength), wanted, atol=0.51)
    assert np.log2(factor).min() < -0.9 * strength
    assert np.log2(factor).max() > 0.9 * strength
    assert offset.max() > 60 * strength


@pytest.mark.parametrize("strength", [1.0, 0.4])
def test_gamma_is_a_power_of_the_value(strength: float):
    frames = stacks(100, 1)
    g = 2 ** (uniform((100,), -1.0) * strength)
    wanted = 255 * (frames / 255) ** g[:, None, None, None]
    np.testing.assert_allclose(apply("gamma", frames, 1, strength)[..., 0], wanted, atol=0.51)
    assert g.min() < 2 ** (-0.9 * strength)
    assert g.max() > 2 ** (0.9 * strength)


@pytest.mark.parametrize("strength", [1.0, 0.5])
def test_inversion_turns_half_of_the_samples_at_full_strength(strength: float):
    frames = stacks(600, 1)
    inverted = run("inversion", frames, 1, strength)
    turned = (inverted == 255 - frames).all((1, 2, 3))
    assert (turned | (inverted == frames).all((1, 2, 3))).all()
    assert abs(turned.mean() - strength / 2) < 0.06


@pytest.mark.parametrize("strength", [1.0, 0.5])
def test_cutout_fills_one_rectangle_with_one_colour(strength: float):
    frames = np.tile(stacks(1, 3), (400, 1, 1, 1))
    cut = apply("cutout", frames, 3, strength)
    changed = (cut != frames.reshape(cut.shape)).any((3, 4))
    sides, colours, places = [], [], np.zeros((H, W))
    for sample, mask in zip(cut, changed, strict=True):
        if not mask.any():
            continue
        rows, columns = (np.flatnonzero(mask.any(axis)) for axis in (1, 0))
        inside = sample[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        assert (inside == inside[0, 0, 0]).all()
        sides.append((len(rows) / H, len(columns) / W))
        colours.append(inside[0, 0, 0])
        places += mask
    assert np.max(sides) <= strength / 2
    assert np.min(np.max(sides, axis=0)) > 0.8 * strength / 2
    assert abs(np.corrcoef(*np.transpose(sides))[0, 1]) < 0.3, "a side says nothing of the other"
    assert np.abs(np.corrcoef(np.transpose(colours)) - np.eye(3)).max() < 0.3, "colours are drawn for every sample"
    assert strength < 1 or places.min() > 0, "some pixel is never covered"


@pytest.mark.parametrize("strength", [1.0, 0.4])
def test_grey_mixes_the_luma_in(strength: float):
    frames = stacks(100, 3)
    x = frames.reshape(100, H, W, S, 3).astype(np.float64)
    share = strength * uniform((100,), 0.0)[:, None, None, None, None]
    wanted = (1 - share) * x + share * (x @ [0.299, 0.587, 0.114])[..., None]
    np.testing.assert_allclose(apply("grey", frames, 3, strength), wanted, atol=0.51)


def test_grey_leaves_frames_of_one_channel_as_they_are():
    frames = stacks(4, 1)
    np.testing.assert_array_equal(run("grey", frames, 1), frames)
