"""How the processes of one run act as one: they do the same gradient steps, stop after the same, save the same.

Gradients cross processes inside the train step (`learner.sharding`), which all must call equally often. Each call is
agreed upon before: a process proposes it when its own limiter allows it, and does it when all have. So none waits in
the device for another one that lacks records. A wish to stop is told to all at once; the next proposals then say so,
and all stop before the same step.
"""

import contextlib
import ipaddress
import signal
import socket
from collections.abc import Callable, Generator
from typing import Any

import jax

from gvz.cluster.nodes import source_digest
from gvz.core.addresses import require_private, resolve
from gvz.core.env_config import leaves
from gvz.core.errors import ConfigError, GvzError, WaitTimeoutError
from gvz.core.stop import StopRequest
from gvz.run import machine
from gvz.run.config import RunConfig
from gvz.run.link import Link
from gvz.run.relay import Forward, Relay, free_port, wait_for_listener
from learner.checkpoint import Restored

DECISION_WAIT_S = 0.02
"""longest wait for the others' proposals before the loop looks after its actors again"""
ANSWER_TIMEOUT_S = 1800.0
"""for reading and writing checkpoints"""
JAX_TIMEOUT_S = 120.0
"""for JAX in process 0 to listen, which takes a second on an idle core"""
FAILURE_WAIT_S = 5.0
"""for the news that a process is gone, after an error that this may have caused"""
_OWN = ("group.process_id", "run_dir", "name", "log.", "actors.")
"""fields that may differ between processes"""
_MUST_AGREE = ("gvizdoom", "jax", "jaxlib", "flax", "optax")
"""and Python, and our source files: each process works out the new parameters by itself"""
_PRIVATE = "the group asks nobody who connects for a token; want an address of a private network"


class Group:
    """The processes that train together: here a run of one process, which asks nobody. `Several` are more."""

    num_common_saved: int | None = None
    """gradient steps of the newest checkpoint that all have; None without others"""

    def stops(self, stop: StopRequest) -> bool:
        """All stop now, because of a signal to any of them; `stop` then has it, too."""
        return stop.requested

    def may_update(self, ready: bool, busy: bool, num_saved: int) -> bool:
        """All do a call of the train step now.

        Args:
            ready: this process can.
            busy: it is writing a checkpoint.
            num_saved: gradient steps of its newest whole checkpoint.
        """
        return True

    def may_save(self) -> bool:
        """No process was writing a checkpoint when the last call was agreed upon."""
        return True

    def restored(self, read: Callable[[int | None], Restored | None]) -> Restored | None:
        """The newest checkpoint that all have. `read(limit)` gives this process's newest of at most `limit` updates."""
        return read(None)

    def blamed(self) -> contextlib.AbstractContextManager[None]:
        """Within it, an error that a gone process has caused is raised as GroupError."""
        return contextlib.nullcontext()

    def leave(self) -> None:
        """All have done their work and go."""


