"""The acting function as bytes, and parameters as one flat vector.

The bytes are `jax.export` of the agent's own acting function (StableHLO in a flatbuffer, not a pickle), lowered for a
CPU wherever the learner runs. An actor calls them without importing this package. So it does with the function that
folds parameters, if the agent has one.
"""

import hashlib
import itertools
from collections.abc import Callable
from dataclasses import fields
from typing import Any

import jax
import jax.numpy as jnp
from jax import export
from jaxtyping import Array, Float, Int, PRNGKeyArray

from learner.agents.base import Agent, Params, folding
from learner.observation import Observation


def flatten_params(params: Params) -> Float[Array, " P"]:
    """All leaves in tree order, which is the order that `export_policy` takes them in, as one float32 vector."""
    return jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(params)])


def unflatten_params(template: Params, vector: Float[Array, " P"]) -> Params:
    """The inverse of `flatten_params`: parameters of the template's shapes (arrays or their ShapeDtypeStructs)."""
    leaves, treedef = jax.tree.flatten(template)
    ends = list(itertools.accumulate(leaf.size for leaf in leaves))
    parts = jnp.split(vector, ends[:-1])
    return jax.tree.unflatten(treedef, [part.reshape(leaf.shape) for part, leaf in zip(parts, leaves, strict=True)])


def layout_hash(params: Params) -> int:
    """64 bits that differ when any path, shape, dtype or the order of the leaves does."""
    leaves = jax.tree_util.tree_leaves_with_path(params)
    layout = [(jax.tree_util.keystr(path), tuple(leaf.shape), str(leaf.dtype)) for path, leaf in leaves]
    return int.from_bytes(hashlib.blake2b(repr(layout).encode(), digest_size=8).digest(), "little")


def export_policy(agent: Agent, template: Params, batch_size: int) -> bytes:
    """Serializes the acting function for a CPU.

    Args:
        agent: whose acting function.
        template: parameters (values do not matter) or their ShapeDtypeStructs.
        batch_size: games acted on in one call.

    Returns:
        Bytes for `jax.export.deserialize`; `.call` takes (the parameters' leaves as a list, the observation as a dict
        of the fields of `learner.observation.Observation`, key u32[2], epsilon f32[]) and returns what `Agent.act`
        does. The leaves are those that `export_fold`'s function returns, if it has one. A flat vector is cut into
        leaves by the caller, once a version: within the function it would be copied in every call (27 MB, 2.5 ms).
    """
    if folder := folding(agent):
        template = jax.eval_shape(folder.fold, template, jax.random.key(0))
    template_leaves, treedef = jax.tree.flatten(template)

    def policy(
        leaves: list[Array], obs: dict[str, Array], key_data: Array, epsilon: Array
    ) -> tuple[Int[Array, " B"], Float[Array, "B E"]]:
        params = jax.tree.unflatten(treedef, leaves)
        return agent.act(params, _key(key_data), Observation(**obs), epsilon)

    observation = jax.eval_shape(lambda: agent.spec.zeros(batch_size))
    return _serialized(
        policy,
        _float32(template_leaves),
        {f.name: shape for f in fields(observation) if (shape := getattr(observation, f.name)) is not None},
        _KEY_DATA,
        jax.ShapeDtypeStruct((), jnp.float32),
    )


def export_fold(agent: Agent, template: Params) -> bytes:
    """Serializes the function that folds parameters for a stretch of decisions, see `FoldingAgent`, for a CPU.

    Returns:
        As `export_policy`; `.call` takes (the parameters' leaves as a list, key u32[2]) and returns the leaves that the
        acting function takes. Empty if the agent folds nothing.
    """
    if (folder := folding(agent)) is None:
        return b""
    template_leaves, treedef = jax.tree.flatten(template)

    def fold(leaves: list[Array], key_data: Array) -> list[Array]:
        return jax.tree.leaves(folder.fold(jax.tree.unflatten(treedef, leaves), _key(key_data)))

    return _serialized(fold, _float32(template_leaves), _KEY_DATA)


_KEY_DATA = jax.ShapeDtypeStruct((2,), jnp.uint32)


def _key(key_data: Array) -> PRNGKeyArray:
    return jax.random.wrap_key_data(key_data, impl="threefry2x32")


def _float32(leaves: list[Any]) -> list[jax.ShapeDtypeStruct]:
    return [jax.ShapeDtypeStruct(leaf.shape, jnp.float32) for leaf in leaves]


def _serialized(function: Callable[..., Any], *arguments: Any) -> bytes:
    return bytes(export.export(jax.jit(function), platforms=["cpu"])(*arguments).serialize())
