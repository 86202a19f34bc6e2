"""The workers of a vector environment: started, watched, replaced when they die, ended."""

import os
import select
import tempfile
from collections import deque
from collections.abc import Sequence
from typing import IO, Any

import msgspec
from gymnasium.error import ClosedEnvironmentError

from gvz.core import errors, janitor
from gvz.core.errors import GvzError, TransportError, WorkerError
from gvz.core.watchdog import AwakeClock
from gvz.transport.child import ChildProcess, end_all
from gvz.transport.messages import Decision, Decisions, Fault, Message, Outcome, Outcomes, Render, Screen, VectorSpec
from gvz.vector.frames import Frames

SILENCE_TIMEOUT_S = 240.0
"""a worker that does not finish one decision in this time is replaced. Three attempts to start an engine take 180 s"""
_POLL_S = 1.0
_DUMP_S = 0.5
"""time given to a stuck worker to write its stacks before it is killed"""
_STOP_TIMEOUT_S = 10.0
_MAX_DEATHS = 3
"""of a worker in a row, without a complete episode in between; one more is an error"""
_LOG_TAIL_BYTES = 4000


class _Worker:
    """A worker over the lives of its processes."""

    def __init__(self, spec: VectorSpec, descriptor: int):
        self.spec = spec
        self.pending: dict[int, Decision] = {}
        """by game: sent and not answered"""
        self.deaths = 0
        self._descriptor = descriptor
        self._log: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115  has no name; closed in `close`
        self.start()

    def start(self) -> None:
        """Starts a process; does not wait for it."""
        who = f"worker {self.spec.worker}"
        inherited = [self._descriptor]
        self.process = ChildProcess("gvz.vector.worker", who, self.spec, inherited=inherited, log=self._log)
        self.progress, self.clock = 0, AwakeClock(2 * _POLL_S)

    def send(self, decisions: list[Decision]) -> None:
        if not self.pending:
            self.clock = AwakeClock(2 * _POLL_S)  # it was idle until now
        self.pending |= {decision.game: decision for decision in decisions}
        self.process.channel.send(Decisions(decisions=decisions))

    def silent_s(self, progress: int) -> float:
        """Seconds since it finished a decision, or since it was given one."""
        if progress != self.progress:
            self.progress, self.clock = progress, AwakeClock(2 * _POLL_S)
        return self.clock.look()

    def log_tail(self) -> str:
        size = os.fstat(self._log.fileno()).st_size
        tail = os.pread(self._log.fileno(), _LOG_TAIL_BYTES, max(0, size - _LOG_TAIL_BYTES)).decode(errors="replace")
        return f". The end of its output:\n{tail.strip()}" if tail.strip() else ""

    def close(self) -> None:
        self._log.close()


