"""Actor hosts on a Ray cluster of this machine: `python ray_hosts.py NODES FRAMES.npy NUM_PARAMS`.

The games sleep for a while at each decision, as engines on other machines would let this one, or not at all, and show
frames that a real engine has drawn. What they play is without meaning; how it comes to the learner is what a run does.
"""

import contextlib
import os
import secrets
import shutil
import signal
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import psutil
from serve import serve

STORE_BYTES = 400_000_000
GAMES, EPISODE_STEPS = 4, 300
_SETTLE_S = 2.0
_PUBLISH_S = 0.1
_TIMEOUT_S = 200.0


class Shown(gymnasium.Env[np.ndarray, int]):
    """Shows stored frames."""

    def __init__(self, task: str, options: dict[str, Any]):
        self._frames = np.load(options["frames"])
        self._step_s, self._at, self._steps = options["step_s"], 0, 0
        self.action_space = gymnasium.spaces.Discrete(3)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self._steps = 0
        return self._frames[self._at], self._info()

    def step(self, action: int) -> Any:
        time.sleep(self._step_s)
        self._steps, self._at = self._steps + 1, (self._at + 1) % len(self._frames)
        return self._frames[self._at], 1.0, self._steps >= EPISODE_STEPS, False, self._info()

    def _info(self) -> dict[str, Any]:
        seed = {"score": 0.0, "normalized_score": 0.0, "reward_components": {}, "variables": {}, "episode_seed": 0}
        return {**seed, "episode_frames": 4 * self._steps}


def shown(task: str, options: dict[str, Any]) -> Shown:
    """The entry point of the actors."""
    return Shown(task, options)


class Bench:
    """The cluster, and pools on it, one after the other."""

    def __init__(self, num_nodes: int, frames: str, num_params: int):
        self.directory = Path(tempfile.mkdtemp(prefix="gr-"))  # its sockets' paths must be short
        (self.directory / "ray").mkdir()
        os.environ.update(
            RAY_TMPDIR=str(self.directory),
            RAY_USAGE_STATS_ENABLED="0",
            RAY_AUTH_MODE="token",
            RAY_AUTH_TOKEN=secrets.token_hex(16),
            PYTHONPATH=os.pathsep.join([os.environ["PYTHONPATH"], str(Path(__file__).parent)]),
        )
        import ray
        from ray.cluster_utils import Cluster

        small: dict[str, Any] = {"include_dashboard": False, "object_store_memory": STORE_BYTES}
        self._frames, self._params = frames, np.zeros(num_params, np.float32)
        self._cluster = Cluster(initialize_head=True, head_node_args={**small, "num_cpus": 0})
        for _ in range(num_nodes):
            self._cluster.add_node(**small, num_cpus=1)
        ray.init(self._cluster.address, namespace="gvizdoom", log_to_driver=False, logging_level=50)

    def close(self) -> None:
        """Ends everything."""
        import ray

        ray.shutdown()
        self._cluster.shutdown()
        shutil.rmtree(self.directory)

    def play(self, hosts: int, compress: bool, step_s: float, seconds: float, kill: bool) -> dict[str, Any]:
        """Plays for a while; returns counts, processor seconds by kind of process, ages, and the time of recovery."""
        from gvz.cluster.config import ClusterConfig
        from gvz.cluster.pool import ClusterPool
        from gvz.cluster.ray_hosts import RayBackend

        config = self._pool_config(hosts, step_s)
        cluster = ClusterConfig(address=self._cluster.address, hosts=hosts, compress=compress)
        with ClusterPool(config, cluster, RayBackend(contextlib.ExitStack()), None) as pool:
            play = Playing(pool, self._params, config.layout_hash)
            play.until(lambda: pool.statistics().actors_ready == hosts)
            play.during(min(_SETTLE_S, seconds))
            before, bytes_before, records_before = processor_s(), play.received_bytes, play.num_records
            start = time.perf_counter()
            play.during(seconds)
            used_s = {kind: value - before[kind] for kind, value in processor_s().items()}
            return {
                "count": play.num_records - records_before,
                "seconds": time.perf_counter() - start,
                "processor_s": used_s,
                "bytes": play.received_bytes - bytes_before,
                "params_age_s": float(np.mean(play.ages_s)),
                **(play.recover() if kill else {}),
            }

    def _pool_config(self, hosts: int, step_s: float) -> Any:
        import jax
        import jax.export
        import jax.numpy as jnp

        from actors.config import ActorsConfig
        from actors.pool import PoolConfig
        from actors.preprocess import ObservationBatch

        def act(leaves: Any, observation: Any, key: Any, epsilon: Any) -> Any:
            del observation, key, epsilon
            return leaves[0][:GAMES].astype("int32"), jnp.zeros((GAMES, 0))

        shape = np.load(self._frames, mmap_mode="r").shape[1:]
        config = PoolConfig(
            tasks=("shown",),
            num_actors=hosts,
            games_per_actor=GAMES,
            seed=1,
            env_entry_point="ray_hosts:shown",
            env_config={"frames": self._frames, "step_s": step_s},
            frame_shape=shape,
            stack_size=4,
            num_actions=3,
            policy=b"-",
            num_params=len(self._params),
            layout_hash=1,
            actors=ActorsConfig(placement="free"),
            work_dir=self.directory / "work",
        )
        arrays = ObservationBatch.of(config, GAMES).arrays
        exported = jax.export.export(jax.jit(act), platforms=["cpu"])(
            [jax.ShapeDtypeStruct(self._params.shape, jnp.float32)],
            {name: jax.ShapeDtypeStruct(array.shape, array.dtype) for name, array in arrays.items()},
            jax.ShapeDtypeStruct((2,), jnp.uint32),
            jax.ShapeDtypeStruct((), jnp.float32),
        )
        import msgspec

        return msgspec.structs.replace(config, policy=bytes(exported.serialize()))


