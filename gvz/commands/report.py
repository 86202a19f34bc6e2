"""`gvz report`: makes a report of results."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from gvz.core.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class Report:
    """Make a report: one HTML page, Markdown, tables as CSV and LaTeX, figures as SVG, PDF and PNG.

    Example: gvz report runs/quick --out report
    """

    results: Annotated[
        tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="RESULTS ...", help_behavior_hint="")
    ]
    """results of `gvz experiment run`, run directories, or record files of `gvz evaluate`; any number of them"""
    out: Path = Path("report")
    """directory to write to"""
    title: str | None = None
    """default: the names of the results"""

    def run(self) -> int:
        """Writes the report and says where it is, and what it could not read."""
        if not self.results:
            raise ConfigError("report: got nothing to report on; want results directories, run directories or records")
        from gvz.evaluation.zoo import run_directory
        from gvz.reports.page import make_report

        files, problems = make_report([run_directory(path) for path in self.results], self.out, self.title)
        for problem in problems:
            print(f"note: {problem}", file=sys.stderr)
        for file in files[:2]:
            print(file)
        return 0


COMMAND = Report
