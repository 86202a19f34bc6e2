"""Checkpoints: whole or not at all, and damage is named, never used."""

import contextlib
import dataclasses
import itertools
import json
import os
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gvz.core.durable import saved_steps
from gvz.core.errors import CheckpointError, WaitTimeoutError
from learner import checkpoint
from learner.agents.base import AgentSpec, make_agent
from learner.agents.configs.rainbow import RainbowConfig
from tests.full_disk import full_disk
from tests.waiting import make_pause


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


def save(run: Path, step: int, keep: int = 2, keep_from: int | None = None) -> None:
    saver = checkpoint.Checkpointer(run, keep=keep)
    host = {"num_updates": step, "note": "é"}
    saver.save(step, example(step), example(step)["params"], host, keep_from=keep_from)
    saver.wait()
    assert saver.outcome() == ""


@pytest.mark.parametrize("block_bytes", [checkpoint.BLOCK_BYTES, 1000])
def test_what_is_written_is_read_back_exactly_and_silently(tmp_path, caplog, monkeypatch, block_bytes):
    """Whole, or the 50 frames of 192 bytes in blocks of 5."""
    monkeypatch.setattr(checkpoint, "BLOCK_BYTES", block_bytes)
    save(tmp_path, 7)
    restored = checkpoint.restore_newest(tmp_path / "checkpoints", jax.eval_shape(example))
    assert caplog.text == ""
    assert restored is not None
    assert (restored.num_updates, restored.damage) == (7, [])
    assert restored.host == {"num_updates": 7, "note": "é"}
    assert equal(restored.arrays, example(7))


def test_parameters_written_under_one_form_of_the_convolution_are_read_under_the_other(tmp_path):
    spec = AgentSpec(obs_shape=(12, 12, 4), num_actions=3, num_tasks=1, v_min=-1.0, v_max=1.0)
    config = RainbowConfig(conv_channels=(4, 4), conv_kernels=(4, 3), conv_strides=(2, 1), hidden_units=8, num_atoms=5)
    shifted, direct = (make_agent(dataclasses.replace(config, conv_form=form), spec) for form in ("shifted", "direct"))
    params = jax.jit(shifted.init)(jax.random.key(0))
    checkpoint.write(tmp_path / "1", checkpoint.snapshot(params), {})
    found, _ = checkpoint.read(tmp_path / "1", jax.eval_shape(direct.init, jax.random.key(0)))
    assert equal(found, params)
    frames = jnp.asarray(np.random.default_rng(0).integers(0, 256, (5, 12, 12, 4), dtype=np.uint8))
    obs = dataclasses.replace(spec.zeros(5), frames=frames)
    before, after = (jax.jit(agent.evaluate)(tree, obs) for agent, tree in ((shifted, params), (direct, found)))
    np.testing.assert_allclose(before.q_values, after.q_values, rtol=1e-5, atol=1e-6)


def test_an_empty_directory_has_nothing_to_restore(tmp_path):
    assert checkpoint.restore_newest(tmp_path / "checkpoints", example()) is None


def test_old_checkpoints_are_pruned_and_parameters_kept(tmp_path):
    for step in (1, 2, 3):
        save(tmp_path, step)
    assert saved_steps(tmp_path / "checkpoints") == [2, 3]
    assert saved_steps(tmp_path / "policies") == [1, 2, 3]
    params, _ = checkpoint.read(tmp_path / "policies" / "1", example()["params"])
    assert equal(params, example(1)["params"])


def test_what_other_processes_go_on_from_is_kept_and_read(tmp_path):
    for step, keep_from in ((1, None), (2, 0), (3, 2), (4, 2), (5, 2)):
        save(tmp_path, step, keep_from=keep_from)
    assert saved_steps(tmp_path / "checkpoints") == [2, 3, 4, 5]
    restored = checkpoint.restore_newest(tmp_path / "checkpoints", jax.eval_shape(example), newest=3)
    assert restored is not None
    assert restored.num_updates == 3
    assert checkpoint.restore_newest(tmp_path / "checkpoints", jax.eval_shape(example), newest=1) is None


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
    rewritten(schema=99)(tmp_path / "checkpoints" / "1")
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
    assert saved_steps(tmp_path / "checkpoints") == [1]


