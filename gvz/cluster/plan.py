"""What a learner with actor hosts would do, on paper: rates, network, memory, age of the parameters. Pure arithmetic.

`capacity` works from measured constants (`Costs`) and a description of the cluster (`Cluster`).
"""

import math
from dataclasses import dataclass

from gvz.core.errors import ConfigError
from gvz.run.footprint import ACTOR_MEMORY_BYTES, ENGINE_MEMORY_BYTES, ENGINE_SHM_BYTES, LEARNER_MEMORY_BYTES


@dataclass(frozen=True, kw_only=True, slots=True)
class Costs:
    """Measured constants: processor time in seconds, of one core."""

    decision_s: float
    """of a decision on an actor's core: its engine, its frame, its network"""
    pack_s: float
    """of a record on its host: sorted by lane, compressed, put into a batch"""
    unpack_s: float
    """of a record on the learner's host: its batch taken apart, its frame decompressed"""
    ingest_s: float
    """of a record on its way into the replay"""
    ratio: float
    """bytes of frames before and after compression"""
    source: str
    """which record or measurement they are of"""

    def __post_init__(self) -> None:
        for name in ("decision_s", "pack_s", "unpack_s", "ingest_s", "ratio"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"{name}: got {getattr(self, name):g}, want more than 0")


RECORDED = Costs(
    decision_s=(479.8 + 1221.0) * 1e-6,  # engines and Python, 8 games an actor, full network
    pack_s=61e-6,
    unpack_s=47e-6,
    ingest_s=22e-6,
    ratio=2.43,
    source="us a decision: results/performance/acting.json; the others: gvz cluster plan --measure, 2026-11-23, 2,948 "
    "records of rainbow_4task, AMD EPYC, other work on its second core",
)


@dataclass(frozen=True, kw_only=True, slots=True)
class Cluster:
    """What is asked about."""

    hosts: int
    """that play"""
    cores: int
    """of each"""
    games_per_actor: int
    frame_bytes: int
    step_bytes: int
    """of a record beside its frame"""
    params_bytes: int
    replay_bytes: int
    env_steps_per_update: float
    gbit_per_s: float = 10.0
    """of the learner's network, each way"""
    publish_period_s: float = 1.0
    batch_records: int = 512
    credits: int = 2
    """batches of a host under way"""
    ring_records: int = 64
    """of an actor, waiting"""
    compress: bool = True
    devices: int = 1
    updates_per_s: float | None = None
    """gradient steps of one device; None: not known, no limit"""

    def __post_init__(self) -> None:
        whole = ("hosts", "cores", "games_per_actor", "batch_records", "credits", "devices")
        for name in (*whole, "env_steps_per_update", "gbit_per_s", "publish_period_s", "updates_per_s"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ConfigError(f"--{name.replace('_', '-')}: got {value:g}, want more than 0")


@dataclass(frozen=True, kw_only=True, slots=True)
class Capacity:
    """The answer."""

    limits: dict[str, float]
    """what -> decisions/s that it allows; the smallest comes first"""
    updates_per_s: float
    """gradient steps that these decisions feed"""
    devices_wanted: int | None
    """that keep up with the actors; None: not known"""
    records_gbit_per_s: float
    """to the learner, as sent"""
    params_gbit_per_s: float
    """from the learner, to all hosts"""
    params_age_s: float
    """of the parameters that choose an action, on average"""
    params_max_age_s: float
    record_age_s: float
    """of a record when the learner gets it, at most: in a full ring, then under way"""
    host_memory_bytes: int
    host_shm_bytes: int
    """files of engines in /dev/shm"""
    learner_memory_bytes: int
    """with the replay, which is the device's where there is a GPU"""

    @property
    def first(self) -> str:
        """The limit that comes first."""
        return next(iter(self.limits))

    @property
    def decisions_per_s(self) -> float:
        """What the first limit allows."""
        return self.limits[self.first]


def capacity(ask: Cluster, costs: Costs) -> Capacity:
    """What the cluster does if nothing but these limits holds it back."""
    pack_s = costs.pack_s if ask.compress else 0.0
    record_bytes = ask.step_bytes + ask.frame_bytes / (costs.ratio if ask.compress else 1.0)
    bytes_per_s = ask.gbit_per_s * 1e9 / 8
    of_host = ask.cores / (costs.decision_s + pack_s)
    limits = {
        "actors": ask.hosts * of_host,
        "learner's core": 1 / (costs.ingest_s + (costs.unpack_s if ask.compress else 0.0)),
        "network": bytes_per_s / record_bytes,
    }
    if ask.updates_per_s is not None:
        limits["learner's devices"] = ask.devices * ask.updates_per_s * ask.env_steps_per_update
    limits = dict(sorted(limits.items(), key=lambda item: item[1]))
    decisions_per_s = min(limits.values())
    sending_s = ask.hosts * ask.params_bytes / bytes_per_s
    period_s = max(ask.publish_period_s, sending_s)  # the next publication waits for the last
    waiting = ask.cores * ask.ring_records + ask.credits * ask.batch_records
    num_games = ask.cores * ask.games_per_actor
    return Capacity(
        limits=limits,
        updates_per_s=decisions_per_s / ask.env_steps_per_update,
        devices_wanted=None
        if ask.updates_per_s is None
        else math.ceil(limits["actors"] / (ask.updates_per_s * ask.env_steps_per_update)),
        records_gbit_per_s=decisions_per_s * record_bytes * 8 / 1e9,
        params_gbit_per_s=ask.hosts * ask.params_bytes * 8 / 1e9 / period_s,
        params_age_s=sending_s + period_s / 2,
        params_max_age_s=sending_s + period_s,
        record_age_s=waiting * ask.hosts / decisions_per_s,
        host_memory_bytes=ask.cores * (ACTOR_MEMORY_BYTES + 2 * ask.params_bytes)
        + num_games * (ENGINE_MEMORY_BYTES + ENGINE_SHM_BYTES)
        + ask.credits * ask.batch_records * (ask.frame_bytes + ask.step_bytes),
        host_shm_bytes=num_games * ENGINE_SHM_BYTES,
        learner_memory_bytes=LEARNER_MEMORY_BYTES
        + ask.replay_bytes
        + ask.hosts * ask.credits * ask.batch_records * (ask.frame_bytes + ask.step_bytes),
    )
