"""Random changes of images that leave what matters to an agent in them: strong augmentation of the online input.

`augment` is pure and draws all of its noise from a key. Every sample of a batch has its own; the frames of one stack
share it, so that what moves between them is still what moved in the game. A name in `AUGMENTATIONS` is a function of
(key, frames, strength); strength 0 leaves every byte as it is.

Only the online network should see the result, and the targets clean frames. Source: Hansen, Su and Wang 2021 (SVEA);
Raileanu et al. 2021 (DrAC) compare the kinds in Procgen.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial, reduce
from itertools import product
from operator import add

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, Shaped, UInt8

from gvz.core.errors import ConfigError, nearest
from learner.config import ValueConfig
from learner.observation import Observation

Frames = UInt8[Array, "B H W S C"]
"""stacks of S frames of C channels"""
Strength = Float[Array, "B"]
"""0..1, one for each sample"""

SHIFT_PIXELS = 4
"""farthest shift. Source: Kostrikov et al. 2021 (DrQ), 4 of 84 pixels"""


def augment(
    names: tuple[str, ...],
    key: PRNGKeyArray,
    frames: UInt8[Array, "B H W SC"],
    channels: int,
    strength: float | Float[Array, ""] = 1.0,
    clean_share: float | Float[Array, ""] = 0.0,
) -> UInt8[Array, "B H W SC"]:
    """Applies the named augmentations, one after another.

    Args:
        names: of `AUGMENTATIONS`, in this order.
        key: of all noise.
        frames: stacks, oldest frame first, the channels of a frame side by side.
        channels: C, of one frame.
        strength: 0..1; 0 returns `frames`, bit for bit. May be a traced number, to begin gently.
        clean_share: 0..1, of the batch: round(clean_share * B) samples, drawn at random, stay as they are.

    Raises:
        ConfigError: an unknown name; says the nearest.
        ValueError: `channels` does not divide the frames' last axis.
    """
    for name in names:
        if name not in AUGMENTATIONS:
            hint = nearest(name, AUGMENTATIONS)
            raise ConfigError(f"augment: got {name!r}{hint}, want some of {', '.join(AUGMENTATIONS)}")
    batch, height, width, depth = frames.shape
    if depth % channels:
        raise ValueError(f"augment.frames: got {depth} channels in a stack, want a multiple of channels, {channels}")
    key_clean, *keys = jax.random.split(key, len(names) + 1)
    clean = jax.random.permutation(key_clean, batch) < jnp.round(clean_share * batch)
    strengths = jnp.where(clean, 0.0, strength)
    stacks = frames.reshape(batch, height, width, depth // channels, channels)
    for name, key_of_it in zip(names, keys, strict=True):
        # XLA compiles a branch by itself. Without branches, it fuses random_conv with what follows and computes sums
        # more than once: random_conv, contrast and gamma together take 39 ms without and 1.5 with them (48x84 grey).
        change = partial(AUGMENTATIONS[name], key_of_it)
        stacks = jax.lax.cond(jnp.any(strengths > 0), change, lambda unchanged, _: unchanged, stacks, strengths)
    return stacks.reshape(frames.shape)


def shift(key: PRNGKeyArray, frames: Frames, strength: Strength) -> Frames:
    """Moves the image by up to strength * SHIFT_PIXELS whole pixels, up or down and sideways; edges are repeated.

    Source: Kostrikov et al. 2021 (DrQ), section 3.1.
    """
    return _shifted(frames, strength, jax.random.uniform(key, (len(frames), 2)))


def vertical_shift(key: PRNGKeyArray, frames: Frames, strength: Strength) -> Frames:
    """`shift`, but only up or down. A thing stays in its columns: an agent aims by them."""
    rows = jax.random.uniform(key, (len(frames), 1))
    return _shifted(frames, strength, jnp.concatenate([rows, jnp.full_like(rows, 0.5)], axis=1))


def random_conv(key: PRNGKeyArray, frames: Frames, strength: Strength) -> Frames:
    """(1 - strength) * image + strength * sigmoid(image convolved with N(0, 1) weights, 3x3, over all channels).

    Colours and textures change, shapes stay. Edges are repeated.

    Source: Lee et al. 2020 (NetRand), section 3.1, in the form of SVEA's published code, which is strength 1.
    """
    batch, height, width, stack, channels = frames.shape
    weights = jax.random.normal(key, (channels, channels, 3, 3, batch, 1, 1)) / 255
    padded = jnp.pad(jnp.moveaxis(frames, -1, 0), ((0, 0), (0, 0), (1, 1), (1, 1), (0, 0)), mode="edge")
    # A pixel to the right is S further along the last axis, which is long: that is what a CPU is fast at.
    planes = padded.reshape(channels, batch, height + 2, (width + 2) * stack).astype(jnp.float32)

    def term(c: int, out: int, i: int, j: int) -> Float[Array, "B H WS"]:
        window = planes[c, :, i : i + height, j * stack : (j + width) * stack]
        return weights[c, out, i, j] * window

    taps = list(product(range(channels), range(3), range(3)))
    sums = jnp.stack([reduce(add, (term(c, out, i, j) for c, i, j in taps)) for out in range(channels)])
    share = strength[None, :, None, None]
    mixed = (1 - share) * planes[:, :, 1:-1, stack:-stack] + share * 255 * jax.nn.sigmoid(sums)
    mixed = jnp.round(mixed).astype(jnp.uint8)
    # Only bytes are put side by side: XLA fuses whatever makes them into that and computes it number by number, which
    # took 41 ms with floats and takes 6 so (32 stacks of 84x84 RGB).
    return jnp.stack(list(mixed.reshape(channels, batch, height, width, stack)), axis=-1)


def contrast(key: PRNGKeyArray, frames: Frames, strength: Strength) -> Frames:
    """Contrast about mid-grey by a factor of 1/2 to 2, and brightness by up to 64 of 255, at full strength."""
    u = jax.random.uniform(key, (2, len(frames)), minval=-1.0) * strength[None]
    factor, offset = jnp.exp2(u[0]), 64 * u[1]
    x = (frames.astype(jnp.float32) - 127.5) * _per_sample(factor) + _per_sample(127.5 + offset)
    return jnp.clip(jnp.round(x), 0, 255).astype(jnp.uint8)


def gamma(key: PRNGKeyArray, frames: Frames, strength: Strength) -> Frames:
    """255 * (value / 255)^g with g from 1/2 to 2 at full strength: dark parts change most."""
    g = jnp.exp2(jax.random.uniform(key, strength.shape, minval=-1.0) * strength)
    x = 255 * jnp.exp(_per_sample(g) * jnp.log(frames.astype(jnp.float32) / 255))
    return jnp.round(x).astype(jnp.uint8)


def inversion(key: PRNGKeyArray, frames: Frames, strength: Strength) -> Frames:
    """255 - value, with probability strength / 2."""
    inverted = jax.random.uniform(key, strength.shape) < strength / 2
    return frames ^ _per_sample(jnp.where(inverted, 255, 0).astype(jnp.uint8))


def cutout(key: PRNGKeyArray, frames: Frames, strength: Strength) -> Frames:
    """A rectangle somewhere is filled with a random colour; its sides are up to half of the image's at full strength.

    Source: DeVries and Taylor 2017; Laskin et al. 2020 (RAD), "cutout color".
    """
    batch, height, width, _, channels = frames.shape
    key_sides, key_place, key_colour = jax.random.split(key, 3)
    size = jnp.array([height, width])[None]
    sides = jnp.round(jax.random.uniform(key_sides, (batch, 2)) * strength[:, None] * size / 2)
    start = jnp.floor(jax.random.uniform(key_place, (batch, 2)) * (size - sides + 1))
    end = start + sides
    row, column = jnp.arange(height)[None], jnp.arange(width)[None]
    rows = (row >= start[:, :1]) & (row < end[:, :1])  # [B, H]
    columns = (column >= start[:, 1:]) & (column < end[:, 1:])  # [B, W]
    colour = jax.random.bits(key_colour, (batch, 1, 1, 1, channels), jnp.uint8)
    return jnp.where((rows[:, :, None] & columns[:, None, :])[..., None, None], colour, frames)


def grey(key: PRNGKeyArray, frames: Frames, strength: Strength) -> Frames:
    """Takes away up to all of the colour at full strength; frames of one channel stay as they are.

    The grey is the luma of Rec. 601.
    """
    if frames.shape[-1] != 3:
        return frames
    x = frames.astype(jnp.float32)
    luma = 0.299 * x[..., :1] + 0.587 * x[..., 1:2] + 0.114 * x[..., 2:]
    share = _per_sample(strength * jax.random.uniform(key, strength.shape))
    return jnp.round((1 - share) * x + share * luma).astype(jnp.uint8)


AUGMENTATIONS: dict[str, Callable[[PRNGKeyArray, Frames, Strength], Frames]] = {
    f.__name__: f for f in (shift, vertical_shift, random_conv, contrast, gamma, inversion, cutout, grey)
}


def _shifted(frames: Frames, strength: Strength, share: Float[Array, "B 2"]) -> Frames:
    """Moved by `share` of the way from -reach to reach, up and to the left; share 0.5 is no move."""
    reach = jnp.round(strength * SHIFT_PIXELS)[:, None]  # [B, 1]
    offset = jnp.floor(share * (2 * reach + 1)) - reach
    pad = (SHIFT_PIXELS, SHIFT_PIXELS)
    padded = jnp.pad(frames, ((0, 0), pad, pad, (0, 0), (0, 0)), mode="edge")

    def crop(image: UInt8[Array, "h w S C"], start: Int[Array, "2"]) -> UInt8[Array, "H W S C"]:
        return jax.lax.dynamic_slice(image, (start[0], start[1], 0, 0), frames.shape[1:])

    return jax.vmap(crop)(padded, SHIFT_PIXELS + offset.astype(jnp.int32))


def _per_sample(x: Shaped[Array, " B"]) -> Shaped[Array, "B 1 1 1 1"]:
    return x[:, None, None, None, None]


def training_view(config: ValueConfig, key: PRNGKeyArray, obs: Observation) -> Observation:
    """What the online network is shown of an observation in training: augmented, or in parts hidden, as configured."""
    key_frames, key_hidden = jax.random.split(key)
    if config.augmentations:
        obs = with_augmented_frames(config, config.augmentations, key_frames, obs)
    if config.hidden_input_share > 0.0 and obs.vector.shape[1] + obs.actions.shape[1] > 0:
        hidden = jax.random.uniform(key_hidden, obs.task.shape)[:, None] < config.hidden_input_share
        obs = replace(obs, vector=jnp.where(hidden, 0.0, obs.vector), actions=jnp.where(hidden, -1, obs.actions))
    return obs


def with_augmented_frames(
    config: ValueConfig, names: tuple[str, ...], key: PRNGKeyArray, obs: Observation
) -> Observation:
    """The observation with the named augmentations of its frames, as strong and in as many samples as configured."""
    channels = obs.frames.shape[3] // config.stack_size
    strength, clean_share = config.augmentation_strength, config.augmentation_clean_share
    return replace(obs, frames=augment(names, key, obs.frames, channels, strength, clean_share))
