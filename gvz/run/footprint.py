"""What a run will take, printed before it starts, and refused with advice when the machine has not got it."""

import shutil
from dataclasses import dataclass

from gvz.core import janitor
from gvz.core.errors import ResourceError
from gvz.run import machine

ENGINE_SHM_BYTES = 11_000_000
"""the engine's own shared files; measured 10.8 MB at every render size (vizdoom 1.3.2)"""
ENGINE_MEMORY_BYTES = 20_000_000
"""proportional set size of one engine and its client side, without shared files (measured 2026-11, x86-64)"""
ACTOR_MEMORY_BYTES = 270_000_000
"""proportional set size of an actor process with jax loaded (measured 2026-11, x86-64)"""
ASKING_ACTOR_MEMORY_BYTES = 50_000_000
"""likewise of an actor that asks for its actions, which loads no jax (measured 35 MB, 2026-11, x86-64)"""
LEARNER_MEMORY_BYTES = 700_000_000
"""proportional set size of the learner with its compiled programs, without replay (measured 2026-11, x86-64)"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Footprint:
    """Bytes and processes of a run."""

    replay_bytes: int
    """of the records on the learner's devices: the replay, or the rollout that is learnt from"""
    rollouts_bytes: int = 0
    """of windows of rollouts, which lie in the host's memory"""
    replay_on_host: bool
    """the devices' memory is the host's"""
    num_devices: int = 1
    """which learn, each with an equal part of the replay"""
    params_bytes: int
    num_actors: int
    actors_ask: bool = False
    """the learner's process chooses the actions: actors have neither jax nor parameters"""
    num_games: int
    transport_bytes: int
    """rings, and the parameter queue or the actors' requests"""
    placement: str
    """which cores the actors use, in words"""

    @property
    def shm_bytes(self) -> int:
        """What the engines take of /dev/shm. (What actors and learner share is anonymous memory, not files in it.)"""
        return self.num_games * ENGINE_SHM_BYTES

    @property
    def snapshot_bytes(self) -> int:
        """Host memory while a checkpoint is written: a second copy of the records and of the learner's state."""
        return (self.rollouts_bytes or self.replay_bytes) + 4 * self.params_bytes

    @property
    def device_bytes(self) -> int:
        """What each device needs at least, if it has memory of its own: its part of the replay, the learner's state."""
        return 0 if self.replay_on_host else self.replay_bytes // self.num_devices + 4 * self.params_bytes

    @property
    def memory_bytes(self) -> int:
        """Host memory in all, shared memory included."""
        return (
            LEARNER_MEMORY_BYTES
            + (self.replay_bytes + (self.num_devices - 1) * 4 * self.params_bytes if self.replay_on_host else 0)
            + self.rollouts_bytes
            + self.snapshot_bytes
            + self.num_actors
            * (ASKING_ACTOR_MEMORY_BYTES if self.actors_ask else ACTOR_MEMORY_BYTES + 2 * self.params_bytes)
            + self.num_games * ENGINE_MEMORY_BYTES
            + self.transport_bytes
            + self.shm_bytes
        )

    def lines(self) -> list[str]:
        """The footprint as a person reads it."""
        where = "host" if self.replay_on_host else "device"
        learner = "1 learner"
        if self.num_devices > 1:
            where = f"{self.num_devices} devices" + (" of the host" if self.replay_on_host else "")
            learner += f" on {self.num_devices} devices"
        shared = f"rings and {'requests' if self.actors_ask else 'parameter queue'}"
        kept = f"replay {format_bytes(self.replay_bytes)} ({where})"
        if self.rollouts_bytes:
            kept = (
                f"rollouts {format_bytes(self.rollouts_bytes)} (host) and {format_bytes(self.replay_bytes)} ({where})"
            )
        return [
            f"{kept}, checkpoint copy {format_bytes(self.snapshot_bytes)}",
            f"/dev/shm {format_bytes(self.shm_bytes)}, {shared} {format_bytes(self.transport_bytes)}, "
            f"host memory in all {format_bytes(self.memory_bytes)}",
            f"processes: {learner}, {self.num_actors} actors, {self.num_games} engines; {self.placement}",
        ]


def check(
    footprint: Footprint,
    *,
    shm_free: int | None = None,
    memory_free: int | None = None,
    device_free: int | None = None,
) -> None:
    """Refuses what does not fit.

    Args:
        footprint: of a run.
        shm_free: bytes in /dev/shm; by default they are read now.
        memory_free: bytes of memory; likewise.
        device_free: bytes of a device; None if that is not known, or no matter.

    Raises:
        ResourceError: says what is too small, by how much, and how to get it.
    """
    shm_free = shutil.disk_usage(janitor.SHM_DIR).free if shm_free is None else shm_free
    memory_free = machine.available_memory() if memory_free is None else memory_free
    if footprint.shm_bytes > shm_free:
        need = -(-footprint.shm_bytes // 2**20)
        raise ResourceError(
            f"shared memory: /dev/shm has {format_bytes(shm_free)} free, want {format_bytes(footprint.shm_bytes)}. "
            f"In Docker start with --shm-size={need}m; elsewhere `mount -o remount,size={need}m /dev/shm` as root; "
            "or lower --actors.games-per-actor."
        )
    if footprint.memory_bytes > memory_free:
        raise ResourceError(
            f"memory: {format_bytes(memory_free)} available, this run needs {format_bytes(footprint.memory_bytes)} "
            f"({'; '.join(footprint.lines())}). {_advice(footprint)}."
        )
    if device_free is not None and footprint.device_bytes > device_free:
        raise ResourceError(
            f"device memory: {format_bytes(device_free)} free, this run needs at least "
            f"{format_bytes(footprint.device_bytes)} on each device ({footprint.lines()[0]}). {_advice(footprint)}; or "
            "let JAX take more of the device than three quarters: XLA_PYTHON_CLIENT_MEM_FRACTION=0.95."
        )


def _advice(footprint: Footprint) -> str:
    records = "--learner.rollout-steps" if footprint.rollouts_bytes else "--replay.capacity"
    frame = "--env.frame-height, --env.frame-width, --env.grayscale"
    return f"Lower {records}, --actors.num-actors or the frame size ({frame})"


def format_bytes(count: float) -> str:
    """1.5 GB, in powers of ten."""
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.0f} {unit}"
        count /= 1000
    return f"{count:.2f} GB"
