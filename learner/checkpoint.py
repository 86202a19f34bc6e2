"""Checkpoints: orbax arrays, a msgpack host state, and a manifest that proves the whole.

    checkpoints/<updates>/  arrays/ (orbax)  host.msgpack  manifest.json   the whole state, `keep` of them
    policies/<updates>/     the same, parameters only, never pruned         what evaluation reads

Writing: snapshot to host memory now, write into a hidden sibling in a thread, hash every file into the manifest, fsync
every file and directory, rename, fsync the parent. So a name without a dot stands for a whole checkpoint also after a
power cut, and the run's records, of which it has the lengths, are on the disk before it. Hashing and fsync release the
interpreter's lock: training goes on meanwhile.

A directory without a manifest that agrees with its files is damaged and named, never used; nothing in a checkpoint is
unpickled, so one from a stranger can be read.
"""

import hashlib
import json
import logging
import os
import re
import shutil
import sys
import threading
from collections.abc import Callable, Generator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import msgpack
import numpy as np
import orbax.checkpoint as ocp

from gvz.core.durable import fsync, fsync_tree, saved_steps
from gvz.core.errors import CheckpointError, WaitTimeoutError
from gvz.core.watchdog import AwakeClock
from learner.memory import release_freed_memory

CHECKPOINT_SCHEMA = 1
"""Raised by one whenever the arrays' or the host state's meaning changes."""

BLOCK_BYTES = 2**24
"""Larger arrays are stored in blocks of this size along their first axis: an array is encoded whole, beside a copy of
it (300 MB in one piece took 19 s and 300 MB more, in blocks 3 s and 130 MB; the same loaded cores)."""

WRITE_TIMEOUT_S = 1800.0
"""a checkpoint that is not written by then never will be: the disk does not answer"""

_JOIN_S = 0.1
"""a wait for the thread looks at its clock so often"""

_SPECIFICATION = re.compile(r" \[(tensorstore_spec|os_error_code)=.*", re.DOTALL)


@dataclass(frozen=True, kw_only=True, slots=True)
class Restored:
    """A checkpoint that was read whole.

    Attributes:
        num_updates: gradient steps it had done.
        arrays: the pytree of the template, numpy leaves.
        host: the host state.
        damage: one message for each newer checkpoint that could not be used.
    """

    num_updates: int
    arrays: Any
    host: dict[str, Any]
    damage: list[str]


def _is_key(x: Any) -> bool:
    return isinstance(x, jax.Array | jax.ShapeDtypeStruct) and jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def snapshot(tree: Any) -> Any:
    """Copies every array of `tree` to host memory that nothing else owns (a donated buffer may be reused at once)."""
    return jax.tree.map(lambda x: np.array(jax.random.key_data(x) if _is_key(x) else x, copy=True), tree)


def _leaf_specs(tree: Any) -> dict[str, list[Any]]:
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {jax.tree_util.keystr(path): [list(np.shape(leaf)), str(leaf.dtype)] for path, leaf in leaves}


def _digest(file: Path) -> str:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, lambda: hashlib.blake2b(digest_size=16)).hexdigest()


def _files(directory: Path) -> list[Path]:
    return sorted(p for p in directory.rglob("*") if p.is_file() and p.name != "manifest.json")


@cache
def _quiet() -> None:
    """Silences what orbax logs: warnings of what is meant to be so at every save, and tracebacks of errors it raises.

    It closes its event loop at the first error. Each further array then ends in a traceback of a thread of tensorstore.
    """
    logging.getLogger("absl").setLevel(logging.CRITICAL)
    shown_before = sys.unraisablehook

    def show(dropped: "sys.UnraisableHookArgs") -> None:
        if not (dropped.exc_type is RuntimeError and str(dropped.exc_value) == "Event loop is closed"):
            shown_before(dropped)

    sys.unraisablehook = show


