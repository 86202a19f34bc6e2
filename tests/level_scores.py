"""Scores of all players by level, from their records; `python -m tests.level_scores` draws docs/images/levels.png."""

import tempfile
from pathlib import Path

from PIL import Image
from PIL.PngImagePlugin import PngInfo

from gvz.evaluation.statistics import mean_over_scenarios
from gvz.reports.document import Cell
from gvz.reports.draw import draw_levels
from gvz.reports.scores import agent_scores, estimate_groups
from gvz.tasks import LEVELS, named_tasks, scenarios
from tests.score_tables import ROOT, results_of

PLAYERS = {
    "`rainbow_segmented`, 8 tasks and compositions": ("general_compositions_long", "rainbow_segmented"),
    "`rainbow_segmented`, 8 tasks": ("general_short", "rainbow_segmented"),
    "`rainbow_segmented`, 4 tasks": ("general_train4", "rainbow_segmented+train4_network"),
    "`rainbow_general`, 8 tasks": ("general_short", "rainbow_general (8 tasks)"),
    "the script": ("reference/scripted.jsonl.gz", "scripted"),
    "random play": ("reference/random.jsonl.gz", "random"),
}
"""what a player is called -> its records under results/, and its name there"""
PICTURE = ROOT / "docs" / "images" / "levels.png"


def level_cells(player: str) -> list[Cell]:
    """Percent of the bound on the test tasks, then on all named tasks of each level: means over the scenarios."""
    folder, agent = PLAYERS[player]
    episodes = results_of(folder).episodes
    scores = {name: agent_scores(episodes.filter(scenario=name), agent) for name in scenarios()}
    sets = [{name: named_tasks(name, split="test") for name in scenarios()}]
    sets += [{name: named_tasks(name, level=level) for name in scenarios()} for level in LEVELS]
    groups = [[(scores[name], [task.id for task in tasks[name]]) for name in scenarios()] for tasks in sets]
    return [estimate_groups(group, mean_over_scenarios) for group in groups]


def level_row(player: str) -> str:
    """The player's row of the findings' table."""
    return f"| {player} | {' | '.join(cell.text for cell in level_cells(player))} |"


def _draw() -> None:
    """The picture, with the table's rows in its description: so a test sees whether it is of these numbers."""
    values = {player.replace("`", ""): [cell.estimate for cell in level_cells(player)[1:]] for player in PLAYERS}
    whole = {player: [one for one in found if one] for player, found in values.items()}
    assert all(len(found) == len(LEVELS) for found in whole.values())
    described = PngInfo()
    described.add_text("Description", "\n".join(map(level_row, PLAYERS)))
    with tempfile.TemporaryDirectory() as out:
        draw_levels(Path(out), "levels", "mean of the four scenarios", LEVELS, whole, "")
        with Image.open(Path(out) / "figures" / "levels.png") as drawn:
            drawn.save(PICTURE, optimize=True, pnginfo=described)


if __name__ == "__main__":
    _draw()
