"""Trained policies that come with GViZDoom: one file each, which holds a run directory.

Wherever a command takes a run directory, `zoo:NAME` stands for such a policy. Its file is a zip archive with the run's
configuration, its newest policy, the networks of its segmented frames, its records of training, and the evaluation
episodes of this policy (its score card).
"""

import contextlib
import dataclasses
import hashlib
import json
import math
import shutil
import zipfile
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gvz.core import janitor, records
from gvz.core.cache import cache_directory
from gvz.core.errors import ConfigError, ResourceError, nearest
from gvz.core.files import written_whole
from gvz.core.libraries import require_learner
from gvz.core.registry import NO_OWN_FILES, OwnFiles
from gvz.run.rundir import EVALUATION_RECORDS, START_RECORDS

ZOO_DIRECTORY = Path(__file__).parent.parent / "zoo"
PREFIX = "zoo:"
MAX_BYTES = 2_000_000
"""of a file"""
RECORDS = ("config.json", "metrics.jsonl", "episodes.jsonl", START_RECORDS, EVALUATION_RECORDS)
MAX_ROWS = {"metrics.jsonl": 100, "episodes.jsonl": 4_000}
"""that are kept of a run's records of training, at equal distances, the last one among them"""


def zoo_names() -> list[str]:
    """Names of the policies."""
    return sorted(file.stem for file in ZOO_DIRECTORY.glob("[!.]*.zip"))  # one that is being written begins with a dot


def run_directory(path: Path) -> Path:
    """The run directory that `path` names: itself, or that of a policy, which is unpacked into the cache.

    Raises:
        ConfigError: there is no such policy. ResourceError: its file is damaged, or the cache cannot be written.
    """
    name, known = str(path).removeprefix(PREFIX), zoo_names()
    if not str(path).startswith(PREFIX):
        if name in known and not path.exists():
            raise ConfigError(f"{path}: no such file or directory; did you mean {PREFIX}{name}?")
        return path
    if name not in known:
        raise ConfigError(f"{path}: no such policy{nearest(name, known)}; want one of {', '.join(known) or 'none'}")
    file = ZOO_DIRECTORY / f"{name}.zip"
    digest = hashlib.blake2b(file.read_bytes(), digest_size=8).hexdigest()
    unpacked = cache_directory() / "zoo" / digest / name
    try:
        _unpack(file, unpacked)
    except (OSError, zipfile.BadZipFile, EOFError) as error:
        if not isinstance(error, OSError) or error.errno is None:  # what a library says of compressed data
            raise ResourceError(
                f"{file} is damaged: {error}; install GViZDoom again, or add the policy again"
            ) from error
        raise ResourceError(
            f"cache {cache_directory()}: {error}; make it writable, or set GVZ_CACHE_DIR to a directory that is"
        ) from error
    return unpacked


def _unpack(file: Path, directory: Path) -> None:
    """Unpacks what is not there: all of it, or files that were deleted since, as old ones in a cache are, or that a
    power cut has damaged.
    """
    with zipfile.ZipFile(file) as archive:
        lost = [entry for entry in archive.infolist() if not _is_whole(directory / entry.filename, entry)]
        if not lost:
            return
        directory.parent.mkdir(parents=True, exist_ok=True)
        with janitor.temporary_directory(directory.parent.resolve()) as temporary:
            fresh = temporary / directory.name
            archive.extractall(fresh, lost)  # zipfile keeps every name inside
            if not directory.exists():
                # another process may have been first; then its directory stays
                with contextlib.suppress(OSError):
                    fresh.rename(directory)
                return
            for path in sorted(fresh.rglob("*")):
                there = directory / path.relative_to(fresh)
                if path.is_dir():
                    there.mkdir(exist_ok=True)
                else:
                    path.replace(there)


def _is_whole(path: Path, entry: zipfile.ZipInfo) -> bool:
    if entry.is_dir():
        return path.is_dir()
    own = path.name == EVALUATION_RECORDS  # episodes that the user played since are there, too
    return path.is_file() and (own or zlib.crc32(path.read_bytes()) == entry.CRC)


