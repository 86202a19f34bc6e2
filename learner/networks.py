"""The Q-network: an encoder of frames, then one or two streams of (noisy) dense layers.

One module with switches serves every agent. Parameters are float32; activations may be bfloat16; outputs are
float32. Noise is explicit: `add_noise` moves the parameters (`fold_noise` for acting), or the network is given what
`draw_noise` drew.
"""

from functools import cache
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from gvz.core.errors import ConfigError
from learner.agents.configs.rainbow import Noisy
from learner.config import AgentConfig
from learner.encoders.base import make_encoder
from learner.observation import Observation

Params = Any
"""A pytree of float32 arrays: {"params": {layer: {name: array}}}."""
_SIGMAS = ("kernel_sigma", "bias_sigma")


class NoisyDense(nn.Module):
    """Dense layer y = (b + W x) + (b_noisy * eps_b + (W_noisy * eps_w) x). Source: thesis eq. 4.14.

    Kernels are [outputs, inputs], as W is: on a CPU W x^T streams the weights through the cache, while x W^T of a batch
    of a few rows copies them first (two products of 4 rows with 512x3136 on one core: 0.5 ms against 1.7 ms).

    Factorized noise is eps_w = f(e_out) f(e_in)^T and eps_b = f(e_out) with f(e) = sign(e) sqrt|e| and e ~ N(0, 1);
    independent noise is N(0, 1) for every entry. Source: Fortunato et al. 2018, section 3.

    One draw for a whole batch is `add_noise`. Given `noise`, the layer has factorized noise for every row of the batch:
    (W_noisy (x * f(e_in))) * f(e_out) needs no copy of the weights per row.

    Differs: sigma starts at `sigma` in both forms (the paper has 0.017 for independent noise and 0.5 / sqrt(inputs)
    for factorized, 0.009 and 0.022 for this network's layers of 3136 and 512 inputs; the thesis asks for 0.017), and
    the means start He-uniform (thesis 4.1.5) unless `outputs` are given.

    Attributes:
        features: number of outputs.
        sigma: initial value of every noisy weight and bias; None for a layer without noise.
        outputs: what the layer answers at first, whatever its input: its biases, and its kernel starts at 0.
    """

    features: int
    sigma: float | None
    outputs: tuple[float, ...] | None = None

    @nn.compact
    def __call__(self, x: Float[Array, "B P"], noise: Float[Array, "B P+Q"] | None = None) -> Float[Array, "B Q"]:
        """Applies the layer: by its means, or with each row's own f(e_in), f(e_out) side by side in `noise`."""
        shape = (self.features, x.shape[-1])
        kernel_init, bias_init = nn.initializers.he_uniform(in_axis=-1, out_axis=-2), nn.initializers.zeros
        if self.outputs is not None:
            kernel_init, bias_init = nn.initializers.zeros, nn.initializers.constant(jnp.asarray(self.outputs))
        kernel = self.param("kernel", kernel_init, shape).astype(x.dtype)
        bias = self.param("bias", bias_init, shape[:1]).astype(x.dtype)[None]
        y = _product(kernel, x) + bias
        if self.sigma is None:
            return y
        sigma = nn.initializers.constant(self.sigma)
        kernel_sigma = self.param("kernel_sigma", sigma, shape).astype(x.dtype)
        bias_sigma = self.param("bias_sigma", sigma, shape[:1]).astype(x.dtype)[None]
        if noise is None:
            return y
        f_in, f_out = jnp.split(noise.astype(x.dtype), [shape[1]], axis=1)
        return y + (_product(kernel_sigma, x * f_in) + bias_sigma) * f_out


def _product(kernel: Float[Array, "Q P"], x: Float[Array, "B P"]) -> Float[Array, "B Q"]:
    """x W^T as (W x^T)^T. Without the barrier XLA turns the latter back into the former."""
    return jax.lax.optimization_barrier(kernel @ x.T).T


def draw_noise(params: Params, key: PRNGKeyArray, num_rows: int) -> dict[str, Float[Array, "B P+Q"]]:
    """Factorized noise f(e_in), f(e_out) of every noisy layer, for each of `num_rows` rows. One draw for all layers."""
    shapes = {name: layer["kernel"].shape for name, layer in _noisy_layers(params).items()}
    widths = [P + Q for Q, P in shapes.values()]
    e = jax.random.normal(key, (num_rows, sum(widths)))
    f = jax.lax.platform_dependent(e, cpu=_scaled_once, default=_scaled)
    parts = jnp.split(f, np.cumsum(widths)[:-1], axis=1)
    return dict(zip(shapes, parts, strict=True))


