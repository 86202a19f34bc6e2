"""Reference scores: the committed records of simple players, and the tables of the docs that come from them.

    python -m benchmarks.reference [RECORDS ...]

packs the given record files of `gvz evaluate` into results/reference/ and writes the tables of all records there. A
scenario of the extended suite has a folder of its own, and its table is in docs/EXTENDED.md.
"""

import gzip
import itertools
import json
import sys
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from benchmarks.record import ROOT
from benchmarks.report import between
from gvz.core import records
from gvz.core.errors import ConfigError, GvzError
from gvz.evaluation.play import Row
from gvz.evaluation.statistics import Estimate, bootstrap
from gvz.experiments.base import experiment_named
from gvz.scenarios.base import Scenario, Task
from gvz.tasks import LEVELS, named_tasks, scenarios

RECORDS = ROOT / "results" / "reference"
COMMAND = "python -m benchmarks.reference"
PAGE = ROOT / "docs" / "benchmark" / "reference-scores.md"
EXTENDED_PAGE = ROOT / "docs" / "EXTENDED.md"
PLAYERS = ("random", "idle", "sweep", "scripted")
"""in the order of the tables' columns"""
COLUMNS = (
    *("schema", "player", "profile", "action_set", "frame_skip", "task", "episode", "seed"),
    *("score", "kills", "player_kills", "reward", "length_frames", "terminated"),
)
"""the kept columns of a row; rows of random, idle and scripted have `kills` only in Seek and Kill"""

Scores = dict[tuple[str, str], list[Row]]
"""(player, task id) -> rows"""


def pack(file: Path, directory: Path = RECORDS) -> list[Path]:
    """Writes the columns COLUMNS of a record file's rows as `<player>.jsonl.gz`; the same rows give the same bytes.

    Rows of the extended suite go into a folder of their scenario.

    Raises:
        ConfigError: damaged lines, or a player that is not in PLAYERS.
    """
    targets = defaultdict[Path, list[Row]](list)
    for row in _read(file):
        if row["player"] not in PLAYERS:
            raise ConfigError(f"{file}: rows of {row['player']}; want only {', '.join(PLAYERS)}")
        scenario = row["task"].partition("/")[0]
        targets[(directory if scenario in scenarios() else directory / scenario) / f"{row['player']}.jsonl.gz"].append(
            row
        )
    for target, rows in sorted(targets.items()):
        rows.sort(key=lambda row: (row["task"], row["episode"]))
        lines = [json.dumps({name: row[name] for name in COLUMNS if name in row}) for row in rows]
        target.parent.mkdir(exist_ok=True)
        target.write_bytes(gzip.compress("".join(f"{line}\n" for line in lines).encode(), mtime=0))
    return sorted(targets)


def read_reference(directory: Path = RECORDS) -> Scores:
    """The committed records of all PLAYERS in a folder: the core suite, or one scenario of the extended suite.

    Raises:
        ConfigError: a file is missing or of another schema.
    """
    scores: Scores = defaultdict(list)
    for player in PLAYERS:
        file = directory / f"{player}.jsonl.gz"
        if not file.exists():
            raise ConfigError(f"{file}: there are no records of this player")
        for row in _read(file):
            scores[player, row["task"]].append(row)
    return scores


def _read(file: Path) -> list[Row]:
    rows, problems = records.read(file)
    if problems:
        raise ConfigError(problems[0])
    return rows


def estimate(scores: Scores, player: str, tasks: Sequence[Task], column: str = "score", scale: float = 1.0) -> Estimate:
    """Mean over tasks and episodes with its 95% interval; episodes are resampled within their task."""
    strata = [scale * np.array([row[column] for row in scores[player, task.id]]) for task in tasks]
    return bootstrap(strata, num_resamples=1000)


def tables(scores: Scores) -> str:
    """The tables of the core suite as Markdown."""
    parts = [_test_table(scores), _level_table(scores)]
    for scenario in scenarios().values():
        parts.append(task_table(scores, scenario))
        if scenario.metric == "kills":
            parts.append(_own_kills_table(scores, scenario))
    return "\n\n".join(parts)