def test_every_file_is_on_the_disk_before_the_rename_and_the_rename_before_the_end(tmp_path, monkeypatch):
    """Else a power cut may leave a name that stands for a whole checkpoint, with files that are empty."""
    done: list[tuple[str, str]] = []
    fsync, rename = os.fsync, os.rename

    def recorded_fsync(descriptor: int) -> None:
        fsync(descriptor)
        done.append(("fsync", str(Path(f"/proc/self/fd/{descriptor}").readlink())))

    def recorded_rename(source: Path, target: Path) -> None:
        rename(source, target)
        done.append(("rename", str(target)))

    monkeypatch.setattr(os, "fsync", recorded_fsync)
    monkeypatch.setattr(os, "rename", recorded_rename)
    (tmp_path / "episodes.jsonl").touch()
    save(tmp_path, 7)
    for kind in ("policies", "checkpoints"):
        final = tmp_path / kind / "7"
        renamed = done.index(("rename", str(final)))
        hidden = final.with_name(f".writing-7-{os.getpid()}")
        synced = [
            Path(path) for action, path in done[:renamed] if action == "fsync" and Path(path).is_relative_to(hidden)
        ]
        everything = [hidden / path.relative_to(final) for path in (final, *final.rglob("*"))]
        assert len(everything) > 3
        assert set(everything) <= set(synced)
        for path in everything[1:]:
            assert synced.index(path) < synced.index(path.parent), "what a directory names is there before the name is"
        assert done[renamed + 1] == ("fsync", str(tmp_path / kind))
    assert ("fsync", str(tmp_path / "episodes.jsonl")) in done[:renamed], "the checkpoint vouches for its length"
    before = done.index(("fsync", str(tmp_path / "checkpoints")))
    assert ("fsync", str(tmp_path)) in done[:before], "the folders themselves have their names"


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


def test_a_snapshot_stays_as_it_was_when_its_source_is_written_to():
    """Windows of rollouts are arrays of numpy that go on being filled while a thread writes the checkpoint."""
    array = np.zeros(3)
    kept = checkpoint.snapshot({"x": array})
    array[:] = 1.0
    assert not kept["x"].any()


def random_example(step: int, num_bytes: int = 300_000):
    """Noise, which no compression makes smaller."""
    noise = np.random.default_rng(step).integers(0, 256, num_bytes, dtype=np.uint8)
    return {"noise": noise, "params": np.full(4, step, np.float32)}


def test_a_full_disk_is_reported_once_leaves_nothing_and_the_next_save_is_whole(tmp_path, caplog):
    saver = checkpoint.Checkpointer(tmp_path, keep=2)
    for step in (1, 2, 3):
        arrays = random_example(step)
        with full_disk(200_000) if step == 2 else contextlib.nullcontext():
            saver.save(step, arrays, arrays["params"], {})
            saver.wait()
        if step == 2:
            failure = saver.outcome() or ""
            assert "checkpoints/2 could not be written: ValueError: " in failure
            assert failure.endswith(": File too large"), "the reason ends it, not tensorstore's specification"
            assert sorted(p.name for p in (tmp_path / "checkpoints").iterdir()) == ["1"]
        else:
            assert saver.outcome() == ""
    assert saved_steps(tmp_path / "checkpoints") == [1, 3]
    checkpoint.verify(tmp_path / "checkpoints" / "3")
    assert caplog.text == "", "orbax logs tracebacks of what it raises"


@pytest.mark.parametrize("folder", ["checkpoints", "policies"])
def test_a_folder_that_cannot_be_written_to_is_reported(tmp_path, folder):
    saver = checkpoint.Checkpointer(tmp_path, keep=2)
    (tmp_path / folder).rename(tmp_path / "elsewhere")
    (tmp_path / folder).touch()  # stops root too, as permissions would not
    saver.save(1, example(), example()["params"], {})
    saver.wait()
    assert f"{folder}/1 could not be written: " in (saver.outcome() or "")
    (tmp_path / folder).unlink()
    (tmp_path / "elsewhere").rename(tmp_path / folder)
    save(tmp_path, 1)
    checkpoint.verify(tmp_path / folder / "1")


