"""The thread of the learner's process that chooses the actions of all actors that ask for them.

It takes every request that is there, acts on all of them in one batch, answers, and looks again. While the device is
busy, further requests come in: the longer a batch takes, the larger is the next one. So there is no time to wait for a
batch to fill, and no actor is passed over.
"""

import threading
import time
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from actors.policy import Policy
from gvz.core.errors import WaitTimeoutError, WorkerError
from gvz.transport.inference import Answer, RequestReader
from gvz.transport.messages import ParamsHeader

_FIRST_SLEEP_S, _LONGEST_SLEEP_S = 20e-6, 1e-3
_STOP_TIMEOUT_S = 60.0
"""longest wait for the call that is under way, which may compile"""


class InferenceServer:
    """Answers the requests of actors, from the first publication of parameters on.

    Batches have few sizes, so that a jitted policy compiles few times, all before the first answer: 1, 2, 4, ...
    actors' games, and all games. Rows without a request hold old observations, and nobody reads their actions.
    """

    def __init__(self, policy: Policy, requests: Sequence[RequestReader], batch: Mapping[str, np.ndarray]):
        """Does nothing yet.

        Args:
            policy: `set_params` is called in the thread that publishes, `act` in the server's own.
            requests: of every actor, each with the same number of games.
            batch: arrays for the observations of all games, with valid values.
        """
        self._policy, self._requests, self._batch = policy, list(requests), batch
        self._num_games = len(batch["task"]) // len(self._requests)
        powers = [2**i for i in range(len(self._requests).bit_length())]
        self._sizes = [size for size in powers if size < len(self._requests)] + [len(self._requests)]
        self._stop = threading.Event()
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="inference", daemon=True)

    def publish(self, params: ArrayLike, header: ParamsHeader) -> None:
        """Acts by `params` float32[P], also on the device, from the next batch on. Does not wait."""
        self._policy.set_params(params, header)
        if self._thread.ident is None:
            self._thread.start()

    def check(self) -> None:
        """Says what ended the thread, if anything did.

        Raises:
            WorkerError: choosing actions failed, whatever it was.
        """
        if (failure := self._failure) is not None:
            raise WorkerError(f"choosing the actors' actions failed: {type(failure).__name__}: {failure}") from failure

    def close(self, *, abandon: bool = False) -> None:
        """Ends the thread; waits for the batch that is under way unless it is abandoned. Can be repeated.

        Raises:
            WaitTimeoutError: the device does not answer.
        """
        self._stop.set()
        if self._thread.ident is not None and not abandon:
            self._thread.join(_STOP_TIMEOUT_S)
            if self._thread.is_alive():
                raise WaitTimeoutError(
                    f"learner waited {_STOP_TIMEOUT_S:.0f} s for its device to choose the actors' last actions"
                )

    def _run(self) -> None:
        try:
            for size in self._sizes:  # compiles
                if self._stop.is_set():
                    return
                self._policy.act(self._rows(size))
            sleep_s = _FIRST_SLEEP_S
            while not self._stop.is_set():
                if self._answer():
                    sleep_s = _FIRST_SLEEP_S
                else:
                    time.sleep(sleep_s)
                    sleep_s = min(2 * sleep_s, _LONGEST_SLEEP_S)
        except BaseException as failure:  # the thread's boundary: `check` raises it in the learner's loop
            self._failure = failure

    def _answer(self) -> bool:
        """Answers every request that is there; False if there is none."""
        pending = [(asked, number) for asked in self._requests if (number := asked.pending()) is not None]
        if not pending:
            return False
        rows = [slice(i * self._num_games, (i + 1) * self._num_games) for i in range(len(pending))]
        for own, (asked, _) in zip(rows, pending, strict=True):
            for name, part in asked.observation.items():
                self._batch[name][own] = part
        action, extras = self._policy.act(self._rows(min(s for s in self._sizes if s >= len(pending))))
        for own, (asked, number) in zip(rows, pending, strict=True):
            asked.answer(number, Answer(action[own], extras[own], self._policy.params_version))
        return True

    def _rows(self, num_actors: int) -> dict[str, np.ndarray]:
        """The first rows of the batch: the games of `num_actors` actors."""
        return {name: array[: num_actors * self._num_games] for name, array in self._batch.items()}
