"""On which machine a host is started, and which machines are not tried any more."""

from collections import Counter
from collections.abc import Sequence

from gvz.cluster.backend import Backend, Machine
from gvz.cluster.config import ClusterConfig
from gvz.cluster.supervised import SupervisedHost
from gvz.core.errors import ConfigError

MAX_FAILED_STARTS = 3
"""hosts in a row that did not stay up on a machine; then it is set aside"""


class Placement:
    """The machines of a cluster, for the hosts of one run."""

    def __init__(self, backend: Backend, hosts: Sequence[SupervisedHost], config: ClusterConfig):
        self._backend, self._hosts, self._config = backend, hosts, config
        self._failed: Counter[str] = Counter()
        self.set_aside: set[str] = set()

    def cores(self, host: SupervisedHost) -> int:
        """That are reserved for a host."""
        cores = self._config.cpus_per_host
        return host.pool.num_actors if cores is None else cores

    def choose(self, host: SupervisedHost) -> Machine | None:
        """A machine with room: rather one without a host, not where this one ended last, not the learner's.

        Raises:
            HostError: the cluster does not say which there are.
        """
        taken = Counter(h.incarnation.machine for h in self._hosts if h.incarnation is not None)
        need = self.cores(host)
        machines = [m for m in self._backend.machines() if m.id not in self.set_aside]
        fitting = [m for m in machines if m.cpus >= need * (taken[m.id] + 1)]
        return min(fitting, key=lambda m: (taken[m.id], m.id == host.avoid, m.has_learner, m.name), default=None)

    def check_room(self) -> None:
        """Raises ConfigError: the machines have not the cores for `min_hosts` hosts."""
        need, machines = self.cores(self._hosts[0]), self._backend.machines()
        if need and sum(m.cpus // need for m in machines) < self._config.min_hosts:
            sizes = ", ".join(f"{m.name} {m.cpus}" for m in machines)
            raise ConfigError(
                f"cluster.hosts: got {len(self._hosts)} hosts of {need} cores each, but the cluster's nodes have "
                f"{sizes}; lower actors.num_actors or cluster.cpus_per_host, or add nodes"
            )

    def note_end(self, machine: str, *, was_stable: bool) -> bool:
        """A host has ended there. True if that sets the machine aside."""
        self._failed[machine] = 0 if was_stable else self._failed[machine] + 1
        if self._failed[machine] < MAX_FAILED_STARTS:
            return False
        self.set_aside.add(machine)
        return True
