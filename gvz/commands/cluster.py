"""`gvz cluster plan | doctor`: what a cluster would give, and whether one that is there is fit for it."""

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from gvz.core.errors import ConfigError

if TYPE_CHECKING:
    from gvz.cluster.plan import Capacity, Cluster, Costs
    from gvz.run.config import RunConfig


@dataclass(frozen=True, kw_only=True)
class PlanCluster:
    """Print what actor hosts would give a learner: decisions/s, network, memory, age of parameters, the first limit.

    Example: gvz cluster plan --hosts 4 --cores 16 --updates-per-s 5000
    """

    hosts: int
    """machines that play"""
    cores: int
    """cores of each host; actors use all of them"""
    config: str = "rainbow_4task"
    """config file with the size of frames, the network and the replay"""
    gbit_per_s: float = 10.0
    """network of the learner's host, each way"""
    devices: int = 1
    """GPUs or other devices of the learner"""
    updates_per_s: float | None = None
    """gradient steps of one device (learner/updates_per_s of a run's metrics); without it the devices limit nothing"""
    publish_period_s: float = 1.0
    """seconds between publications of parameters"""
    compress: bool = True
    """frames travel compressed; --no-compress: as they are"""
    measure: bool = False
    """measure this machine first (half a minute, best when it is idle), instead of taking constants of records"""
    json: bool = False
    """one JSON object instead of a table"""

    def run(self) -> int:
        """Prints the plan."""
        from gvz.cluster.plan import RECORDED, capacity
        from gvz.run.config_files import load_config

        config = load_config(self.config)
        if config.agent.on_policy:
            raise ConfigError(
                f"--config: got {self.config}, whose agent {config.agent.name} learns on-policy; the plan is for "
                "agents that learn from a replay"
            )
        ask = self._cluster(config)
        if self.measure:
            from gvz.cluster.measure import measure

            costs = measure(config)
        else:
            costs = RECORDED
        answer = capacity(ask, costs)
        if self.json:
            print(json.dumps({**dataclasses.asdict(answer), "first": answer.first, "costs": dataclasses.asdict(costs)}))
        else:
            print("\n".join(_lines(ask, answer, costs)))
            if config.actors.inference == "device":
                print(f"{'note':15} hosts play only with --actors.inference actors; {self.config} has device")
        return 0

    def _cluster(self, config: "RunConfig") -> "Cluster":
        import math

        from gvz.cluster.plan import Cluster
        from gvz.run.assemble import assemble
        from gvz.run.config import off_policy

        parts = assemble(config, Path())  # nothing is started
        return Cluster(
            hosts=self.hosts,
            cores=self.cores,
            games_per_actor=config.games_per_actor,
            frame_bytes=math.prod(config.env.frame_shape),
            step_bytes=parts.pool_config.record_dtype.itemsize,
            params_bytes=parts.footprint.params_bytes,
            replay_bytes=parts.footprint.replay_bytes,
            env_steps_per_update=off_policy(config)[0].env_steps_per_update,
            ring_records=config.actors.ring_capacity,
            batch_records=config.cluster.batch_records,
            credits=config.cluster.credits,
            gbit_per_s=self.gbit_per_s,
            publish_period_s=self.publish_period_s,
            compress=self.compress,
            devices=self.devices,
            updates_per_s=self.updates_per_s,
        )


@dataclass(frozen=True, kw_only=True)
class ClusterDoctor:
    """Check every node of a cluster: versions, cores, shared memory, clock, ports, token, a shared directory.

    Exit code 1 if something is wrong with a node, 2 if the cluster cannot be entered.
    """

    address: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="HOST:PORT", help_behavior_hint="")]
    """the head"""
    shared: Path | None = None
    """check this directory, too: each node must see its files, and the locks that other nodes hold in it"""
    public: bool = False
    """its nodes may have public addresses"""
    json: bool = False
    """one JSON object a line instead of a table"""

    def run(self) -> int:
        """Prints the findings."""
        from gvz.cluster.checkup import findings
        from gvz.run import doctor, shared_directory

        if self.shared is not None:
            shared_directory.require_directory(self.shared)
        return doctor.show(findings(self.address, self.shared, public=self.public), json_lines=self.json)


@dataclass(frozen=True, kw_only=True)
class ClusterCommand:
    """Plan a cluster of actor hosts on paper, or check one that is there."""

    action: Annotated[
        Annotated[PlanCluster, tyro.conf.subcommand("plan")] | Annotated[ClusterDoctor, tyro.conf.subcommand("doctor")],
        tyro.conf.arg(name=""),
    ]

    def run(self) -> int:
        """Runs the action; returns its exit code."""
        return self.action.run()


COMMAND = ClusterCommand


def _lines(ask: "Cluster", answer: "Capacity", costs: "Costs") -> list[str]:
    """The plan as a person reads it."""
    from gvz.run.footprint import format_bytes

    frames = f"{ask.frame_bytes:,} bytes a frame"
    sent = f"{frames}, 1/{costs.ratio:.2f} of it compressed" if ask.compress else frames
    limits = [f"{'' if n else 'first: '}{what} {rate:,.0f}" for n, (what, rate) in enumerate(answer.limits.items())]
    wanted = "" if answer.devices_wanted is None else f"; {answer.devices_wanted} devices keep up with the actors"
    return [
        f"{'decisions/s':15} {answer.decisions_per_s:,.0f}",
        f"{'limits':15} {', '.join(limits)}",
        f"{'gradient steps':15} {answer.updates_per_s:,.0f}/s, of {ask.env_steps_per_update:g} decisions each{wanted}",
        f"{'network':15} {answer.records_gbit_per_s:.2f} Gbit/s of records to the learner ({sent}), "
        f"{answer.params_gbit_per_s:.2f} of parameters from it ({format_bytes(ask.params_bytes)} a host)",
        f"{'parameters':15} {answer.params_age_s:.2f} s old on average, {answer.params_max_age_s:.2f} s at most; "
        f"a record is under way for {answer.record_age_s:.2f} s at most",
        f"{'memory':15} {format_bytes(answer.learner_memory_bytes)} for the learner and its replay; of each host "
        f"{format_bytes(answer.host_memory_bytes)}, {format_bytes(answer.host_shm_bytes)} of it in /dev/shm",
        f"{'constants':15} {costs.decision_s * 1e6:,.0f} us a decision, {costs.pack_s * 1e6:.0f} to compress a frame; "
        f"{costs.unpack_s * 1e6:.0f} to decompress it, {costs.ingest_s * 1e6:.1f} into the replay",
        f"{'':15} {costs.source}",
    ]