def _scaled(e: Float[Array, "B N"]) -> Float[Array, "B N"]:
    return jnp.sign(e) * jnp.sqrt(jnp.abs(e))


def _scaled_once(e: Float[Array, "B N"]) -> Float[Array, "B N"]:
    """`_scaled`, in a loop of two steps, which XLA does not merge with what follows. Without it, XLA on a CPU scales
    the noise again for each weight of a layer. A barrier or a loop of one step does not prevent that.
    """
    halves = jnp.pad(e.reshape(-1), (0, e.size % 2)).reshape(2, -1)
    return jax.lax.map(_scaled, halves).reshape(-1)[: e.size].reshape(e.shape)


def add_noise(params: Params, key: PRNGKeyArray, noisy: Noisy) -> Params:
    """Parameters whose means are moved by one draw of noise: the network of these, applied without noise, is noisy.

    Differentiable in both the means and the sigmas. One draw serves any number of batches.

    Args:
        params: of a `QNetwork`.
        key: draws the noise of all layers.
        noisy: form of the noise; off returns `params`.

    Source: thesis eq. 4.14, W + W_noisy * eps_w and b + b_noisy * eps_b.
    """
    if noisy == "off":
        return params
    noise = draw_noise(params, key, 1) if noisy == "factorized" else {}
    moved = {}
    for i, (name, layer) in enumerate(_noisy_layers(params).items()):
        Q, P = layer["kernel"].shape
        if noisy == "factorized":
            f_in, f_out = jnp.split(noise[name][0], [P])
            eps_w, eps_b = f_out[:, None] * f_in[None, :], f_out
        else:
            e = jax.random.normal(jax.random.fold_in(key, i), (Q, P + 1))
            eps_w, eps_b = e[:, :P], e[:, P]
        moved[name] = layer | {
            "kernel": layer["kernel"] + layer["kernel_sigma"] * eps_w,
            "bias": layer["bias"] + layer["bias_sigma"] * eps_b,
        }
    return {"params": params["params"] | moved}


def fold_noise(params: Params, key: PRNGKeyArray, noisy: Noisy) -> Params:
    """`add_noise` without the sigmas: parameters of the network without noise, half as many to read at a decision."""
    moved = add_noise(params, key, noisy)["params"]
    return {"params": {name: {k: w for k, w in layer.items() if k not in _SIGMAS} for name, layer in moved.items()}}


def is_folded(params: Params) -> bool:
    """No layer has noise."""
    return not _noisy_layers(params)


def _noisy_layers(params: Params) -> Params:
    return {name: layer for name, layer in params["params"].items() if "kernel_sigma" in layer}


