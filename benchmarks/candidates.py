"""What the benchmarks of playing compare: groups of candidates, of which the best of each round counts."""

import contextlib
import os
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version

from benchmarks import workload
from benchmarks.remote import Remote, count_per_s, start_peer
from benchmarks.rounds import Budget, Row, absent, goal, ratios
from gvz.core.env_config import EnvConfig
from gvz.engine.tuned import TUNED


class Candidates:
    """Processes that play, each at its highest rate.

    Attributes:
        bodies: name -> plays for a while, and returns its decisions per second.
        rows: peers that are not installed.
    """

    def __init__(self, budget: Budget, stack: contextlib.ExitStack):
        """Their processes end with `stack`."""
        self.bodies: dict[str, Callable[[], float]] = {}
        self.rows: list[Row] = []
        self._budget, self._stack = budget, stack
        self._groups: dict[str, list[str]] = {}

    def add(self, group: str, name: str, body: Callable[[], float]) -> None:
        """One candidate more of a group."""
        self._groups.setdefault(group, []).append(name)
        self.bodies[name] = body

    def add_remotes(self, group: str, name: str, remotes: list[Remote]) -> None:
        """Processes that play side by side; their rates are added."""
        for remote in remotes:
            self._stack.enter_context(remote)
        self.add(group, name, lambda: count_per_s(remotes, {"seconds": self._budget.body_s}))

    def add_limit(self, counts: Sequence[int]) -> None:
        """Group "limit": this many bare engines, at the size that our environments render."""
        config = EnvConfig()
        size = (str(config.render_width), str(config.render_height))
        for count in counts:
            remotes = [Remote("bare_engine", workload.TASK, *size) for _ in range(count)]
            self.add_remotes("limit", f"bare engines x{count}, {'x'.join(size)}", remotes)

    def add_peers(self, counts: Sequence[int]) -> None:
        """Groups "EnvPool" and "LevDoom 320x240" and "LevDoom 256x144", with these numbers of games."""
        cores = len(os.sched_getaffinity(0))
        for count in counts:
            threads = min(count, cores)
            self._add_peer("EnvPool", f"{count} games, {threads} threads", "envpool_doom", str(count), str(threads))
            self._add_peer("LevDoom 320x240", f"{count} games", "levdoom_async", str(count))
            self._add_peer("LevDoom 256x144", f"{count} games", "levdoom_async", str(count), "256X144")

    def goals(
        self, number: int, group: str, values: Mapping[str, Sequence[float]], wanted: Mapping[str, float]
    ) -> list[Row]:
        """A goal for each other group that was measured: its name -> how many times as fast `group` is to be."""
        ours = self._best(group, values)
        return [
            goal(number, f"{group} against {other}", ratios(ours, self._best(other, values)), at_least=bound, unit="x")
            for other, bound in wanted.items()
            if other in self._groups
        ]

    def _best(self, group: str, values: Mapping[str, Sequence[float]]) -> list[float]:
        """The highest rate of each round."""
        return [max(found) for found in zip(*(values[name] for name in self._groups[group]), strict=True)]

    def _add_peer(self, group: str, size: str, script: str, *arguments: str) -> None:
        name, remote = f"{group}, {size}", start_peer(script, self._budget.peers, *arguments)
        if isinstance(remote, str):
            self.rows.append(absent(name, remote))
        else:
            self.add_remotes(group, name, [remote])


def engine_is_tuned() -> bool:
    """Whether the installed ViZDoom is our build of it (docs/ENGINE.md)."""
    return TUNED in version("vizdoom")
