"""`gvz gallery`: pictures of the tasks."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from gvz.core.errors import ConfigError
from gvz.tasks import all_scenarios, scenario_named


@dataclass(frozen=True, kw_only=True)
class Gallery:
    """Draw a contact sheet of each scenario: by default a frame of every named task, same seed and pose."""

    out: Path = Path("gallery")
    """directory for <kind>_<scenario>.png"""
    scenario: str | None = None
    """only this one; default: all, or with segmented all that have a network"""
    kind: Literal["gallery", "varied", "procedural", "severity", "augmented", "segmented"] = "gallery"
    """gallery: the named tasks; varied, procedural: the first maps of such a task; severity: each attribute alone at
    four severities; augmented: the default task under each augmentation that a learner can train with; segmented: the
    default and the gate tasks, each beside what the scenario's segmentation network takes it for"""
    moving: bool = False
    """also agents.webp: agents of the core scenarios at play, level after level; policies of the zoo if there are"""

    def run(self) -> int:
        """Writes the pictures and says where they are."""
        chosen = all_scenarios().values() if self.scenario is None else [scenario_named(self.scenario)]
        try:
            self.out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"--out: {self.out} cannot be made: {error.strerror}") from error
        from gvz.evaluation.gallery import write_contact_sheet, write_moving_picture
        from gvz.segmentation import segmenter_names

        if self.scenario is None and self.kind == "segmented":
            chosen = [scenario for scenario in chosen if scenario.id in segmenter_names()]
        for scenario in chosen:
            print(write_contact_sheet(scenario, self.out, self.kind))
        if self.moving:
            print(write_moving_picture(self.out / "agents.webp"))
        return 0


COMMAND = Gallery
