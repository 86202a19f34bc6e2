"""A worker of a vector environment: `python -m gvz.vector.worker PARENT_PID SOCKET FRAMES`, started by `crew.py`.

SOCKET and FRAMES are inherited file descriptors: its end of a socket, and the shared observations. The first message
is a `VectorSpec`; then the process answers `Decisions` with `Outcomes` until it receives `Stop`. An exception becomes a
`Fault` message and a non-zero exit.

When the environment's process ends, however it ends, the kernel sends SIGTERM. So the worker still ends its engines and
removes their files.
"""

import contextlib
import os
import signal
import sys
import traceback
from collections import deque

import numpy as np
from gymnasium.error import ResetNeeded

from gvz.core.env_config import EnvConfig
from gvz.env import DoomEnv, make_env
from gvz.transport import child
from gvz.transport.channel import Channel
from gvz.transport.messages import Decision, Decisions, Fault, Outcome, Outcomes, Render, Screen, Stop, VectorSpec
from gvz.vector.frames import FrameLayout, Frames


class Worker:
    """Its games, played in turn."""

    def __init__(self, spec: VectorSpec, channel: Channel, frames: Frames):
        self._spec = spec
        self._channel = channel
        self._frames = frames
        self._envs: dict[int, DoomEnv] = {}

    def run(self) -> None:
        """Plays until told to stop, or until the environment's end of the socket is closed."""
        spec = self._spec
        for game, task in zip(spec.games, spec.tasks, strict=True):
            self._envs[game] = make_env(task, spec.env_config, **spec.options)
        waiting: deque[Decision] = deque()
        outcomes: list[Outcome] = []
        while not self._channel.closed:
            for message in self._channel.receive():
                if isinstance(message, Stop):
                    return
                if isinstance(message, Decisions):
                    waiting += message.decisions
                elif isinstance(message, Render):
                    self._render()
            if not waiting:
                self._channel.wait()  # as long as the user thinks; the end of the parent ends it
                continue
            outcomes.append(self._play(waiting.popleft()))
            self._frames.progress[spec.worker] += 1
            if not waiting or len(outcomes) >= spec.answer_after:
                self._channel.send(Outcomes(outcomes=outcomes))
                outcomes = []

    def close(self) -> None:
        """Ends the engines."""
        for env in self._envs.values():
            env.close()

    def _play(self, decision: Decision) -> Outcome:
        game, env = decision.game, self._envs[decision.game]
        options = {"episode_seed": decision.episode_seed}
        reward, terminated, truncated, final_info = 0.0, False, False, None
        if decision.action is None:
            observation, info = env.reset(options=options)
        else:
            observation, reward, terminated, truncated, info = env.step(np.array(decision.action))
            if self._spec.same_step and (terminated or truncated):
                final_info = info
                self._frames.write_final(game, observation)
                observation, info = env.reset(options=options)
        self._frames.write(game, decision.half, observation)
        return Outcome(game, reward, terminated, truncated, info, final_info)

    def _render(self) -> None:
        for env in self._envs.values():
            screen = None
            with contextlib.suppress(ResetNeeded):  # of a worker that was replaced
                screen = env.render()
            self._channel.send(Screen(b"" if screen is None else screen.tobytes()))


def main() -> int:
    """Entry point of the process; returns its exit code."""
    parent_pid, descriptor, memory = map(int, sys.argv[1:])
    channel = child.begin(parent_pid, descriptor, parent="the vector environment", last_signal=signal.SIGTERM)
    spec = channel.wait_for_message()
    if not isinstance(spec, VectorSpec):
        raise TypeError(f"first message: got {type(spec).__name__}, want VectorSpec")
    layout = FrameLayout(
        env=EnvConfig(**spec.env_config),
        num_envs=spec.num_envs,
        num_workers=spec.num_workers,
        same_step=spec.same_step,
    )
    frames = Frames.attach(memory, layout)
    os.close(memory)  # it is mapped; the engines must not inherit it
    worker = Worker(spec, channel, frames)
    try:
        worker.run()
    except Exception as error:  # the process boundary: whatever it is, the environment is to hear of it
        kind, text = type(error).__name__, traceback.format_exc()
        channel.send(Fault(actor=spec.worker, lane=None, kind=kind, message=str(error), traceback=text))
        return 1
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # if it comes now, it must not interrupt what it asks for
        worker.close()
        channel.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