def test_every_single_file_of_a_checkpoint_is_guarded(tmp_path):
    checkpoint.write(tmp_path / "1", checkpoint.snapshot(example()), {"num_updates": 1})
    files = [file for file in (tmp_path / "1").rglob("*") if file.is_file()]
    assert len(files) > 5
    for file in files:
        whole = file.read_bytes()
        for hurt in (whole[:-1], b"", bytes([whole[0] ^ 1]) + whole[1:], whole[:-1] + bytes([whole[-1] ^ 1])):
            file.write_bytes(hurt)
            with pytest.raises(CheckpointError, match=f"{re.escape(file.name)}|no readable manifest"):
                checkpoint.verify(tmp_path / "1")
        file.write_bytes(whole)
    checkpoint.verify(tmp_path / "1")


def test_no_changed_byte_of_a_manifest_is_accepted(tmp_path):
    arrays = checkpoint.snapshot({"w": jnp.arange(6.0)})
    checkpoint.write(tmp_path / "1", arrays, {})
    file = tmp_path / "1" / "manifest.json"
    whole = file.read_bytes()
    for at in range(len(whole)):
        file.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
        with pytest.raises(CheckpointError):
            checkpoint.read(tmp_path / "1", arrays)


@pytest.mark.parametrize(("keep", "left"), [(1, [4, 9]), (2, [3, 4, 9]), (3, [2, 3, 4, 9]), (9, [1, 2, 3, 4, 9])])
def test_a_damaged_newer_checkpoint_takes_no_place_among_the_kept(tmp_path, keep, left):
    for step in (1, 2, 3, 9):
        save(tmp_path, step, keep=9)
    flip(largest(tmp_path / "checkpoints" / "9"))
    save(tmp_path, 4, keep=keep)
    assert saved_steps(tmp_path / "checkpoints") == left
    restored = checkpoint.restore_newest(tmp_path / "checkpoints", example())
    assert restored is not None
    assert restored.num_updates == 4


def test_a_save_that_does_not_end_is_named(tmp_path):
    saver = checkpoint.Checkpointer(tmp_path, keep=1)
    arrays = random_example(1, 30_000_000)
    saver.save(1, arrays, arrays["params"], {})
    with pytest.raises(WaitTimeoutError, match=r"waited 0\.001 s for checkpoint 1 to be written to .*/checkpoints"):
        saver.wait(0.001)
    saver.wait()
    assert saver.outcome() == ""


def test_time_in_which_the_learner_was_stopped_is_no_time_of_waiting_for_a_save(tmp_path, monkeypatch):
    saver, pause = checkpoint.Checkpointer(tmp_path, keep=1), make_pause(monkeypatch)

    class Writing(threading.Thread):
        """It ends after the third wait for it; the process is stopped for hours in each."""

        waits = 0

        def join(self, timeout: float | None = None) -> None:
            del timeout
            self.waits += 1
            pause(7200)

        def is_alive(self) -> bool:
            return self.waits < 3

    saver._thread = Writing()
    saver.wait()


WRITER = Path(__file__).with_name("checkpoint_writer.py")


def kills(tmp_path: Path, count: int) -> list[dict]:
    """What each life of a writer found that the one before left when it was killed at a random moment."""
    with subprocess.Popen(
        [sys.executable, str(WRITER), str(tmp_path), str(count)], stdout=subprocess.PIPE, text=True
    ) as process:
        out, _ = process.communicate(timeout=280)
    assert process.returncode == 0
    return [json.loads(line) for line in out.splitlines()]


def check_kills(found: list[dict], count: int) -> None:
    assert len(found) == count + 1
    assert found[0]["newest"] == 0
    for before, after in itertools.pairwise(found):
        assert after["damage"] == []
        assert after["newest"] in (before["saved"], before["saved"] + 1), "what was reported written is there"
        assert after["right"], "and it is what was written"
    assert sum(life["unfinished"] for life in found) > count / 10, "kills in the middle of writing"
    assert found[-1]["saved"] > count / 3


def test_a_writer_killed_at_random_moments_always_leaves_its_newest_checkpoint_whole(tmp_path):
    check_kills(kills(tmp_path, 30), 30)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_writer_killed_at_very_many_random_moments_leaves_its_newest_checkpoint_whole(tmp_path):
    for part in range(10):
        check_kills(kills(tmp_path / str(part), 30), 30)
