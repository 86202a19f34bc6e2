"""Fuzz targets: checkpoints and policies, which are the same on the disk. Imports jax, learner.checkpoint."""

import json
import time
from functools import partial
from pathlib import Path

import jax
import numpy as np

from gvz.core.errors import CheckpointError
from learner import checkpoint
from tests.fuzz.files import JSON_WORDS
from tests.fuzz.target import Target

_LATE_READS_S = 1.0
"""a read of the disk by tensorstore is over by then, whatever orbax, which started it, has met in another array"""


def _small_checkpoint(directory: Path) -> tuple[Path, dict[str, jax.ShapeDtypeStruct]]:
    arrays = {"w": np.arange(6, dtype=np.float32).reshape(2, 3), "n": np.array(7, np.int32)}
    checkpoint.write(directory / "5", arrays, {"num_updates": 5, "kpis": [1.0, 2.0]})
    return directory / "5", {name: jax.ShapeDtypeStruct(array.shape, array.dtype) for name, array in arrays.items()}


def checkpoint_manifest(directory: Path) -> Target:
    """The manifest of a checkpoint whose other files are whole."""
    whole, _ = _small_checkpoint(directory)
    manifest = whole / "manifest.json"
    good = manifest.read_bytes()

    def run(data: bytes) -> bool:
        manifest.write_bytes(data)
        try:
            found = checkpoint.verify(whole)
        except CheckpointError:
            return False
        assert found["files"] == json.loads(good)["files"]
        assert found["schema"] == checkpoint.CHECKPOINT_SCHEMA
        return True

    return Target(run=run, seeds=[good], words=[*JSON_WORDS, b'"files": ', b'"leaves": ', b'"host.msgpack"'])


def checkpoint_files(directory: Path) -> Target:
    """A checkpoint of a stranger, who changed a file and made the manifest fit; the first byte says which file."""
    whole, template = _small_checkpoint(directory)
    manifest = whole / "manifest.json"
    files = sorted(file for file in whole.rglob("*") if file.is_file() and file != manifest)
    contents = [file.read_bytes() for file in files]
    saved = json.loads(manifest.read_bytes())

    def run(data: bytes) -> bool:
        for file, content in zip(files, contents, strict=True):
            file.write_bytes(content)
        files[data[0] % len(files) if data else 0].write_bytes(data[1:])
        listed = {str(file.relative_to(whole)): [file.stat().st_size, checkpoint._digest(file)] for file in files}
        manifest.write_text(json.dumps({**saved, "files": listed}))
        try:
            arrays, host = checkpoint.read(whole, template)
        except CheckpointError:
            return False
        assert isinstance(host, dict)
        assert {name: (np.shape(a), a.dtype) for name, a in arrays.items()} == {
            name: (leaf.shape, leaf.dtype) for name, leaf in template.items()
        }
        return True

    seeds = [bytes([index]) + content for index, content in enumerate(contents)]
    return Target(
        run=run,
        seeds=seeds,
        words=[b"\x80", b"\xc1", b"\xdf\xff\xff\xff\xff", b"{}"],
        num_inputs=40,
        close=partial(time.sleep, _LATE_READS_S),
    )
