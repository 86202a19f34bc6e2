"""Reference scores: the committed records of simple players, and the tables that docs/BENCHMARK.md makes of them.

    python -m gvz.evaluation.reference [RECORDS ...]

packs record files of `gvz evaluate` into results/reference/ (if any are given) and writes the tables anew from what is
there.
"""

import gzip
import itertools
import json
import sys
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gvz.core.errors import ConfigError
from gvz.evaluation.play import Row
from gvz.evaluation.statistics import Estimate, bootstrap, mean
from gvz.experiments.base import experiment_named
from gvz.run.rundir import RECORDS_SCHEMA, read_records
from gvz.scenarios.base import Scenario, Task
from gvz.tasks import named_tasks, scenarios

ROOT = Path(__file__).parents[2]
RECORDS = ROOT / "results" / "reference"
PAGE = ROOT / "docs" / "BENCHMARK.md"
BEGIN = "<!-- reference scores: written by `python -m gvz.evaluation.reference` -->"
END = "<!-- end of reference scores -->"

PLAYERS = ("random", "idle", "sweep", "scripted")
COLUMNS = (
    *("schema", "player", "profile", "action_set", "frame_skip", "task", "episode", "seed"),
    *("score", "kills", "player_kills", "reward", "length_frames", "terminated"),
)
"""what is kept of a row; the first three players' rows have `kills` in Seek and Kill alone"""

Scores = dict[tuple[str, str], list[Row]]
"""(player, task id) -> rows"""


def pack(file: Path, directory: Path = RECORDS) -> list[Path]:
    """Writes a record file's rows, the columns COLUMNS of them, as `<player>.jsonl.gz`; same rows, same bytes.

    Raises:
        ConfigError: damaged lines, or a player that is none of PLAYERS.
    """
    rows, problems = read_records(file)
    if problems:
        raise ConfigError(problems[0])
    if strangers := {row["player"] for row in rows} - set(PLAYERS):
        raise ConfigError(f"{file}: rows of {', '.join(sorted(strangers))}; want only {', '.join(PLAYERS)}")
    written = []
    for player in sorted({row["player"] for row in rows}):
        mine = sorted((row for row in rows if row["player"] == player), key=lambda r: (r["task"], r["episode"]))
        lines = [json.dumps({name: row[name] for name in COLUMNS if name in row}) for row in mine]
        target = directory / f"{player}.jsonl.gz"
        target.write_bytes(gzip.compress("".join(f"{line}\n" for line in lines).encode(), mtime=0))
        written.append(target)
    return written


def read_reference(directory: Path = RECORDS) -> Scores:
    """The committed records of all PLAYERS.

    Raises:
        ConfigError: a file is missing or of another schema.
    """
    scores: Scores = defaultdict(list)
    for player in PLAYERS:
        file = directory / f"{player}.jsonl.gz"
        if not file.exists():
            raise ConfigError(f"{file}: there are no records of this player")
        for line in gzip.decompress(file.read_bytes()).decode().splitlines():
            row = json.loads(line)
            if row["schema"] != RECORDS_SCHEMA:
                raise ConfigError(f"{file}: schema {row['schema']}, want {RECORDS_SCHEMA}")
            scores[player, row["task"]].append(row)
    return scores


def estimate(scores: Scores, player: str, tasks: Sequence[Task], column: str = "score", scale: float = 1.0) -> Estimate:
    """Mean over tasks and episodes with its 95% interval; episodes are resampled within their task."""
    strata = [scale * np.array([row[column] for row in scores[player, task.id]]) for task in tasks]
    return bootstrap(strata, mean, num_resamples=1000)


def tables(scores: Scores) -> str:
    """All tables as Markdown."""
    parts = [_test_table(scores), _level_table(scores)]
    for scenario in scenarios().values():
        parts.append(_task_table(scores, scenario))
        if scenario.metric == "kills":
            parts.append(_own_kills_table(scores, scenario))
    return "\n\n".join(parts)


def _test_table(scores: Scores) -> str:
    """Percent of the upper bound on the test tasks of each scenario, beside the thesis's agent."""
    head = ["scenario", *PLAYERS, "thesis: Rainbow, 4 training tasks"]
    lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    published = experiment_named("training_set_size").published["thesis"]
    for scenario in scenarios().values():
        tasks, scale = named_tasks(scenario.id, split="test"), 100 / scenario.upper_bound("thesis")
        cells = [str(estimate(scores, player, tasks, scale=scale)) for player in PLAYERS]
        lines.append(f"| {scenario.title} | {' | '.join(cells)} | {published[scenario.id][1]:.2f} |")
    title = "Percent of the upper bound on the test set: mean over its 7 tasks [95% interval]; thesis Table 5.4."
    return "\n".join([title, "", *lines])


