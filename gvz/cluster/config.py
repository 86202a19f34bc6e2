"""Configuration of actor hosts."""

from dataclasses import dataclass
from typing import Annotated

from gvz.core.errors import ConfigError
from gvz.core.ranges import Range, check_ranges

MAX_HOSTS = 64
"""of one learner; its core is the limit long before, by the plan of docs/CLUSTER.md at two to five hosts of 16 cores"""


@dataclass(frozen=True, kw_only=True, slots=True)
class ClusterConfig:
    """Machines of a Ray cluster that play for this run. Times in seconds, sizes in step records."""

    address: str | None = None
    """HOST:PORT of the cluster's head; default: this machine plays, without a cluster"""
    public: bool = False
    """its nodes may have public addresses, because a firewall stands before them (docs/CLUSTER.md, Safety)"""
    hosts: Annotated[int, Range(0, MAX_HOSTS)] = 0
    """machines that play, each with actors.num_actors actors of actors.games_per_actor games; 0: this one alone"""
    min_hosts: int = 1
    """with fewer hosts that play, for patience_s, the run writes a checkpoint and ends with exit code 1"""
    cpus_per_host: Annotated[int | None, Range(0, 2**16)] = None
    """cores that Ray reserves for a host; default one an actor"""
    credits: Annotated[int, Range(1, 64)] = 2
    """batches of a host that may be under way or wait for the learner; more hide a slow network, and make records
    older"""
    batch_records: Annotated[int, Range(1, 2**16)] = 512
    """step records of a batch; a host that plays slowly sends fewer. With an on-policy agent at most a rollout of the
    host's games"""
    compress: bool = True
    """send frames compressed (zstd, level 1): two fifths of the bytes, for some 60 microseconds of processor time a
    frame of 84x84x3"""
    publish_period_s: float = 1.0
    """parameters go to the hosts at most this often"""
    silence_timeout_s: float = 30.0
    """a host that gives no answer for this time is replaced"""
    patience_s: float = 600.0
    """time that a run goes on with fewer than min_hosts hosts"""

    def __post_init__(self) -> None:
        check_ranges("cluster", self)
        if not 1 <= self.min_hosts <= max(1, self.hosts):
            raise ConfigError(f"cluster.min_hosts: got {self.min_hosts}, want 1..{max(1, self.hosts)}")
        for name, low in (("publish_period_s", 0.0), ("silence_timeout_s", 3.0), ("patience_s", 0.0)):
            if not getattr(self, name) >= low:
                raise ConfigError(f"cluster.{name}: got {getattr(self, name)}, want at least {low:g} seconds")
        if (self.address is None) != (self.hosts == 0):
            given, missing = ("hosts", "address") if self.hosts else ("address", "hosts")
            raise ConfigError(f"cluster.{given}: got {getattr(self, given)!r} without cluster.{missing}; give both")