class Playing:
    """A pool that is drained, and gets new parameters all the time."""

    def __init__(self, pool: Any, params: np.ndarray, layout_hash: int):
        self._pool, self._params, self._layout_hash = pool, params, layout_hash
        self.num_records, self._version, self._published_s = 0, 0, 0.0
        self.ages_s: list[float] = []
        self.lanes: list[int] = []
        """with an episode that has just begun"""

    @property
    def received_bytes(self) -> float:
        return self._pool.statistics().more["cluster/received_bytes"]

    def round(self) -> None:
        from gvz.transport.messages import ParamsHeader

        now_s = time.perf_counter()
        if now_s - self._published_s >= _PUBLISH_S:
            self._version, self._published_s = self._version + 1, now_s
            header = ParamsHeader(version=self._version, num_updates=self._version, layout_hash=self._layout_hash)
            self._pool.publish(self._params, header)
        for block in self._pool.drain(256, wait_s=0.02):
            self.num_records += len(block)
            self.ages_s.append(self._pool.statistics().more["cluster/params_age_s"])
        self._pool.poll()

    def during(self, seconds: float) -> None:
        start_s = time.perf_counter()
        while time.perf_counter() - start_s < seconds:
            self.round()

    def until(self, done: Any) -> None:
        start_s = time.perf_counter()
        while not done():
            if time.perf_counter() - start_s > _TIMEOUT_S:
                raise TimeoutError(f"hosts: waited {_TIMEOUT_S:.0f} s")
            self.round()

    def recover(self) -> dict[str, float]:
        """Kills a host: seconds until that is noticed, and until its successor's first records."""
        before = self._pool.statistics().more
        victim = next(p for p in psutil.Process().children(recursive=True) if kind_of(p) == "host")
        start_s = time.perf_counter()
        victim.send_signal(signal.SIGKILL)
        self.until(lambda: self._pool.statistics().more["cluster/host_restarts"] > before["cluster/host_restarts"])
        noticed_s = time.perf_counter() - start_s
        hosts = before["cluster/hosts"]
        self.until(lambda: self._pool.statistics().more["cluster/hosts"] == hosts)
        self.until(lambda: self._pool.statistics().actors_ready == hosts)
        return {"noticed_s": noticed_s, "recovered_s": time.perf_counter() - start_s}


def kind_of(process: psutil.Process) -> str:
    """host, learner, Ray, or actor."""
    try:
        words = " ".join(process.cmdline())
    except psutil.Error:
        return "actor"
    if "RemoteHost" in words:
        return "host"
    return "Ray" if any(name in words for name in ("raylet", "gcs_server")) else "actor"


def processor_s() -> dict[str, float]:
    """Seconds so far of hosts, of Ray's daemons, and of this process, which is the learner's."""
    found = {"host": 0.0, "Ray": 0.0, "learner": time.process_time(), "actor": 0.0}
    for process in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error):
            found[kind_of(process)] += sum(process.cpu_times()[:2])
    return found


def main() -> None:
    num_nodes, frames, num_params = sys.argv[1:]
    bench = Bench(int(num_nodes), frames, int(num_params))
    ended = False

    def body(**arguments: Any) -> dict[str, Any]:
        nonlocal ended
        if arguments:
            return bench.play(**arguments)
        bench.close()
        ended = True
        return {}

    try:
        serve(body, "ray", "zstandard")
    finally:
        if not ended:
            bench.close()


if __name__ == "__main__":
    main()
