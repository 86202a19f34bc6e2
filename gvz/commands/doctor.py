"""`gvz doctor`: is this machine fit for a run?"""

import sys
from dataclasses import dataclass
from pathlib import Path

from gvz.core.errors import ConfigError

MAX_HOLD_S = 86_400.0


@dataclass(frozen=True, kw_only=True)
class Doctor:
    """Check Python, packages, memory, /dev/shm, ViZDoom, JAX, learner; say what is wrong and how to mend it.

    Exit code 1 if runs will fail on this machine.
    """

    clean: bool = False
    """first remove what dead runs of yours left: engines, shared memory, private directories"""
    shared: Path | None = None
    """check this directory instead, for several machines that work in it: locks, renames, fsync"""
    hold: float | None = None
    """seconds to hold a lock in the shared directory; meanwhile give the command without --hold on another machine"""
    json: bool = False
    """one JSON object a line instead of a table"""

    def run(self) -> int:
        """Prints the findings."""
        from gvz.core import janitor
        from gvz.run import doctor, shared_directory

        if self.hold is not None and (self.shared is None or not 0 < self.hold <= MAX_HOLD_S):
            raise ConfigError(
                f"--hold: got {self.hold:g}, want more than 0 and at most {MAX_HOLD_S:g} seconds, and --shared DIR"
            )
        if self.clean:
            for line in janitor.clean_dead_instances():
                done = line if line.startswith("left alone") else f"removed {line}"
                print(done, file=sys.stderr if self.json else sys.stdout)
        if self.shared is None:
            return doctor.show(doctor.findings(doctor.CHECKS), json_lines=self.json)
        shared_directory.require_directory(self.shared)
        if self.hold is not None:
            shared_directory.hold(self.shared, self.hold, lambda line: print(line, flush=True))
            return 0
        return doctor.show(doctor.findings(shared_directory.CHECKS, self.shared), json_lines=self.json)


COMMAND = Doctor