def _level_table(scores: Scores) -> str:
    """Percent of the upper bound by scenario and level, and where the scripted agent finds a level no harder."""
    head = ["scenario", "level", "tasks", *PLAYERS]
    lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    not_harder = []
    for scenario in scenarios().values():
        percent = 100 / scenario.upper_bound("thesis")
        by_level = [named_tasks(scenario.id, level=level) for level in range(5)]
        for level, tasks in enumerate(by_level):
            cells = [str(estimate(scores, player, tasks, scale=percent)) for player in PLAYERS]
            lines.append(f"| {scenario.title} | {level} | {len(tasks)} | {' | '.join(cells)} |")
        scripted = [estimate(scores, "scripted", tasks, scale=percent) for tasks in by_level]
        for level, (easier, harder) in enumerate(itertools.pairwise(scripted), 1):
            if harder.value >= easier.value or harder.overlaps(easier):
                how = "lower, but the intervals overlap" if harder.value < easier.value else "not lower"
                not_harder.append(f"- {scenario.title}: level {level} than level {level - 1} ({how}).")
    return "\n".join(
        [
            "Percent of the upper bound by level: mean over the level's tasks [95% interval].",
            "",
            *lines,
            "",
            "Levels that are not clearly harder for the scripted agent than the level before:",
            "",
            *not_harder,
        ]
    )


def _task_table(scores: Scores, scenario: Scenario) -> str:
    """The scenario's score by task."""
    head = ["task", "level", *PLAYERS, "scripted, % of the bound"]
    lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    bound = scenario.upper_bound("thesis")
    for task in named_tasks(scenario.id):
        cells = [task.name, str(task.level), *(str(estimate(scores, player, [task])) for player in PLAYERS)]
        cells.append(str(estimate(scores, "scripted", [task], scale=100 / bound)))
        lines.append(f"| {' | '.join(cells)} |")
    unit = "kills" if scenario.metric == "kills" else "frames alive"
    episodes = {player: {len(scores[player, t.id]) for t in named_tasks(scenario.id)} for player in PLAYERS}
    counts = ", ".join(f"{player} {'-'.join(map(str, sorted(n)))}" for player, n in episodes.items())
    title = f"**{scenario.title}**: {unit}, upper bound {bound:g}; mean [95% interval]. Episodes a task: {counts}."
    return "\n".join([title, "", *lines])


def _own_kills_table(scores: Scores, scenario: Scenario) -> str:
    """Kills by the players themselves, by task and level."""
    groups = [(task.name, task.level, [task]) for task in named_tasks(scenario.id)]
    by_level = [(level, named_tasks(scenario.id, level=level)) for level in range(5)]
    groups += [(f"mean of {len(tasks)} tasks", level, tasks) for level, tasks in by_level if len(tasks) > 1]
    lines = [f"| task | level | {' | '.join(PLAYERS)} |", "|" + "---|" * (2 + len(PLAYERS))]
    for name, level, tasks in groups:
        cells = [str(estimate(scores, player, tasks, "player_kills")) for player in PLAYERS]
        lines.append(f"| {name} | {level} | {' | '.join(cells)} |")
    what = "enemies that the player killed itself, those beyond the upper bound, too"
    title = f"**{scenario.title}**, own kills: {what}; mean [95% interval]."
    return "\n".join([title, "", *lines])


def with_tables(page: str, text: str) -> str:
    """The page with `text` between its two markers.

    Raises:
        ConfigError: the markers are missing.
    """
    head, begin, rest = page.partition(BEGIN)
    _, end, tail = rest.partition(END)
    if not begin or not end:
        raise ConfigError(f"{PAGE}: the lines {BEGIN!r} and {END!r} are missing; the tables go between them")
    return f"{head}{BEGIN}\n\n{text}\n\n{END}{tail}"


def main(arguments: Sequence[str]) -> None:
    """Packs the given record files, then writes the tables."""
    for file in arguments:
        for written in pack(Path(file)):
            print(written)
    PAGE.write_text(with_tables(PAGE.read_text(), tables(read_reference())))
    print(PAGE)


if __name__ == "__main__":
    main(sys.argv[1:])
