"""The thread that speaks with the hosts: starts them, asks for batches, gives parameters, replaces what fails.

It alone uses the cluster, so that nothing of it can hold up or end the learner: what fails there is a fault of a host.
Batches are asked for under credits. A credit is free again when the learner has taken the batch, so its rate limiter
holds back the hosts, and these their actors.
"""

import contextlib
import secrets
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from gvz.cluster.backend import Backend, Call, HostError
from gvz.cluster.config import ClusterConfig
from gvz.cluster.hello import Hello, differences
from gvz.cluster.inbox import Inbox
from gvz.cluster.placement import MAX_FAILED_STARTS, Placement
from gvz.cluster.supervised import Incarnation, SupervisedHost
from gvz.cluster.wire import Batch, read_header, unpack
from gvz.core.errors import ConfigError, TransportError, WorkerError
from gvz.core.watchdog import AwakeClock
from gvz.transport.messages import Fault, ParamsHeader

_WAIT_S = 0.02
"""longest wait for an answer before the credits are looked at again"""
_LOOK_AGAIN_S = 1.0
"""until a host that found no machine looks again"""
_LONGEST_PAUSE_S = 1.0
"""most of a round that counts as a host's silence"""
_KEPT_VERSIONS = 1000
_Answer = Callable[[SupervisedHost, Incarnation, Any], None]


@dataclass(frozen=True, kw_only=True, slots=True)
class _Asked:
    """Whom a call was for, and what is done with its answer."""

    host: SupervisedHost
    life: Incarnation
    answer: _Answer


