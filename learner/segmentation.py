"""A network that tells what each part of a frame shows: its form, its loss, its training, and its ONNX file.

It learns from the engine's labels. What it has learned is used without them (`gvz/segmentation.py`).
"""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, PRNGKeyArray, UInt8

CELL = 6
"""pixels of a frame on each side of a cell: the network answers once for each cell"""
Params = Any
"""{"params": {layer: {"kernel": [k k inputs outputs], "bias": [outputs]}}}"""
_LEARNING_RATE = 3e-3
_WARMUP_STEPS = 100
_OPSET = 13


class SegmentationNetwork(nn.Module):
    """Frames to logits of classes, an answer for each cell of 6x6 pixels.

    Two convolutions of strides 3 and 2 make the cells. Two more look at what is around each at half that resolution;
    what they find is added to the cells. A last 3x3 convolution and a dense layer answer. On 144x252 pixels these are
    39 million multiplications.

    Source: the form is that of U-Net (Ronneberger, Fischer and Brox 2015), with one level and sums in place of
    concatenations.

    Attributes:
        num_classes: C.
    """

    num_classes: int

    @nn.compact
    def __call__(self, x: Float[Array, "B H W 3"]) -> Float[Array, "B h w C"]:
        """Applies the network; H and W are multiples of 12, h = H / 6 and w = W / 6."""
        x = nn.relu(nn.Conv(16, (6, 6), 3, name="pixels")(x))
        cells = nn.relu(nn.Conv(32, (4, 4), 2, name="cells")(x))
        around = nn.relu(nn.Conv(64, (3, 3), 2, name="around")(cells))
        around = around + nn.relu(nn.Conv(64, (3, 3), kernel_dilation=2, name="farther")(around))
        around = nn.Conv(32, (1, 1), name="narrow")(around)
        around = jnp.repeat(jnp.repeat(around, 2, axis=1), 2, axis=2)
        cells = nn.relu(nn.Conv(32, (3, 3), name="detail")(nn.relu(cells + around)))
        return nn.Conv(self.num_classes, (1, 1), name="classes")(cells)


def normalized(screens: UInt8[Array, "B H W 3"]) -> Float[Array, "B H W 3"]:
    """Each screen with mean 0 and a deviation of about 1, as `gvz.segmentation.network_input` has it."""
    screens = screens.astype(jnp.float32)
    mean, deviation = (reduce(screens, axis=(1, 2, 3), keepdims=True) for reduce in (jnp.mean, jnp.std))
    return (screens - mean) / (deviation + 12.75)


def segmentation_loss(
    logits: Float[Array, "B h w C"], labels: UInt8[Array, "B H W"], class_weights: Float[Array, " C"]
) -> Float[Array, ""]:
    """Cross-entropy of every pixel's class under its cell's distribution, a weighted mean over pixels.

    Where a cell shows several classes, what it is best to answer is their weighted shares.
    """
    B, h, w, _ = logits.shape
    pixels = labels.reshape(B, h, CELL, w, CELL).swapaxes(2, 3).reshape(B, h, w, CELL * CELL).astype(jnp.int32)
    losses = -jnp.take_along_axis(jax.nn.log_softmax(logits), pixels, axis=-1)
    weights = class_weights[pixels]
    return (weights * losses).sum() / weights.sum()


def learning_rate(num_steps: int, done: float) -> float:
    """Adam's step, which rises over the first `_WARMUP_STEPS` gradient steps and falls by a cosine to 0 at the end.

    Args:
        num_steps: gradient steps that were done.
        done: how much of the training that is, 0 to 1.
    """
    return _LEARNING_RATE * min(1.0, (num_steps + 1) / _WARMUP_STEPS) * (1 + np.cos(np.pi * done)) / 2