@dataclass(frozen=True, kw_only=True, slots=True)
class Packed:
    """A policy as it was put into the zoo."""

    file: Path
    num_updates: int
    num_bytes: int
    num_episodes: int
    """evaluation episodes of this very policy, its score card"""


def pack(run_dir: Path, name: str, checkpoint: str = "newest", own_files: OwnFiles = NO_OWN_FILES) -> Packed:
    """Puts a policy of a run into the zoo. Its parameters are rounded to bfloat16: less than half of the bytes.

    Only evaluation episodes of the rounded parameters go with it. So pack, evaluate `zoo:NAME`, and pack `zoo:NAME`
    again.

    Args:
        run_dir: of the run.
        name: of the policy in the zoo.
        checkpoint: which of its policies, as for `gvz evaluate`.
        own_files: as for `read_run_config`.

    Raises:
        ConfigError: not a run, no such policy, a name that no file can have, or a file that would be too large.
        CheckpointError: the policy is damaged.
    """
    require_learner("adding a policy to the zoo")
    from gvz.evaluation.trained import find_checkpoint, read_params, read_run_config, trained_player
    from gvz.run.config_files import config_to_dict
    from gvz.segmentation import KEPT_SEGMENTERS, keep_segmenters
    from learner import checkpoint as checkpoints

    if not name.replace("_", "").replace("-", "").isalnum():
        raise ConfigError(f"zoo: got name {name!r}, want letters, digits, _ and -")
    config = read_run_config(run_dir, own_files)
    num_updates = find_checkpoint(run_dir, checkpoint)
    _, params = read_params(run_dir, config, num_updates)
    with janitor.temporary_directory() as temporary:
        packed = temporary / name
        packed.mkdir()
        for record in RECORDS[1:-1]:
            if (run_dir / record).exists():
                shutil.copy(run_dir / record, packed)
        for record, most in MAX_ROWS.items():
            _keep_some_rows(packed / record, most)
        keep_segmenters([scenario.id for scenario in config.table.scenarios], config.env, packed / KEPT_SEGMENTERS)
        env = dataclasses.replace(config.env, segmenter="")
        saved = config_to_dict(dataclasses.replace(config, env=env, run_dir=None))  # no path of this machine
        (packed / RECORDS[0]).write_text(json.dumps(saved, indent=2) + "\n")
        checkpoints.write(packed / "policies" / str(num_updates), _rounded(params), {"num_updates": num_updates})
        player = trained_player(packed, read_run_config(packed, own_files), num_updates)
        rows = score_card(records.read_stored(run_dir / EVALUATION_RECORDS)[0])
        rows = [row for row in rows if player.identity.items() <= row.items()]
        (packed / EVALUATION_RECORDS).write_text("".join(json.dumps(row) + "\n" for row in rows))
        file = packed.with_suffix(".zip")
        with zipfile.ZipFile(file, "w", zipfile.ZIP_BZIP2) as archive:  # records take half of what deflate leaves
            for path in sorted(packed.rglob("*")):
                archive.write(path, path.relative_to(packed))
        if (size := file.stat().st_size) > MAX_BYTES:
            raise ConfigError(
                f"zoo: {name} would have {size:,} bytes, want at most {MAX_BYTES:,}; train a smaller network"
            )
        added = ZOO_DIRECTORY / file.name
        with written_whole(added) as writing:
            shutil.copy(file, writing)
    return Packed(file=added, num_updates=num_updates, num_bytes=size, num_episodes=len(rows))


def score_card(rows: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """The episodes that scores are published of: those of base seed 0."""
    return [row for row in rows if row.get("base_seed", 0) == 0]


def _rounded(params: object) -> object:
    import jax
    import jax.numpy as jnp
    import numpy as np

    return jax.tree.map(
        lambda leaf: leaf.astype(jnp.bfloat16).astype(np.float32) if leaf.dtype == np.float32 else leaf, params
    )


def _keep_some_rows(record: Path, most: int) -> None:
    if record.exists():
        rows = record.read_text().splitlines(keepends=True)
        distance = max(1, math.ceil(len(rows) / most))
        record.write_text("".join(rows[::-distance][::-1]))
