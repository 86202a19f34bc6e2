"""An actor process: `python -m actors.worker PARENT_PID SOCKET RING [SHARED]`, started by `actors/process.py`.

SOCKET, RING and SHARED are inherited file descriptors: its end of a socket, its ring, and the parameter queue or, if
the learner's process chooses its actions, its requests (absent for random play). The first message on the socket is an
`ActorSpec`; then the process acts until it receives `Stop`. Everything that goes wrong becomes a `Fault` message and a
non-zero exit.
"""

import contextlib
import os
import sys
import time
import traceback
from functools import partial

from actors.loop import ActorLoop
from actors.placement import keep_to
from actors.preprocess import ObservationBatch
from gvz.core.errors import EngineError, WaitTimeoutError
from gvz.core.watchdog import AwakeClock
from gvz.transport import child
from gvz.transport.broadcast import BroadcastReader
from gvz.transport.channel import Channel
from gvz.transport.inference import RequestWriter
from gvz.transport.messages import ActorSpec, Assign, Fault, Ready, Stop
from gvz.transport.ring import RingWriter, WriterState

SPACE_TIMEOUT_S = 3600.0
"""an actor ends when its learner reads nothing for this time (compiling, saving and pauses take far less)"""
PARAMS_TIMEOUT_S = 600.0
"""likewise for the first version of the parameters"""
ACTIONS_TIMEOUT_S = 3600.0
"""likewise for the actions, if the learner chooses them (its first parameters and its compilation take far less)"""
MAX_PARAMS_SHARE = 0.05
"""share of an actor's time that may go into taking parameters (27 MB: 20 ms), however often they are published"""


class Worker:
    """The life of an actor process after its spec has come."""

    def __init__(self, spec: ActorSpec, channel: Channel, ring: int, shared: int | None):
        """`ring` and `shared`, the parameter queue or the requests, are file descriptors; they stay the caller's."""
        self._spec = spec
        self._channel = channel
        self._ring = RingWriter.attach(ring, spec.ring_capacity, spec.frame_shape, spec.record_dtype)
        self._params: BroadcastReader | None = None
        self._requests: RequestWriter | None = None
        if shared is not None and spec.inference == "device":
            observation = ObservationBatch.of(spec, len(spec.lanes)).arrays
            self._requests = RequestWriter.attach(shared, observation, spec.num_extras)
        elif shared is not None:
            self._params = BroadcastReader.attach(shared, spec.num_params, spec.layout_hash)
        self._take_params_at = 0.0
        self._loop = ActorLoop(spec, self._ring, channel.send, self._requests)

    def run(self) -> None:
        """Plays until told to stop or until the learner's end of the socket is closed."""
        with contextlib.closing(self._loop):
            self._loop.begin()
            if not self._wait_for_params():
                return
            self._channel.send(Ready(actor=self._spec.actor, pid=os.getpid()))
            num_records = len(self._spec.lanes)
            while self._ring.wait_for_space(num_records, SPACE_TIMEOUT_S, cancelled=self._must_stop):
                if self._must_stop():
                    break
                self._take_params()
                if not self._wait_for_actions():
                    break
                self._loop.step()
        self._ring.beat(WriterState.STOPPED)

    def _must_stop(self) -> bool:
        """Hears what the learner says: new tasks of lanes, or the end."""
        stop = self._channel.closed
        for message in self._channel.receive():
            if isinstance(message, Assign):
                self._loop.assign(message.lane, message.task)
            stop |= isinstance(message, Stop)
        return stop or self._channel.closed

    def _take_params(self) -> bool:
        """Acts by the newest parameters from now on; False if there are none newer, or if it is too soon."""
        clock = AwakeClock()
        newest = self._params.read() if self._params and time.monotonic() >= self._take_params_at else None
        if newest is None:
            return False
        self._loop.set_params(*newest)
        self._take_params_at = time.monotonic() + clock.look() / MAX_PARAMS_SHARE
        return True

    def _wait_for_actions(self) -> bool:
        """Has the learner choose the actions, if that is its matter; False if told to stop first."""
        if self._requests is None:
            return True
        self._requests.ask()
        waiting = partial(self._ring.beat, WriterState.WAITING_FOR_ACTIONS)
        return self._requests.wait(ACTIONS_TIMEOUT_S, beat=waiting, cancelled=self._must_stop)

    def _wait_for_params(self) -> bool:
        """Waits for the first version; False if told to stop first."""
        clock = AwakeClock()
        while self._params and not self._take_params():
            self._ring.beat(WriterState.STARTING)
            if self._must_stop():
                return False
            if clock.look() > PARAMS_TIMEOUT_S:
                raise WaitTimeoutError(
                    f"actor {self._spec.actor} waited {PARAMS_TIMEOUT_S:.0f} s for the learner to publish the first "
                    "parameters"
                )
            time.sleep(0.005)
        return True


def main() -> int:
    """Entry point of the process; returns its exit code."""
    parent_pid, descriptor, ring, *shared = map(int, sys.argv[1:])
    channel = child.begin(parent_pid, descriptor, parent="the learner")
    spec = channel.wait_for_message()
    if not isinstance(spec, ActorSpec):
        raise TypeError(f"first message: got {type(spec).__name__}, want ActorSpec")
    if spec.core is not None:
        keep_to([spec.core])
    try:
        worker = Worker(spec, channel, ring, shared[0] if shared else None)
        for inherited in (ring, *shared):  # their memory is mapped; the engines must not inherit them
            os.close(inherited)
        worker.run()
    except Exception as error:  # the process boundary: whatever it is, the learner is to hear of it
        kind = "engine_start" if isinstance(error, EngineError) else "exception"
        message = f"{type(error).__name__}: {error}"
        text = traceback.format_exc()
        channel.send(Fault(actor=spec.actor, lane=None, kind=kind, message=message, traceback=text))
        with contextlib.suppress(OSError):  # the disk with the log is full
            traceback.print_exc()
        return 1
    finally:
        channel.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