def train_segmentation(
    batches: Iterable[tuple[np.ndarray, np.ndarray]],
    class_weights: np.ndarray,
    key: PRNGKeyArray,
    share_done: Callable[[int, float], float],
) -> tuple[Params, int, float]:
    """Trains a network by Adam, whose step is `learning_rate`.

    Args:
        batches: (screens u8[B H W 3], labels u8[B H W]), without end; all of one shape.
        class_weights: f32[C], of the pixels of each class in the loss.
        key: of the first parameters.
        share_done: (gradient steps, last loss) -> how much of the training is done; it ends at 1.

    Returns:
        The parameters, the gradient steps and the last loss.

    Raises:
        ValueError: the batches ended before the training.
    """
    network, weights = SegmentationNetwork(len(class_weights)), jnp.asarray(class_weights)
    optimizer = optax.inject_hyperparams(optax.adam)(learning_rate=_LEARNING_RATE)

    def loss(params: Params, screens: Array, labels: Array) -> Float[Array, ""]:
        return segmentation_loss(network.apply(params, normalized(screens)), labels, weights)  # pyright: ignore

    @jax.jit
    def step(params: Params, state: Any, screens: Array, labels: Array, rate: float) -> tuple[Params, Any, Array]:
        value, gradient = jax.value_and_grad(loss)(params, screens, labels)
        state.hyperparams["learning_rate"] = rate
        updates, state = optimizer.update(gradient, state, params)
        return optax.apply_updates(params, updates), state, value

    params, state, last = None, None, 0.0
    for num_steps, (screens, labels) in enumerate(batches):
        if params is None:
            params = network.init(key, normalized(jnp.asarray(screens)))
            state = optimizer.init(params)
        if (done := share_done(num_steps, float(last))) >= 1.0:
            return params, num_steps, float(last)
        params, state, last = step(params, state, screens, labels, np.float32(learning_rate(num_steps, done)))
    raise ValueError("batches: they ended before the training did")


def write_onnx(params: Params, file: Path, height: int, width: int) -> None:
    """Writes the network as an ONNX file: frames f32[1 3 height width] -> probabilities f32[1 C height/6 width/6].

    Needs the package `onnx` (extra `segmenter`).
    """
    from onnx import TensorProto, helper, numpy_helper

    arrays, nodes = [], []

    def constant(name: str, values: np.ndarray) -> str:
        arrays.append(numpy_helper.from_array(np.ascontiguousarray(values, np.float32), name))
        return name

    def node(kind: str, inputs: list[str], output: str, **attributes: Any) -> str:
        nodes.append(helper.make_node(kind, inputs, [output], **attributes))
        return output

    def conv(x: str, name: str, size: int, stride: int = 1, dilation: int = 1) -> tuple[str, int]:
        """The layer of this name on an input of `size` rows, with flax's padding; rows of the output."""
        layer = params["params"][name]
        kernel = np.transpose(np.asarray(layer["kernel"]), (3, 2, 0, 1))
        out = -(-size // stride)
        padding = max(0, (out - 1) * stride + (kernel.shape[2] - 1) * dilation + 1 - size)
        before, after = padding // 2, padding - padding // 2
        return node(
            "Conv",
            [x, constant(f"{name}.kernel", kernel), constant(f"{name}.bias", np.asarray(layer["bias"]))],
            name,
            strides=[stride] * 2,
            dilations=[dilation] * 2,
            pads=[before, before, after, after],
        ), out

    def relu(x: str) -> str:
        return node("Relu", [x], f"{x}.relu")

    x, rows = conv("frame", "pixels", height, stride=3)
    cells, rows = conv(relu(x), "cells", rows, stride=2)
    cells = relu(cells)
    x, half = conv(cells, "around", rows, stride=2)
    around = relu(x)
    farther, _ = conv(around, "farther", half, dilation=2)
    x, _ = conv(node("Add", [around, relu(farther)], "both"), "narrow", half)
    scales = constant("scales", np.array([1, 1, 2, 2]))
    nearest = {"mode": "nearest", "coordinate_transformation_mode": "asymmetric", "nearest_mode": "floor"}
    x = node("Resize", [x, "", scales], "larger", **nearest)
    x, _ = conv(relu(node("Add", [cells, x], "sum")), "detail", rows)
    x, _ = conv(relu(x), "classes", rows)
    node("Softmax", [x], "probabilities", axis=1)
    num_classes = params["params"]["classes"]["bias"].shape[0]
    shapes = {"frame": [1, 3, height, width], "probabilities": [1, num_classes, height // CELL, width // CELL]}
    ends = {name: [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)] for name, shape in shapes.items()}
    graph = helper.make_graph(nodes, "segmenter", ends["frame"], ends["probabilities"], arrays)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=8)
    file.write_bytes(model.SerializeToString())