class Crew:
    """Takes decisions, gives outcomes. A worker that dies is replaced; to its games this is a crash of the engine:

    - A decision in the middle of an episode has the outcome `truncated`, reward 0, the last observation once more, and
      `engine_crash` and `engine_error` in its info.
    - The beginning of an episode is tried again, with these two in its info.
    """

    def __init__(self, specs: Sequence[VectorSpec], frames: Frames):
        """Starts the processes; does not wait for them."""
        self._frames = frames
        self.owner_pid = os.getpid()
        self._outcomes: deque[Outcome] = deque()
        self._last_infos: dict[int, dict[str, Any]] = {}
        self._final_infos: dict[int, dict[str, Any]] = {}
        """of games whose episode was lost with their worker, until the next one has begun"""
        self._begin_errors: dict[int, str] = {}
        """by game: how the worker died that was to begin its episode"""
        self._lost: dict[int, str] = {}
        """by game: how its worker died while the game waited for a decision"""
        self._workers: list[_Worker] = []
        self._worker_of: dict[int, _Worker] = {}
        try:
            for spec in specs:
                worker = _Worker(spec, frames.descriptor)
                self._workers.append(worker)
                self._worker_of |= dict.fromkeys(spec.games, worker)
        except BaseException:
            self.close()
            raise

    @property
    def num_pending(self) -> int:
        """Decisions whose outcome was not taken yet."""
        return len(self._outcomes) + sum(len(worker.pending) for worker in self._workers)

    @property
    def pids(self) -> list[int]:
        """Process ids of the workers."""
        return [worker.process.pid for worker in self._workers]

    def send(self, decisions: Sequence[Decision]) -> None:
        """Hands decisions to the workers of their games; each game's last one has been answered."""
        for worker in self._workers:
            mine = []
            for decision in decisions:
                if self._worker_of[decision.game] is worker:
                    error = self._lost.pop(decision.game, None)
                    mine += [decision] if error is None else self._cut(decision, error)
            if mine:
                worker.send(mine)

    def receive(self, count: int) -> list[Outcome]:
        """The next `count` outcomes, in the order in which they come.

        Raises:
            ClosedEnvironmentError: `close` was called meanwhile.
            GvzError: what a worker raised.
            WorkerError: a worker died too often, or raised what is no error of ours.
        """
        assert count <= self.num_pending, "there are that many decisions to wait for"
        while len(self._outcomes) < count:
            self._wait()
            for worker in self._workers:
                self._hear(worker)
        return [self._outcomes.popleft() for _ in range(count)]

    def render(self) -> dict[int, bytes]:
        """The last rendered screen of every game, empty if its worker has died; no decision may be pending."""
        screens: dict[int, bytes] = {}
        for worker in self._workers:
            worker.process.channel.send(Render())
        for worker in self._workers:
            for game in worker.spec.games:
                try:
                    answer = worker.process.channel.wait_for_message()
                except TransportError:
                    if not worker.process.channel.closed:
                        raise
                    self._replace_dead(worker)
                    screens |= dict.fromkeys(worker.spec.games, b"")
                    break
                if not isinstance(answer, Screen):
                    raise _raised(worker, answer)
                screens[game] = answer.screen
        return screens

    def close(self) -> None:
        """Ends workers and engines. Can be repeated; does nothing in a fork of the process that made this."""
        if os.getpid() != self.owner_pid:
            return
        workers, self._workers = self._workers, []
        try:
            end_all([worker.process for worker in workers], _STOP_TIMEOUT_S)
        finally:
            for worker in workers:
                worker.close()
            self._frames.close()
            if workers:
                janitor.clean_dead_instances()

    def _wait(self) -> None:
        """Waits until a worker says something or has ended; replaces those that are stuck."""
        busy = [worker for worker in self._workers if worker.pending]
        if any(worker.process.channel.closed for worker in busy):
            return
        poll = select.poll()
        for worker in busy:
            poll.register(worker.process.channel, select.POLLIN)
        poll.poll(1000 * _POLL_S)
        self._require_open()
        for worker in busy:
            silent_s = worker.silent_s(int(self._frames.progress[worker.spec.worker]))
            if silent_s > SILENCE_TIMEOUT_S:
                worker.process.dump_stacks()
                worker.process.wait(_DUMP_S)
                self._replace(worker, f"finished no decision in {silent_s:.0f} s")

    def _hear(self, worker: _Worker) -> None:
        """Takes the outcomes that have come from a worker; replaces it if it has ended."""
        channel = worker.process.channel
        for message in channel.receive():
            if not isinstance(message, Outcomes):
                raise _raised(worker, message)
            for outcome in message.outcomes:
                del worker.pending[outcome.game]
                self._add(worker, outcome)
        if channel.closed and worker.pending:
            self._replace_dead(worker)

    def _add(self, worker: _Worker, outcome: Outcome) -> None:
        """One outcome more, with what happened to the game's last worker."""
        game, info = outcome.game, outcome.info
        if game in self._begin_errors:
            info = {**info, "engine_crash": True, "engine_error": self._begin_errors.pop(game)}
            outcome = msgspec.structs.replace(outcome, info=info)
        if game in self._final_infos:
            final_info = self._final_infos.pop(game)
            outcome = msgspec.structs.replace(outcome, truncated=True, final_info=final_info)
        elif outcome.terminated or outcome.truncated:
            worker.deaths = 0
        self._last_infos[game] = info
        self._outcomes.append(outcome)

    def _require_open(self) -> None:
        if not self._workers:  # a signal's handler or another thread has closed it while this call waited
            raise ClosedEnvironmentError("the vector environment was closed in the middle of a call")

    def _replace_dead(self, worker: _Worker) -> None:
        self._require_open()
        worker.process.wait(_STOP_TIMEOUT_S)
        self._replace(worker, worker.process.exit_text() or "closed its channel")

    def _replace(self, worker: _Worker, what: str) -> None:
        """Ends what is left of a worker, starts the next, and sees to the games that it had."""
        pending, worker.pending = worker.pending, {}
        what = f"worker {worker.spec.worker} (pid {worker.process.pid}) {what}"
        worker.process.end(grace_s=0.0)
        janitor.clean_dead_instances()
        worker.deaths += 1
        if worker.deaths > _MAX_DEATHS:
            raise WorkerError(
                f"vector environment: {what}; that was death {worker.deaths} of this worker without a whole episode "
                f"between{worker.log_tail()}"
            )
        worker.start()
        waiting = self._last_infos.keys() & set(worker.spec.games) - pending.keys()
        self._lost |= dict.fromkeys(waiting, what)
        if again := [one for decision in pending.values() for one in self._cut(decision, what)]:
            worker.send(again)

    def _cut(self, decision: Decision, error: str) -> list[Decision]:
        """Answers for a worker that died with the game's episode; returns what its successor is to do."""
        game = decision.game
        if decision.action is None:
            if game not in self._final_infos:
                self._begin_errors[game] = error
            return [decision]
        info = _crash_info(self._last_infos[game], error)
        self._frames.repeat(game, decision.half)
        if not self._frames.final:
            self._outcomes.append(Outcome(game, 0.0, False, True, info))
            return []
        self._frames.repeat_final(game, decision.half)
        self._final_infos[game] = info
        return [msgspec.structs.replace(decision, action=None)]


def _crash_info(last: dict[str, Any], error: str) -> dict[str, Any]:
    """The info of an episode that was cut after the step with the info `last`, as `DoomEnv` gives it."""
    return {
        **last,
        "reward_components": dict.fromkeys(last["reward_components"], 0.0),
        "engine_crash": True,
        "solved_episode": False,
        "engine_error": error,
    }


def _raised(worker: _Worker, message: Message) -> GvzError:
    """The error that a worker reported, or one about what it said instead of an answer."""
    who = f"vector environment: worker {worker.spec.worker}"
    if not isinstance(message, Fault):
        return WorkerError(f"{who}: got {type(message).__name__}, want Outcomes or Screen")
    if message.kind in ("EngineError", "ConfigError", "TaskError", "ResourceError"):
        return getattr(errors, message.kind)(f"{who}: {message.message}")
    return WorkerError(f"{who}: {message.kind}: {message.message}\n{message.traceback}")