def _checkpointer() -> ocp.Checkpointer:
    """Orbax, but for its copy of every array it is given: ours are snapshots."""
    _quiet()
    handler = ocp.type_handlers.NumpyHandler(deepcopy_host_arrays=False)
    registry = ocp.type_handlers.create_type_handler_registry((np.ndarray, handler))
    alone = ocp.options.MultiprocessingOptions()
    if jax.distributed.is_initialized():
        # each process writes a whole checkpoint of its own; orbax would write host arrays in process 0 alone, and wait
        # for all within its threads, where collectives of ours may be under way
        ocp.multihost.process_index = lambda: 0
        alone = ocp.options.MultiprocessingOptions(active_processes={0})
    tree = ocp.PyTreeCheckpointHandler(use_ocdbt=False, type_handler_registry=registry, multiprocessing_options=alone)
    return ocp.Checkpointer(tree, multiprocessing_options=alone)


def _blocks(leaves: list[np.ndarray]) -> dict[str, np.ndarray]:
    """What is stored: views of the leaves, whole or in blocks of their first axis; an empty leaf has none."""
    blocks = {}
    for i, leaf in enumerate(leaves):
        rows = max(1, BLOCK_BYTES // max(1, leaf[:1].nbytes)) if leaf.ndim else 1
        starts = range(0, len(leaf), rows) if leaf.ndim and leaf.size else range(int(leaf.size))
        for start in starts:
            blocks[f"{i:03d}.{start}"] = leaf[start : start + rows] if leaf.ndim else leaf
    return blocks


def write(
    directory: Path,
    arrays: Any,
    host: dict[str, Any],
    finishing: Callable[[], AbstractContextManager[object]] = nullcontext,
) -> None:
    """Writes `arrays` (numpy leaves) and `host` (msgpack types) to `directory`, whole or not at all.

    The directory appears within `finishing()`, which may raise an error instead.

    Raises:
        CheckpointError: the disk is full, permission is missing, or the like; nothing is left behind.
    """
    writing = directory.with_name(f".writing-{directory.name}-{os.getpid()}")
    try:
        shutil.rmtree(writing, ignore_errors=True)
        writing.mkdir(parents=True, mode=0o700)
        with _checkpointer() as checkpointer:
            checkpointer.save((writing / "arrays").absolute(), _blocks(jax.tree.leaves(arrays)))
        packed = msgpack.packb(host)
        assert packed is not None  # packb is typed for a stream too
        (writing / "host.msgpack").write_bytes(packed)
        manifest = {
            "schema": CHECKPOINT_SCHEMA,
            "leaves": _leaf_specs(arrays),
            "files": {str(f.relative_to(writing)): [f.stat().st_size, _digest(f)] for f in _files(writing)},
        }
        (writing / "manifest.json").write_text(json.dumps(manifest))
        fsync_tree(writing)
        with finishing():
            if directory.exists():
                shutil.rmtree(directory)
            writing.rename(directory)
            fsync(directory.parent)
    except Exception as error:  # orbax and tensorstore raise many unrelated classes for one full disk
        shutil.rmtree(writing, ignore_errors=True)
        raise CheckpointError(f"checkpoint {directory} could not be written: {_reason(error)}") from error


def _reason(error: Exception) -> str:
    """Without what tensorstore puts behind it: a specification of a thousand characters."""
    return f"{type(error).__name__}: {_SPECIFICATION.sub('', str(error))}"


def verify(directory: Path) -> dict[str, Any]:
    """Checks every file of a checkpoint against its manifest and returns the manifest.

    Raises:
        CheckpointError: says which file is missing, cut, changed or unknown.
    """
    try:
        manifest = json.loads((directory / "manifest.json").read_text())
        schema, _ = manifest["schema"], manifest["leaves"].keys()
        listed = {name: (size, digest) for name, (size, digest) in manifest["files"].items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise CheckpointError(f"{directory}: no readable manifest.json ({type(error).__name__}): not whole") from error
    if schema != CHECKPOINT_SCHEMA:
        raise CheckpointError(f"{directory}: schema {schema!r}, want {CHECKPOINT_SCHEMA}")
    present = {str(f.relative_to(directory)): f for f in _files(directory)}
    if present.keys() != listed.keys():
        raise CheckpointError(f"{directory}: files missing or unknown: {sorted(present.keys() ^ listed.keys())[:3]}")
    for name, (size, digest) in listed.items():
        try:
            found_size = present[name].stat().st_size
            if found_size != size:
                raise CheckpointError(f"{directory}/{name}: {found_size} bytes, want {size}: cut short")
            if _digest(present[name]) != digest:
                raise CheckpointError(f"{directory}/{name}: contents do not match the manifest: damaged")
        except OSError as error:
            raise CheckpointError(f"{directory}/{name}: cannot be read: {error.strerror}") from error
    return manifest


def read(directory: Path, template: Any) -> tuple[Any, dict[str, Any]]:
    """Reads a checkpoint into the structure of `template` (arrays or ShapeDtypeStructs).

    Returns: the pytree with numpy leaves (typed PRNG keys are wrapped again), and the host state.

    Raises:
        CheckpointError: damaged, or its leaves are not the template's (names the leaf, got and wanted).
    """
    manifest = verify(directory)
    plain = jax.tree.map(lambda x: jax.eval_shape(jax.random.key_data, x) if _is_key(x) else x, template)
    wanted, got = _leaf_specs(plain), manifest["leaves"]
    for path in [*wanted, *got]:
        if wanted.get(path) != got.get(path):
            raise CheckpointError(
                f"{directory}: leaf {path}: got {got.get(path, 'nothing')}, want {wanted.get(path, 'nothing')}; "
                "it belongs to another configuration"
            )
    leaves = [np.empty(np.shape(leaf), leaf.dtype) for leaf in jax.tree.leaves(plain)]
    blocks = _blocks(leaves)
    try:
        with _checkpointer() as checkpointer:
            found = checkpointer.restore((directory / "arrays").absolute(), blocks)
        host = msgpack.unpackb((directory / "host.msgpack").read_bytes())
    except Exception as error:  # as for writing
        raise CheckpointError(f"{directory} cannot be read: {_reason(error)}") from error
    if _leaf_specs(found) != _leaf_specs(blocks) or not isinstance(host, dict):
        raise CheckpointError(f"{directory}: its arrays or its host state are not what the manifest says: damaged")
    for name, block in blocks.items():
        block[...] = found.pop(name)
    arrays = jax.tree.unflatten(jax.tree.structure(plain), leaves)
    return jax.tree.map(lambda t, x: jax.random.wrap_key_data(x) if _is_key(t) else x, template, arrays), host


def restore_newest(directory: Path, template: Any, newest: int | None = None) -> Restored | None:
    """Reads the newest valid checkpoint, of at most `newest` updates; None if there is no checkpoint at all.

    Raises:
        CheckpointError: there are checkpoints but none is valid; names the damage of each.
    """
    damage: list[str] = []
    for step in reversed(saved_steps(directory)):
        if newest is not None and step > newest:
            continue
        try:
            arrays, host = read(directory / str(step), template)
        except CheckpointError as error:
            damage.append(str(error))
            continue
        return Restored(num_updates=step, arrays=arrays, host=host, damage=damage)
    if damage:
        raise CheckpointError("no checkpoint is valid:\n  " + "\n  ".join(damage))
    return None


class Checkpointer:
    """Writes a run's checkpoints in a thread, one at a time, and keeps `keep` of them."""

    def __init__(self, run_path: Path, *, keep: int):
        """Removes what a killed run was still writing.

        Args:
            run_path: the run directory.
            keep: whole checkpoints to keep, at least 1.
        """
        self._run_path, self._keep = run_path, keep
        self._checkpoints, self._policies = run_path / "checkpoints", run_path / "policies"
        self._thread: threading.Thread | None = None
        self._outcome: str | None = None
        self._ends, self._abandoned = threading.Lock(), False
        for folder in (self._checkpoints, self._policies):
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        fsync(run_path)
        self._remove_unfinished()

    @property
    def busy(self) -> bool:
        """A checkpoint is being written."""
        return self._thread is not None and self._thread.is_alive()

    def save(
        self, num_updates: int, arrays: Any, params: Any, host: dict[str, Any], *, keep_from: int | None = None
    ) -> None:
        """Snapshots `arrays` now and writes them in the background, `params` beside them for evaluation.

        Checkpoints of `keep_from` updates or more are kept, however many those are.

        Waits for an earlier save first. How it ended is kept for `outcome`; a failure is never raised here.

        Raises:
            WaitTimeoutError: the earlier save does not end.
        """
        self.wait()
        failed = f"checkpoint {self._checkpoints / str(num_updates)} could not be written"
        try:
            copies = [snapshot(params), snapshot(arrays)]  # the thread takes them out, so that it can let go of them
        except MemoryError as error:
            self._outcome = f"{failed}: there is no memory for a copy of its arrays: {error}"
            return

        def work() -> None:
            try:
                write(self._policies / str(num_updates), copies.pop(0), {"num_updates": num_updates}, self._finishing)
                for records in self._run_path.glob("*.jsonl"):  # on the disk before the lengths in `host`
                    fsync(records)
                write(self._checkpoints / str(num_updates), copies.pop(0), host, self._finishing)
                # what is newer was damaged when the run went on from an older one: it takes no place among the kept
                steps = [step for step in saved_steps(self._checkpoints) if step <= num_updates]
                for step in steps[: -self._keep]:
                    if keep_from is not None and step >= keep_from:
                        break
                    shutil.rmtree(self._checkpoints / str(step), ignore_errors=True)
                self._outcome = ""
            except (CheckpointError, OSError) as error:
                self._outcome = None if self._abandoned else str(error)
            copies.clear()
            release_freed_memory()

        thread = threading.Thread(target=work, name=f"checkpoint {num_updates}", daemon=True)
        try:
            thread.start()
        except RuntimeError as error:  # too many threads and processes
            self._outcome = f"{failed}: {error}"
            return
        self._thread = thread

    def outcome(self) -> str | None:
        """How the last save ended, told once: why it failed, or "" if it is written. None: nothing new has ended."""
        outcome, self._outcome = self._outcome, None
        return outcome

    def wait(self, timeout_s: float = WRITE_TIMEOUT_S) -> None:
        """Waits until nothing is being written. Time in which this process was stopped does not count.

        Raises:
            WaitTimeoutError: it takes longer than `timeout_s`.
        """
        if self._thread is not None:
            clock = AwakeClock()
            while self._thread.is_alive():
                if clock.look() > timeout_s:
                    raise WaitTimeoutError(
                        f"the learner waited {timeout_s:g} s for {self._thread.name} to be written to "
                        f"{self._checkpoints}; the disk does not answer, or is too slow for checkpoints of this size"
                    )
                self._thread.join(min(timeout_s, _JOIN_S))
            self._thread = None

    def abandon(self) -> None:
        """Gives up what is being written; for a process that exits at once. The thread may still be at work."""
        self._thread = None
        with self._ends:
            self._abandoned = True
        self._remove_unfinished()

    @contextmanager
    def _finishing(self) -> Generator[None]:
        """Nothing appears of which `abandon` may have removed a part."""
        with self._ends:
            if self._abandoned:
                raise CheckpointError("it was given up")
            yield

    def _remove_unfinished(self) -> None:
        for folder in (self._checkpoints, self._policies):
            for left in folder.glob(".writing-*"):
                shutil.rmtree(left, ignore_errors=True)
