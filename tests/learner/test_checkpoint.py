"""Checkpoints: whole or not at all, and damage is named, never used."""

import dataclasses
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gvz.errors import CheckpointError
from learner import checkpoint
from learner.agents.base import AgentSpec, make_agent
from learner.config import AgentConfig


def example(fill: int = 0):
    return {
        "params": {"w": jnp.arange(12.0).reshape(3, 4) + fill, "b": jnp.zeros(4)},
        "frames": jnp.full((50, 8, 8, 3), fill, jnp.uint8),
        "num_updates": jnp.int32(fill),
        "key": jax.random.key(fill),
        "flag": jnp.bool_(True),
        "empty": jnp.zeros((0, 3), jnp.int32),
    }


def equal(a, b) -> bool:
    def plain(x):
        return np.asarray(jax.random.key_data(x) if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key) else x)

    return all(np.array_equal(plain(x), plain(y)) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def save(run: Path, step: int, keep: int = 2) -> None:
    saver = checkpoint.Checkpointer(run, keep=keep)
    saver.save(step, example(step), example(step)["params"], {"num_updates": step, "note": "é"})
    saver.wait()
    assert saver.outcome() == ""


def test_what_is_written_is_read_back_exactly(tmp_path):
    save(tmp_path, 7)
    restored = checkpoint.restore_newest(tmp_path / "checkpoints", jax.eval_shape(example))
    assert restored is not None
    assert (restored.num_updates, restored.damage) == (7, [])
    assert restored.host == {"num_updates": 7, "note": "é"}
    assert equal(restored.arrays, example(7))


def test_parameters_written_under_one_form_of_the_convolution_are_read_under_the_other(tmp_path):
    spec = AgentSpec(obs_shape=(12, 12, 4), num_actions=3, num_tasks=1, v_min=-1.0, v_max=1.0)
    config = AgentConfig(conv_channels=(4, 4), conv_kernels=(4, 3), conv_strides=(2, 1), hidden_units=8, num_atoms=5)
    shifted, direct = (make_agent(dataclasses.replace(config, conv_form=form), spec) for form in ("shifted", "direct"))
    params = jax.jit(shifted.init)(jax.random.key(0))
    checkpoint.write(tmp_path / "1", checkpoint.snapshot(params), {})
    found, _ = checkpoint.read(tmp_path / "1", jax.eval_shape(direct.init, jax.random.key(0)))
    assert equal(found, params)
    obs = np.random.default_rng(0).integers(0, 256, (5, 12, 12, 4), dtype=np.uint8)
    before, after = (
        jax.jit(agent.evaluate)(tree, obs, np.zeros(5, np.int32))
        for agent, tree in ((shifted, params), (direct, found))
    )
    np.testing.assert_allclose(before.q_values, after.q_values, rtol=1e-5, atol=1e-6)


def test_an_empty_directory_has_nothing_to_restore(tmp_path):
    assert checkpoint.restore_newest(tmp_path / "checkpoints", example()) is None


def test_old_checkpoints_are_pruned_and_parameters_kept(tmp_path):
    for step in (1, 2, 3):
        save(tmp_path, step)
    assert checkpoint.checkpoint_steps(tmp_path / "checkpoints") == [2, 3]
    assert checkpoint.checkpoint_steps(tmp_path / "policies") == [1, 2, 3]
    params, _ = checkpoint.read(tmp_path / "policies" / "1", example()["params"])
    assert equal(params, example(1)["params"])


def flip(file: Path) -> None:
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(bytes(data))


def largest(directory: Path) -> Path:
    return max((p for p in (directory / "arrays").rglob("*") if p.is_file()), key=lambda p: p.stat().st_size)


def rewritten(**changes: object) -> Callable[[Path], object]:
    """f(checkpoint): changes keys of its manifest."""

    def rewrite(directory: Path) -> None:
        file = directory / "manifest.json"
        file.write_text(json.dumps({**json.loads(file.read_text()), **changes}))

    return rewrite


def forged(name: str, data: bytes) -> Callable[[Path], object]:
    """f(checkpoint): replaces a file, and makes the manifest fit."""

    def forge(directory: Path) -> None:
        (directory / name).write_bytes(data)
        listed = json.loads((directory / "manifest.json").read_text())["files"]
        rewritten(files={**listed, name: [len(data), checkpoint._digest(directory / name)]})(directory)

    return forge


DAMAGES = {
    "files in no map": (rewritten(files=[]), "no readable manifest"),
    "leaves in no map": (rewritten(leaves=[["a", "b"]]), "no readable manifest"),
    "a size without a hash": (rewritten(files={"host.msgpack": 3}), "no readable manifest"),
    "manifest nested deeply": (lambda d: (d / "manifest.json").write_text("[" * 100_000), "no readable manifest"),
    "host state that is no map": (forged("host.msgpack", b"\x93\x01\x02\x03"), "are not what the manifest says"),
    "host state that is no msgpack": (forged("host.msgpack", b"\xc1"), "cannot be read"),
    "flipped bit": (lambda d: flip(largest(d)), "do not match the manifest"),
    "cut file": (lambda d: os.truncate(largest(d), 10), "cut short"),
    "missing file": (lambda d: largest(d).unlink(), "missing or unknown"),
    "missing manifest": (lambda d: (d / "manifest.json").unlink(), "no readable manifest"),
    "half a manifest": (lambda d: os.truncate(d / "manifest.json", 40), "no readable manifest"),
    "host state changed": (lambda d: flip(d / "host.msgpack"), "do not match the manifest"),
    "emptied": (lambda d: (shutil.rmtree(d), d.mkdir()), "no readable manifest"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_the_newest_valid_checkpoint_is_used_and_the_damage_named(tmp_path, damage):
    save(tmp_path, 1)
    save(tmp_path, 2)
    hurt, message = DAMAGES[damage]
    hurt(tmp_path / "checkpoints" / "2")
    restored = checkpoint.restore_newest(tmp_path / "checkpoints", example())
    assert restored is not None
    assert restored.num_updates == 1
    assert len(restored.damage) == 1
    assert message in restored.damage[0]
    assert equal(restored.arrays, example(1))


def test_no_valid_checkpoint_is_an_error_that_names_each(tmp_path):
    for step in (1, 2):
        save(tmp_path, step)
        flip(largest(tmp_path / "checkpoints" / str(step)))
    with pytest.raises(CheckpointError, match=r"no checkpoint is valid:\n.*checkpoints/2.*\n.*checkpoints/1"):
        checkpoint.restore_newest(tmp_path / "checkpoints", example())


def test_another_shape_names_the_leaf(tmp_path):
    save(tmp_path, 1)
    template = {**example(), "frames": jnp.zeros((51, 8, 8, 3), jnp.uint8)}
    with pytest.raises(CheckpointError, match=r"leaf \['frames'\]: got \[\[50, 8, 8, 3\], 'uint8'\], want \[\[51,"):
        checkpoint.read(tmp_path / "checkpoints" / "1", template)


def test_another_schema_is_refused(tmp_path):
    save(tmp_path, 1)
    file = tmp_path / "checkpoints" / "1" / "manifest.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "schema": 99}))
    with pytest.raises(CheckpointError, match="schema 99, want 1"):
        checkpoint.verify(tmp_path / "checkpoints" / "1")


def test_a_failed_save_is_reported_and_leaves_the_old_checkpoint(tmp_path):
    save(tmp_path, 1)
    saver = checkpoint.Checkpointer(tmp_path, keep=2)
    shutil.rmtree(tmp_path / "policies")
    (tmp_path / "policies").write_text("a file where a directory should be")
    saver.save(2, example(2), example(2)["params"], {})
    saver.wait()
    assert "policies/2 could not be written" in (saver.outcome() or "")
    assert saver.outcome() is None
    assert checkpoint.checkpoint_steps(tmp_path / "checkpoints") == [1]


def test_what_a_killed_run_was_writing_is_removed(tmp_path):
    left = tmp_path / "checkpoints" / ".writing-5-123"
    left.mkdir(parents=True)
    checkpoint.Checkpointer(tmp_path, keep=1)
    assert not left.exists()


def test_a_snapshot_survives_donation_of_its_source():
    step = jax.jit(lambda x: x + 1, donate_argnums=0)
    array = jnp.zeros(1000)
    kept = checkpoint.snapshot({"x": array})
    for _ in range(5):
        array = step(array)
    assert float(kept["x"].sum()) == 0.0
