"""`gvz train`. Its flags come from the config file that is named among them, so gvz.launch parses them."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Train:
    """Train an agent, or go on with a run: `gvz train --help` has all the options (as python -m gvz.launch)."""

    def run(self) -> int:
        """Never called: gvz.cli hands everything behind `train` to gvz.launch."""
        raise AssertionError("gvz train is forwarded to gvz.launch")


COMMAND = Train
