"""Several learner processes that train one policy. Loads no numpy, because `--help` shows these options."""

import os
from dataclasses import dataclass
from typing import Annotated

from gvz.core.errors import ConfigError
from gvz.core.ranges import Range, check_ranges

_PROCESS_ID_VARIABLE = "SLURM_PROCID"


@dataclass(frozen=True, kw_only=True, slots=True)
class GroupConfig:
    """Learner processes with games, replay and devices of their own, which average their gradients (docs/CLUSTER.md).

    All have the same command, but for `process_id`.
    """

    num_processes: Annotated[int, Range(1, 1024)] = 1
    """learner processes of the run, each with the games, the replay and the batch that are configured"""
    process_id: Annotated[int | None, Range(0, 1023)] = None
    """which of them this is, from 0; default: SLURM_PROCID"""
    coordinator: str | None = None
    """HOST:PORT where process 0 listens and the others find it, on a private network"""

    def __post_init__(self) -> None:
        check_ranges("group", self)
        if self.num_processes == 1:
            for name in ("process_id", "coordinator"):
                if (got := getattr(self, name)) is not None:
                    raise ConfigError(
                        f"group.{name}: got {got} without other processes, want none; group.num_processes says how "
                        "many there are"
                    )
            return
        host, _, port = (self.coordinator or "").rpartition(":")
        if not host or ":" in host or not port.isdecimal() or not 0 < int(port) < 2**16:
            raise ConfigError(
                f"group.coordinator: got {self.coordinator!r} for {self.num_processes} processes, want HOST:PORT, a "
                "name or IPv4 address where process 0 can listen and the others reach it, with a port of 1..65535"
            )
        if not self.own_id < self.num_processes:
            raise ConfigError(f"group.process_id: got {self.own_id}, want 0..{self.num_processes - 1}")

    @property
    def address(self) -> tuple[str, int]:
        """Host and port of the coordinator."""
        host, _, port = (self.coordinator or "").rpartition(":")
        return host, int(port)

    @property
    def own_id(self) -> int:
        """This process, from 0.

        Raises:
            ConfigError: neither configured nor in the environment.
        """
        if self.num_processes == 1:
            return 0
        if self.process_id is not None:
            return self.process_id
        found = os.environ.get(_PROCESS_ID_VARIABLE, "")
        if not found.isdecimal():
            raise ConfigError(
                f"group.process_id: got nothing for {self.num_processes} processes, want 0..{self.num_processes - 1}; "
                f"without it {_PROCESS_ID_VARIABLE} says which process this is, as under Slurm's srun"
            )
        return int(found)