def _table(title: str, head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    lines = [f"| {' | '.join(map(str, row))} |" for row in (head, *rows)]
    return "\n".join([title, "", lines[0], "|" + "---|" * len(head), *lines[1:]])


def _test_table(scores: Scores) -> str:
    """Percent of the upper bound on the test tasks of each scenario, beside the thesis's agent."""
    published = experiment_named("training_set_size").published["thesis"]
    rows, num_tasks = [], set[int]()
    for scenario in scenarios().values():
        tasks, scale = named_tasks(scenario.id, split="test"), 100 / scenario.upper_bound("thesis")
        cells = [estimate(scores, player, tasks, scale=scale) for player in PLAYERS]
        rows.append((scenario.title, *cells, f"{published[scenario.id][1]:.2f}"))
        num_tasks.add(len(tasks))
    size = " or ".join(map(str, sorted(num_tasks)))
    title = f"Percent of the upper bound on the test set: mean over its {size} tasks [95% interval]; thesis Table 5.4."
    return _table(title, ("scenario", *PLAYERS, "thesis: Rainbow, 4 training tasks"), rows)


def _level_table(scores: Scores) -> str:
    """Percent of the upper bound by scenario and level, and the levels that are no harder for the scripted agent."""
    rows, not_harder = [], []
    for scenario in scenarios().values():
        percent = 100 / scenario.upper_bound("thesis")
        by_level = [named_tasks(scenario.id, level=level) for level in LEVELS]
        for level, tasks in enumerate(by_level):
            cells = [estimate(scores, player, tasks, scale=percent) for player in PLAYERS]
            rows.append((scenario.title, level, len(tasks), *cells))
        scripted = [estimate(scores, "scripted", tasks, scale=percent) for tasks in by_level]
        for level, (easier, harder) in enumerate(itertools.pairwise(scripted), 1):
            if harder.value >= easier.value or harder.overlaps(easier):
                how = "lower, but the intervals overlap" if harder.value < easier.value else "not lower"
                not_harder.append(f"- {scenario.title}: level {level} than level {level - 1} ({how}).")
    title = "Percent of the upper bound by level: mean over the level's tasks [95% interval]."
    table = _table(title, ("scenario", "level", "tasks", *PLAYERS), rows)
    listed = "Levels that are not clearly harder for the scripted agent than the level before:"
    return "\n".join([table, "", listed, "", *not_harder])


def task_table(scores: Scores, scenario: Scenario) -> str:
    """The scenario's score by task, for the tasks that all players have played."""
    rows, bound = [], scenario.upper_bound("thesis")
    played = [task for task in named_tasks(scenario.id) if all((player, task.id) in scores for player in PLAYERS)]
    for task in played:
        cells = [estimate(scores, player, [task]) for player in PLAYERS]
        rows.append((task.name, task.level, *cells, estimate(scores, "scripted", [task], scale=100 / bound)))
    unit = scenario.metric.replace("_", " ")
    episodes = {player: {len(scores[player, task.id]) for task in played} for player in PLAYERS}
    counts = ", ".join(f"{player} {'-'.join(map(str, sorted(n)))}" for player, n in episodes.items())
    title = f"**{scenario.title}**: {unit}, upper bound {bound:g}; mean [95% interval]. Episodes a task: {counts}."
    return _table(title, ("task", "level", *PLAYERS, "scripted, % of the bound"), rows)


def _own_kills_table(scores: Scores, scenario: Scenario) -> str:
    """Kills by the players themselves, by task and level."""
    groups = [(task.name, task.level, [task]) for task in named_tasks(scenario.id)]
    by_level = [(level, named_tasks(scenario.id, level=level)) for level in LEVELS]
    groups += [(f"mean of {len(tasks)} tasks", level, tasks) for level, tasks in by_level if len(tasks) > 1]
    rows = [
        (name, level, *(estimate(scores, player, tasks, "player_kills") for player in PLAYERS))
        for name, level, tasks in groups
    ]
    what = "enemies that the player killed itself, those beyond the upper bound, too"
    title = f"**{scenario.title}**, own kills: {what}; mean [95% interval]."
    return _table(title, ("task", "level", *PLAYERS), rows)


def pages() -> dict[Path, str]:
    """docs/benchmark/reference-scores.md and docs/EXTENDED.md with the tables of all records in their places.

    Raises:
        ConfigError: records or markers are missing.
    """
    extended = EXTENDED_PAGE.read_text()
    for scenario in scenarios("extended").values():
        table = task_table(read_reference(RECORDS / scenario.id), scenario)
        extended = between(extended, EXTENDED_PAGE, f"scores of {scenario.id}", table, COMMAND)
    core = between(PAGE.read_text(), PAGE, "reference scores", tables(read_reference()), COMMAND)
    return {PAGE: core, EXTENDED_PAGE: extended}


def main(files: Sequence[str]) -> None:
    """Packs the given record files, then writes the tables."""
    for file in files:
        for written in pack(Path(file)):
            print(written)
    for page, text in pages().items():
        page.write_text(text)
        print(page)


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except GvzError as error:
        sys.exit(f"error: {error}")