class Dispatcher:
    """See the module. `begin`, then `start` the thread; `stop` it before the backend is closed."""

    def __init__(self, backend: Backend, hosts: Sequence[SupervisedHost], config: ClusterConfig, ours: Hello):
        """`ours` is what the learner's machine says of itself."""
        self.inbox = Inbox()
        self._backend, self._hosts, self._config, self._ours = backend, hosts, config, ours
        self._run_id = secrets.token_hex(8)
        self._calls: dict[Call, _Asked] = {}
        self._placement = Placement(backend, hosts, config)
        self._forced: set[str] = set()  # machines on which a host was ended by force
        self._clock = AwakeClock(_LONGEST_PAUSE_S)
        self._enough_s = 0.0  # when enough hosts played last
        self._last_failure = ""
        self._published: tuple[ArrayLike, ParamsHeader] | None = None
        self._published_s: dict[int, float] = {}
        self._sent: tuple[Any, ParamsHeader] | None = None
        self._sent_s = 0.0
        self._stopping = False
        self._greeting = True  # before the run: what differs ends it
        self._thread = threading.Thread(target=self._run, name="gvz-cluster", daemon=True)

    def begin(self, timeout_s: float) -> None:
        """Waits until every host plays, or has failed to for good.

        Raises:
            ConfigError: a machine differs from this one, or has no room; fewer than `min_hosts` hosts came to play.
        """
        self._placement.check_room()
        start_s = time.monotonic()
        while not all(host.is_playing or self._gave_up(host) for host in self._hosts):
            if time.monotonic() - start_s > timeout_s:
                break
            self._round()
        if (playing := self.num_playing) < self._config.min_hosts:
            why = f"the last to fail: {self._last_failure}"
            if not self._last_failure:
                silent = (life.name for host in self._hosts if (life := host.incarnation) and life.playing_s is None)
                why = f"no answer yet from {', '.join(silent)}; do other jobs hold the cores there?"
            raise ConfigError(
                f"cluster.hosts: {playing} of {len(self._hosts)} hosts came to play within {timeout_s:.0f} s, want "
                f"at least cluster.min_hosts {self._config.min_hosts}; {why}"
            )
        self._greeting = False

    def start(self) -> None:
        """From now on the thread does the rounds."""
        self._enough_s = self._clock.look()
        self._thread.start()

    def stop(self, timeout_s: float) -> None:
        """Ends the thread, or leaves it behind if the cluster holds it."""
        self._stopping = True
        if self._thread.ident is not None:
            self._thread.join(timeout_s)

    def end_hosts(self, grace_s: float) -> None:
        """Ends every host, those that do not end in time by force, and cleans the machines where that was done."""
        lives = [host.incarnation for host in self._hosts if host.incarnation is not None]
        patience_s = 3 * grace_s
        with contextlib.suppress(HostError):
            closing = {
                life.remote.close(2 * grace_s): life for life in lives if grace_s > 0.0 and life.playing_s is not None
            }
            ended = self._ended_well(list(closing), patience_s)
            self._forced |= {life.machine for call, life in closing.items() if call not in ended}
        for life in lives:
            life.remote.kill()
        with contextlib.suppress(HostError):
            machines = sorted(self._forced) if grace_s > 0.0 else []
            self._ended_well([self._backend.clean(machine) for machine in machines], patience_s)

    def publish(self, params: ArrayLike, header: ParamsHeader) -> None:
        """Newest parameters; they go out with the next round that may send some."""
        self._published_s[header.version] = time.monotonic()
        self._published = params, header

    @property
    def num_playing(self) -> int:
        return sum(host.is_playing for host in self._hosts)

    def _run(self) -> None:
        try:
            while not self._stopping:
                self._round()
                self._watch()
        except WorkerError as error:
            with self.inbox.changed:
                self.inbox.failure = error
        except Exception as error:  # the boundary of the thread: the learner saves and ends
            failure = WorkerError(f"hosts: the thread that speaks with them failed: {type(error).__name__}: {error}")
            failure.__cause__ = error
            with self.inbox.changed:
                self.inbox.failure = failure

    def _round(self) -> None:
        self._clock.look()
        for host in self._hosts:
            if host.incarnation is None:
                self._start(host)
            elif host.is_playing:
                self._ask(host)
        self._put_params()
        self._receive()
        for host in self._hosts:
            self._check_silence(host)

    # ------------------------------------------------------------------------------------------- starting

    def _start(self, host: SupervisedHost) -> None:
        now_s = self._clock.now_s
        if now_s < host.start_at_s:
            return
        host.start_at_s = now_s + _LOOK_AGAIN_S
        try:
            if (machine := self._placement.choose(host)) is None:
                self._say_no_room(host)
                return
            remote = self._backend.start(machine.id, self._placement.cores(host))
        except HostError as error:
            self._last_failure = str(error)
            return
        host.waits_for_room = False
        number, host.num_lives = host.num_lives, host.num_lives + 1
        life = host.incarnation = Incarnation(
            number=number,
            machine=machine.id,
            name=machine.name,
            remote=remote,
            first_episodes=list(host.lanes.next_episodes),
            heard_s=now_s,
        )
        self._call(host, life, remote.greet(host.pool), self._greeted)

    def _say_no_room(self, host: SupervisedHost) -> None:
        """Once, until there is some."""
        if not host.waits_for_room:
            host.waits_for_room = True
            what = f"no node has room for {self._placement.cores(host)} cores"
            if aside := len(self._placement.set_aside):
                what += f" ({aside} set aside)"
            else:
                self._last_failure = what
            self._say("host_start", f"host {host.index} waits: {what}")

    def _greeted(self, host: SupervisedHost, life: Incarnation, answer: Any) -> None:
        theirs = msgspec.msgpack.decode(answer, type=Hello)
        if not self._greeting:  # files that were edited meanwhile: an actor restarted on one machine takes them, too
            theirs = msgspec.structs.replace(theirs, code=self._ours.code)
        problem = theirs.refusal
        if differing := differences(self._ours, theirs):
            problem = f"{differing[0]}; install the same on every node"
        if problem and self._greeting:
            raise ConfigError(f"cluster node {life.name}: {problem}")
        if problem:
            raise TransportError(problem)
        with self.inbox.changed:
            spec = host.spec(self._run_id, life.number)
            life.first_episodes = list(host.lanes.next_episodes)
            host.assigned.clear()  # they are in the spec
        self._call(host, life, life.remote.begin(spec), self._began)

    def _began(self, host: SupervisedHost, life: Incarnation, answer: Any) -> None:
        del host, answer
        life.playing_s = life.heard_s = self._clock.now_s

    def _gave_up(self, host: SupervisedHost) -> bool:
        """The run begins without it."""
        return host.incarnation is None and (host.waits_for_room or host.num_lives >= MAX_FAILED_STARTS)

    # ------------------------------------------------------------------------------------------- flow

    def _ask(self, host: SupervisedHost) -> None:
        """Uses the free credits, and gives the newest parameters."""
        life = host.incarnation
        assert life is not None
        try:
            while host.free_credits > 0:
                with self.inbox.changed:
                    assigned, host.assigned = host.assigned, []
                if not life.num_asked:
                    life.heard_s = self._clock.now_s
                self._call(host, life, life.remote.next_batch(assigned), self._take)
                life.num_asked += 1
            if self._sent is not None and not life.taking_params and life.params_version < self._sent[1].version:
                life.taking_params, life.params_version = True, self._sent[1].version
                life.params_asked_s = self._clock.now_s
                self._call(host, life, life.remote.set_params(*self._sent), self._took_params)
        except HostError as error:
            self._discard(host, "host_died", str(error))

    def _put_params(self) -> None:
        """At most once a period: the newest parameters -> the cluster."""
        if self._published is None or not any(host.is_playing for host in self._hosts):
            return
        params, header = self._published
        due = self._sent is None or time.monotonic() - self._sent_s >= self._config.publish_period_s
        if due and (self._sent is None or header.version > self._sent[1].version):
            try:
                self._sent, self._sent_s = (self._backend.put(np.asarray(params)), header), time.monotonic()
            except HostError as error:  # the next round tries again
                self._last_failure = str(error)
            for version in list(self._published_s)[:-_KEPT_VERSIONS]:
                del self._published_s[version]

    def _took_params(self, host: SupervisedHost, life: Incarnation, answer: Any) -> None:
        del host, answer
        life.taking_params = False

    def _receive(self) -> None:
        if not self._calls:
            time.sleep(_WAIT_S)
            return
        try:
            ended = self._backend.wait(list(self._calls), _WAIT_S)
        except HostError as error:  # while this lasts, hosts are silent
            self._last_failure = str(error)
            time.sleep(_WAIT_S)
            return
        for call in ended:
            asked = self._calls.pop(call)
            host, life = asked.host, asked.life
            try:
                answer = self._backend.result(call)
            except HostError as error:
                if host.incarnation is life:
                    self._discard(host, "host_died" if life.playing_s is not None else "host_start", str(error))
                continue
            if host.incarnation is not life:
                self._drop(host, life, answer)
                continue
            life.heard_s = self._clock.now_s
            try:
                asked.answer(host, life, answer)
            except (TransportError, msgspec.MsgspecError) as error:
                self._discard(host, "host_answer", str(error))

    def _take(self, host: SupervisedHost, life: Incarnation, answer: Any) -> None:
        life.num_asked -= 1
        came = unpack(answer, host.pool.record_dtype, host.pool.frame_shape, self._config.batch_records)
        with self.inbox.changed:
            batches = host.in_order(came, self._run_id)
            for batch in batches:
                host.take(batch)
                self.inbox.messages += batch.messages
                if len(batch):
                    self.inbox.batches.append((host, batch.block))
                    host.waiting_batches += 1
                    host.params_age_s = self._params_age_s(batch)
            self.inbox.counts.update(received_bytes=len(answer))
            self.inbox.changed.notify_all()
        if batches and (failure := batches[-1].header.failure):
            self._discard(host, "host_failed", failure)

    def _params_age_s(self, batch: Batch) -> float:
        """Mean time since the publication of the parameters that chose the actions.

        Versions that are not known any more count as the oldest known one: they are at least as old.
        """
        now_s, published_s = time.monotonic(), self._published_s
        versions, counts = np.unique(batch.block.steps["params_version"], return_counts=True)
        oldest_s = min(published_s.values(), default=now_s)
        ages = [now_s - published_s.get(version, oldest_s) for version in versions.tolist()]
        return float(np.average(ages, weights=counts))

    # ------------------------------------------------------------------------------------------- faults

    def _check_silence(self, host: SupervisedHost) -> None:
        life, limit_s = host.incarnation, self._config.silence_timeout_s
        if life is None:
            return
        silent_s, taking_s = self._clock.now_s - life.heard_s, self._clock.now_s - life.params_asked_s
        if not host.is_playing:
            if silent_s > (start_s := host.pool.actors.start_timeout_s):
                what = f"gave no answer for {silent_s:.0f} s (actors.start_timeout_s {start_s:g}) while it was started"
                self._discard(host, "host_start", what)
        elif life.num_asked and silent_s > limit_s:
            what = f"gave no sign of life for {silent_s:.1f} s (cluster.silence_timeout_s {limit_s:g})"
            self._discard(host, "host_silent", what)
        elif life.taking_params and taking_s > limit_s:
            what = (
                f"did not take parameters for {taking_s:.1f} s (cluster.silence_timeout_s {limit_s:g}); can it reach "
                "the learner's ports? See gvz cluster doctor"
            )
            self._discard(host, "host_silent", what)

    def _discard(self, host: SupervisedHost, kind: str, what: str) -> None:
        """Ends an incarnation; what it still sends is dropped. Its lanes go on with new episodes, elsewhere."""
        life, now_s = host.incarnation, self._clock.now_s
        assert life is not None
        with self.inbox.changed:
            cut = host.end(now_s)
            self.inbox.counts.update(host_restarts=1, cut_episodes=cut)
        life.remote.kill()
        self._forced.add(life.machine)
        self._last_failure = f"{life.name}: {_first_line(what)}"
        wait_s = host.start_at_s - now_s
        message = (
            f"host {host.index} on {life.name} {_first_line(what)}; {cut} episodes cut, replaced in {wait_s:.1f} s"
        )
        self._say(kind, message, what)
        if self._placement.note_end(life.machine, was_stable=life.was_stable(now_s)):
            message = f"node {life.name} is set aside: {MAX_FAILED_STARTS} hosts in a row did not stay up there"
            self._say("node_set_aside", message)

    def _drop(self, host: SupervisedHost, life: Incarnation, answer: Any) -> None:
        """What an incarnation has sent after its end."""
        if not isinstance(answer, bytes):
            return
        with contextlib.suppress(TransportError):  # a greeting
            if count := read_header(answer)[0].num_records:
                with self.inbox.changed:
                    self.inbox.counts.update(dropped_records=count)
                message = f"host {host.index} on {life.name} came too late with {count} records, which were dropped"
                self._say("late_batch", message)

    def _watch(self) -> None:
        """Raises WorkerError: too few hosts have played for too long."""
        now_s, wanted = self._clock.now_s, self._config.min_hosts
        if self.num_playing >= wanted:
            self._enough_s = now_s
        elif (waited_s := now_s - self._enough_s) > self._config.patience_s:
            raise WorkerError(
                f"hosts: {self.num_playing} of {len(self._hosts)} play, want at least cluster.min_hosts {wanted}; "
                f"waited {waited_s:.0f} s (cluster.patience_s) for others. The last to fail: {self._last_failure}"
            )

    def _say(self, kind: str, message: str, details: str = "") -> None:
        with self.inbox.changed:
            self.inbox.messages.append(Fault(actor=-1, lane=None, kind=kind, message=message, traceback=details))

    def _call(self, host: SupervisedHost, life: Incarnation, call: Call, answer: _Answer) -> None:
        self._calls[call] = _Asked(host=host, life=life, answer=answer)

    def _ended_well(self, calls: Sequence[Call], timeout_s: float) -> list[Call]:
        """Those that have ended in time and said something true."""
        waiting, well, deadline_s = list(calls), list[Call](), time.monotonic() + timeout_s
        while waiting and time.monotonic() < deadline_s:
            for call in self._backend.wait(waiting, _WAIT_S):
                waiting.remove(call)
                with contextlib.suppress(HostError):
                    well += [call] if self._backend.result(call) else []
        return well


def _first_line(text: str) -> str:
    return next(iter(text.strip().splitlines()), "gave no reason")