class Several(Group):
    """One of several processes."""

    def __init__(self, config: RunConfig, say: Callable[[str], None]):
        """Waits for the other processes, and makes their devices known to each other. Before any other use of jax.

        Raises:
            ConfigError: the coordinator or this machine's own address is public or unknown, others cannot reach that
            address, or the processes differ in their configuration or their versions. WaitTimeoutError: some do not
            come.
        """
        group = config.group
        host, port = group.address
        coordinator = resolve(host, "group.coordinator")
        for address in coordinator:  # which of them is used is the libraries' matter
            require_private(address, "group.coordinator", _PRIVATE)
        _check_own_address(coordinator[0])
        self._process, self._num_processes = group.own_id, group.num_processes
        say(f"learner process {self._process} of {self._num_processes}: waiting for the others at {host}:{port}")
        versions = {**machine.versions(_MUST_AGREE), "the source files": source_digest()}
        hello: dict[str, Any] = {"config": _settings(config), "versions": versions}
        with contextlib.ExitStack() as opened:
            if self._process == 0:
                hello["port"] = self._listen(host, port, opened)
            self._link = Link((host, port), self._process, self._num_processes, hello)
            opened.callback(self._link.close)
            if (different := _difference(self._link.hellos)) is not None:
                with contextlib.suppress(GvzError):
                    self._link.gather("seen", None, FAILURE_WAIT_S, "to see that they differ")
                raise ConfigError(different)
            self._join_jax(host, self._link.hellos[0]["port"])
            self._opened = opened.pop_all()
        self._round, self._proposed, self._stopped, self._told, self._may_save = 0, False, False, False, True
        self.num_common_saved = 0

    def _listen(self, host: str, port: int, opened: contextlib.ExitStack) -> int:
        """Starts the relay, which ends with `opened`; returns a free port for JAX's coordinator."""
        try:
            relay = Relay((host, port), self._num_processes)
            opened.callback(relay.close)
            return free_port(host)
        except OSError as error:
            raise ConfigError(
                f"group.coordinator: process 0 cannot listen at {host}:{port} ({error.strerror}); want an address "
                "of this machine and a free port"
            ) from error

    def _join_jax(self, host: str, port: int) -> None:
        if self._process > 0:  # JAX would wait for minutes, and then end this process with a page of C++
            try:
                wait_for_listener((host, port), JAX_TIMEOUT_S)
            except OSError as error:
                raise WaitTimeoutError(
                    f"group: waited {JAX_TIMEOUT_S:.0f} s for JAX's coordinator at {host}:{port}, a free port beside "
                    f"group.coordinator ({error.strerror or error}); let learner processes reach all ports of each "
                    "other's hosts"
                ) from error
        near = f"{host}:{port}" if self._process == 0 else f"127.0.0.1:{Forward((host, port)).port}"
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        jax.distributed.initialize(
            near,
            self._num_processes,
            self._process,
            cluster_detection_method="deactivate",
            coordinator_bind_address=f"{host}:{port}",
        )
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))  # JAX has taken it, for preemptions

    def stops(self, stop: StopRequest) -> bool:
        if stop.requested and not self._told:
            self._link.send("stop", stop.signal)
            self._told = True
        if self._stopped:
            stop.signal = stop.signal or self._link.stop_signal
        elif self._link.stop_signal is not None and not self._proposed:
            self._propose(stops=True)
        return self._stopped

    def may_update(self, ready: bool, busy: bool, num_saved: int) -> bool:
        self._link.check()
        if ready and not self._proposed:
            self._propose(busy=busy, num_saved=num_saved)
        if not self._proposed:
            return False
        proposals = self._link.values("propose", self._round, DECISION_WAIT_S)
        if proposals is None:
            return False
        self._round, self._proposed = self._round + 1, False
        self._stopped = any(proposal["stops"] for proposal in proposals)
        if self._stopped:
            return False
        self._may_save = not any(proposal["busy"] for proposal in proposals)
        self.num_common_saved = min(proposal["num_saved"] for proposal in proposals)
        return True

    def _propose(self, *, stops: bool = False, busy: bool = False, num_saved: int = 0) -> None:
        self._proposed = True
        self._link.send("propose", {"stops": stops, "busy": busy, "num_saved": num_saved}, self._round)

    def may_save(self) -> bool:
        return self._may_save

    def restored(self, read: Callable[[int | None], Restored | None]) -> Restored | None:
        """As `Group.restored`.

        Raises:
            CheckpointError: one process has lost its checkpoints.
        """
        limit = None
        while True:
            found = read(limit)
            steps = self._link.gather(
                "checkpoint", 0 if found is None else found.num_updates, ANSWER_TIMEOUT_S, "to read its checkpoint"
            )
            if len(set(steps)) == 1:
                return found
            limit = min(steps)
            del found

    @contextlib.contextmanager
    def blamed(self) -> Generator[None]:
        try:
            yield
        except Exception:
            self._link.wait_for_failure(FAILURE_WAIT_S)
            raise

    def leave(self) -> None:
        self._link.gather("done", None, ANSWER_TIMEOUT_S, "to write its last checkpoint")
        jax.distributed.shutdown()
        self._opened.close()


def join(config: RunConfig, say: Callable[[str], None]) -> Group:
    """The group of this process, once all are there.

    Raises:
        ConfigError, WaitTimeoutError: as `Several`.
    """
    return Group() if config.group.num_processes == 1 else Several(config, say)


def _check_own_address(coordinator: str) -> None:
    """Refuses a machine whose own name has an address where the others cannot or must not come: JAX's transport of
    gradients between CPUs listens there, and tells the others so.
    """
    name = socket.gethostname()
    where = f"group: own host name {name!r}"
    own = resolve(name, where)
    for address in own:
        require_private(address, where, f"{_PRIVATE}, which /etc/hosts can give to {name}")
    if ipaddress.ip_address(own[0]).is_loopback and not ipaddress.ip_address(coordinator).is_loopback:
        raise ConfigError(
            f"{where}: got {own[0]}, where other machines find only themselves, want an address of a private network; "
            f"change the line of {name} in /etc/hosts, or begin group.coordinator with 127.0.0.1 if all processes are "
            "on this machine"
        )


def _settings(config: RunConfig) -> dict[str, str]:
    """What must be the same in all processes, by name."""
    return {name: repr(value) for name, value in leaves(config) if not name.startswith(_OWN)}


def _difference(hellos: list[dict[str, Any]]) -> str | None:
    """What is not the same in all processes, in words."""
    first = hellos[0]
    for process, hello in enumerate(hellos):
        for part, what in (("versions", "the version of "), ("config", "")):
            for name in {**first[part], **hello[part]}:
                one, other = first[part].get(name), hello[part].get(name)
                if one != other:
                    return (
                        f"group: {what}{name} is {one} in learner process 0 and {other} in {process}; want it the same"
                    )
    return None
