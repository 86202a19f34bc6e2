"""`gvz doctor`: is this machine fit for a run?"""

import dataclasses
import json
import sys
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Doctor:
    """Check Python, packages, memory, /dev/shm, ViZDoom, JAX, learner; say what is wrong and how to mend it.

    Exit code 1 if runs will fail on this machine.
    """

    clean: bool = False
    """first remove what dead runs of yours left: engines, shared memory, private directories"""
    json: bool = False
    """one JSON object a line instead of a table"""

    def run(self) -> int:
        """Prints the findings."""
        from gvz.core import janitor
        from gvz.run import doctor

        if self.clean:
            for line in janitor.clean_dead_instances():
                done = line if line.startswith("left alone") else f"removed {line}"
                print(done, file=sys.stderr if self.json else sys.stdout)
        bad = 0
        for check in doctor.CHECKS:
            finding = check()
            bad += finding.state == "bad"
            if self.json:
                print(json.dumps(dataclasses.asdict(finding)), flush=True)
                continue
            print(f"{finding.state:5} {finding.name:10} {finding.found}", flush=True)
            if finding.remedy:
                print(f"{'':16} -> {finding.remedy}")
        return 1 if bad else 0


COMMAND = Doctor
