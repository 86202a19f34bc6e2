"""Scores of all players by level, from their records.

`python -m tests.level_scores` prints the rows of the findings' two tables and draws docs/images/levels.png.
"""

import tempfile
from collections.abc import Callable, Collection, Mapping
from pathlib import Path

import polars as pl
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from gvz.evaluation.statistics import mean_over_scenarios
from gvz.reports.document import Cell
from gvz.reports.draw import draw_levels
from gvz.reports.scores import Scores, agent_scores, estimate_groups
from gvz.tasks import LEVELS, Task, named_tasks, scenarios
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


def _scores(player: str, percent: pl.Expr | None = None) -> dict[str, Scores]:
    """By scenario: percent of the bound, or another expression of the rows."""
    folder, agent = PLAYERS[player]
    episodes = results_of(folder).episodes
    if percent is not None:
        episodes = episodes.with_columns(normalized_score=percent)
    return {name: agent_scores(episodes.filter(scenario=name), agent) for name in scenarios()}


def _mean(scores: Mapping[str, Scores], tasks: Callable[[str], Collection[Task]]) -> Cell:
    """The mean over the scenarios on these tasks of each."""
    groups = [(of_scenario, [task.id for task in tasks(name)]) for name, of_scenario in scores.items()]
    return estimate_groups(groups, mean_over_scenarios)


def _test_tasks(name: str) -> tuple[Task, ...]:
    return named_tasks(name, split="test")


def level_cells(player: str) -> list[Cell]:
    """Percent of the bound on the test tasks, then on all named tasks of each level: means over the scenarios."""
    scores = _scores(player)
    levels = [_mean(scores, lambda name, level=level: named_tasks(name, level=level)) for level in LEVELS]
    return [_mean(scores, _test_tasks), *levels]


_OWN_KILLS = (
    pl.when(pl.col("scenario") == "seek_and_kill")
    .then(5 * pl.col("player_kills").clip(upper_bound=20))
    .otherwise("normalized_score")
)
"""percent of the bound, of 20 kills in Seek and Kill, where enemies' kills of each other do not count"""


def parts_row(player: str) -> str:
    """The player's row of the findings' table of parts of the levels, and of own kills."""
    scores = _scores(player)
    four = named_tasks(split="train4")
    cells = (
        _mean(scores, lambda name: [task for task in named_tasks(name, level=1) if task not in four]),
        _mean(scores, lambda name: named_tasks(name, split="gate")),
        _mean(scores, lambda name: [task for task in _test_tasks(name) if task.level == 2]),
        _mean(_scores(player, _OWN_KILLS), _test_tasks),
    )
    return f"| {player} | {' | '.join(cell.text for cell in cells)} |"


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
    print(*map(level_row, PLAYERS), *map(parts_row, PLAYERS), sep="\n")
    _draw()