class QNetwork(nn.Module):
    """Observations to logits `[B, A, N]`; N = 1 and the logit is Q(s, a) if not distributional.

    Architecture: thesis 4.1.5 (convolutions, rectifiers, one hidden dense layer), Figure 4.2 and eq. 4.10 (dueling:
    a hidden layer per stream; the advantage's mean is taken off, per atom if distributional, as in Rainbow). The
    encoder makes features of the frames. Game variables in hundredths, past actions one-hot and, if
    `config.task_conditioned`, the task one-hot stand behind them.

    Differs: output layers start with kernel 0 (thesis 4.1.5: He-uniform), so that all outputs are at first
    `first_outputs` but for noise; they are the value stream's where there are two.

    Attributes:
        config: the agent's configuration; reads the fields of every agent.
        num_actions: A.
        num_tasks: length of the one-hot task vector.
        first_outputs: N numbers, what each action's logits are at first, whatever the observation.
        dueling: a stream each for the value and the advantages.
        noisy_sigma: initial sigma of noisy layers; None for layers without noise.
        layer_norm: hidden layers are normalized before their rectifier.
        num_sights: outputs of a dense layer on the features of the frames, which say what is in sight. They are the
            variable `sight` / `logits` [B, C], for those who ask for it. 0: there is no such layer. The layer reads
            normalized features; else its loss makes them so large that the values are not learnt
            (docs/findings/screen.md).
    """

    config: AgentConfig
    num_actions: int
    num_tasks: int
    first_outputs: tuple[float, ...]
    dueling: bool = False
    noisy_sigma: float | None = None
    layer_norm: bool = False
    num_sights: int = 0

    @nn.compact
    def __call__(self, obs: Observation, noise: dict[str, Float[Array, "B _"]] | None = None) -> Float[Array, "B A N"]:
        """Applies the network: by its means, or by each row's own noise, see `draw_noise`."""
        config, dtype = self.config, jnp.dtype(self.config.activation_dtype)
        x = make_encoder(config.encoder)(obs.frames.astype(dtype) / 255, config)
        B, shape, kind = len(obs.frames), getattr(x, "shape", ()), getattr(x, "dtype", type(x).__name__)
        if len(shape) != 2 or shape[0] != B or not jnp.issubdtype(kind, jnp.floating):
            raise ConfigError(
                f"agent.encoder: {config.encoder!r} gives features {kind}{list(shape)}, want {dtype}[B, F] with B = {B}"
            )
        if self.num_sights:
            normalized = nn.LayerNorm(use_scale=False, use_bias=False, dtype=dtype)(x)
            logits = nn.Dense(self.num_sights, dtype=dtype, name="sight")(normalized)
            self.sow("sight", "logits", logits.astype(jnp.float32))
        parts = [obs.vector.astype(dtype) / 100] if obs.vector.shape[1] else []
        if K := obs.actions.shape[1]:
            parts.append(jax.nn.one_hot(obs.actions, self.num_actions, dtype=dtype).reshape(-1, K * self.num_actions))
        if config.task_conditioned:
            parts.append(jax.nn.one_hot(obs.task, self.num_tasks, dtype=dtype))
        x = jnp.concatenate([x, *parts], axis=-1) if parts else x
        noise = {} if noise is None else noise
        first, num_atoms = self.first_outputs, len(self.first_outputs)
        if not self.dueling:
            q = self._stream("q", x, first * self.num_actions, noise)
            return q.reshape(-1, self.num_actions, num_atoms)
        value = self._stream("value", x, first, noise)[:, None, :]  # [B, 1, N]
        advantage = self._stream("advantage", x, (0.0,) * (self.num_actions * num_atoms), noise)
        advantage = advantage.reshape(-1, self.num_actions, num_atoms)  # [B, A, N]
        return value + advantage - advantage.mean(axis=1, keepdims=True)

    def _stream(self, name: str, x: Array, first: tuple[float, ...], noise: dict[str, Array]) -> Array:
        """Hidden layer, rectifier, output layer, which answers `first` until it has learnt."""
        hidden = NoisyDense(self.config.hidden_units, self.noisy_sigma, name=f"{name}_hidden")
        output = NoisyDense(len(first), self.noisy_sigma, first, name=f"{name}_output")
        h = hidden(x, noise.get(f"{name}_hidden"))
        if self.layer_norm:
            h = nn.LayerNorm(dtype=h.dtype, name=f"{name}_norm")(h)
        # float32 whatever the activations: in bfloat16 action values of 8 to 16 would be multiples of 1/16
        return output(nn.relu(h).astype(jnp.float32), noise.get(f"{name}_output"))


@cache
def initial_logits(v_min: float, v_max: float, num_atoms: int, mean: float) -> tuple[float, ...]:
    """Logits of the distribution of the largest entropy among those on the atoms with this mean.

    They are a straight line over the atoms (Jaynes 1957): as few nats apart as a mean demands, and none of -inf, so no
    atom needs long to be found again. In float64; the slope is found by bisection.

    Args:
        v_min: smallest atom.
        v_max: largest atom.
        num_atoms: N.
        mean: strictly between the two.
    """
    atoms = np.linspace(-0.5, 0.5, num_atoms)
    wanted = (mean - v_min) / (v_max - v_min) - 0.5
    slope, low, high = 0.0, -1e6, 1e6
    for _ in range(100):
        slope = (low + high) / 2
        masses = np.exp(slope * atoms - abs(slope) / 2)
        low, high = (slope, high) if masses @ atoms < wanted * masses.sum() else (low, slope)
    return tuple((slope * atoms).tolist())
