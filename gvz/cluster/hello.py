"""What a host says of itself before it plays: what must be the same on both sides, or records would mean two things."""

import hashlib
from collections.abc import Mapping

import msgspec

from actors.pool import PoolConfig
from gvz.cluster.nodes import source_digest
from gvz.cluster.wire import WIRE_VERSION
from gvz.core.env_config import EnvConfig
from gvz.run import machine
from gvz.run.footprint import Footprint
from gvz.run.footprint import check as check_footprint
from gvz.scenarios.compiler import compile_task
from gvz.segmentation import segmenter_file
from gvz.tasks import parse_task
from gvz.transport.messages import SCHEMA_VERSION, Count

REAL_GAMES = "gvz.env:make_env"
"""the entry point whose tasks have maps"""


class Hello(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The first answer of a host. JSON types."""

    versions: dict[str, str]
    """of Python and packages"""
    code: str
    """digest of this project's source files"""
    schemas: tuple[Count, Count]
    """of messages and of batches"""
    maps: dict[str, str]
    """task -> digest of its maps as this machine compiles them, and of the network of segmented frames"""
    refusal: str = ""
    """why this machine cannot play"""


def hello(config: PoolConfig) -> Hello:
    """What this machine says about playing `config`."""
    return Hello(
        versions=machine.versions(),
        code=source_digest(),
        schemas=(SCHEMA_VERSION, WIRE_VERSION),
        maps=content_digests(config),
    )


def differences(ours: Hello, theirs: Hello) -> list[str]:
    """How a host differs from the learner's machine: a line `what: got, want` for each thing."""
    found: list[str] = []
    for kind, want, got in (("", ours.versions, theirs.versions), ("maps or networks of ", ours.maps, theirs.maps)):
        found += _differing(kind, want, got)
    if theirs.schemas != ours.schemas:
        found.append(f"schemas of messages and batches: got {theirs.schemas}, want {ours.schemas}")
    if theirs.code != ours.code and not found:
        found.append(f"source files of GViZDoom: got digest {theirs.code}, want {ours.code}")
    return found


def content_digests(config: PoolConfig) -> dict[str, str]:
    """Task -> digest of the file that the engine loads, of the map of one episode (which may be drawn), and of the
    network of segmented frames.
    """
    if config.env_entry_point != REAL_GAMES:
        return {}
    fields = {field: value for field, value in config.env_config.items() if field in EnvConfig.__dataclass_fields__}
    env, digests = EnvConfig(**fields), {}
    for name in config.tasks:
        task = parse_task(name)
        compiled = compile_task(task, env.profile)
        drawn, magic = compiled.map_of(config.seed)
        network = segmenter_file(task.scenario.id, env).read_bytes() if env.frames == "segmented" else b""
        digests[name] = _digest(compiled.wad_path.read_bytes(), drawn or b"", str(magic).encode(), network)
    return digests


def check_machine(config: PoolConfig) -> None:
    """Refuses a pool for which this machine has no room.

    Raises:
        ResourceError: memory or /dev/shm is too small.
    """
    check_footprint(
        Footprint(
            replay_bytes=0,
            replay_on_host=False,
            params_bytes=4 * config.num_params,
            num_actors=config.num_actors,
            num_games=config.num_lanes,
            transport_bytes=config.shared_memory_bytes(),
            placement="",
        )
    )


def _differing(kind: str, want: Mapping[str, str], got: Mapping[str, str]) -> list[str]:
    names = [name for name in {**want, **got} if want.get(name) != got.get(name)]
    return [f"{kind}{name}: got {got.get(name, 'none')}, want {want.get(name, 'none')}" for name in names]


def _digest(*parts: bytes) -> str:
    found = hashlib.blake2b(digest_size=8)
    for part in parts:
        found.update(len(part).to_bytes(8, "little"))
        found.update(part)
    return found.hexdigest()
