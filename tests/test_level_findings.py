"""The findings' table of players by level is what their records give."""

import pytest

from gvz.evaluation.statistics import mean_over_scenarios
from gvz.reports.scores import agent_scores, estimate_groups
from gvz.tasks import LEVELS, named_tasks, scenarios
from tests.test_results import ROOT, results_of

PLAYERS = {
    "random play": ("reference/random.jsonl.gz", "random"),
    "the script": ("reference/scripted.jsonl.gz", "scripted"),
    "`rainbow_general`, 8 tasks": ("general_short", "rainbow_general (8 tasks)"),
    "`rainbow_segmented`, 4 tasks": ("general_train4", "rainbow_segmented+train4_network"),
    "`rainbow_segmented`, 8 tasks": ("general_short", "rainbow_segmented"),
    "`rainbow_segmented`, 8 tasks and compositions": ("general_compositions_long", "rainbow_segmented"),
}


@pytest.mark.parametrize("player", PLAYERS)
def test_the_findings_say_what_players_have_by_level(player: str):
    folder, agent = PLAYERS[player]
    episodes = results_of(folder).episodes
    scores = {name: agent_scores(episodes.filter(scenario=name), agent) for name in scenarios()}

    sets = [{name: named_tasks(name, split="test") for name in scenarios()}]
    sets += [{name: named_tasks(name, level=level) for name in scenarios()} for level in LEVELS]
    cells = []
    for tasks in sets:
        groups = [(scores[name], [task.id for task in tasks[name]]) for name in scenarios()]
        cells.append(estimate_groups(groups, mean_over_scenarios).text)
    assert f"| {player} | {' | '.join(cells)} |" in (ROOT / "docs" / "FINDINGS.md").read_text()
