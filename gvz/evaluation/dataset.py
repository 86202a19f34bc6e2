"""Evaluation records as one polars frame: `read_evaluations` is the public reader.

Everything readable is read. What cannot be read is reported by file and line, and does not stop the rest.
"""

import json
import math
import warnings
from collections.abc import Collection, Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import polars as pl

from gvz.core import records
from gvz.core.errors import ConfigError, TaskError
from gvz.core.files import files_below
from gvz.evaluation.statistics import normalize
from gvz.run.rundir import RECORD_FILES, START_RECORDS
from gvz.tasks import Task, parse_task

SUFFIXES = (".jsonl", ".jsonl.gz")
"""of record files; committed records are compressed"""

REQUIRED: dict[str, pl.DataType] = {
    "player": pl.String(),
    "task": pl.String(),
    "episode": pl.Int64(),
    "seed": pl.Int64(),
    "score": pl.Float64(),
}
"""fields every row of an evaluation has"""

OPTIONAL: dict[str, pl.DataType] = {
    "run": pl.String(),
    "run_seed": pl.Int64(),
    "num_updates": pl.Int64(),
    "params": pl.String(),
    "base_seed": pl.Int64(),
    "profile": pl.String(),
    "action_set": pl.String(),
    "frame_skip": pl.Int64(),
    "observes": pl.String(),
    "normalized_score": pl.Float64(),
    "kills": pl.Float64(),
    "player_kills": pl.Float64(),
    "reward": pl.Float64(),
    "length_frames": pl.Int64(),
    "length_steps": pl.Int64(),
    "terminated": pl.Boolean(),
    "truncated": pl.Boolean(),
    "vizdoom": pl.String(),
}
"""fields that are null where a row lacks them. `run`, `run_seed`, `num_updates` and `params` are a trained player's.
`observes` is that of a player of your own which has more or other than the screen"""

DERIVED: dict[str, pl.DataType] = {
    "scenario": pl.String(),
    "level": pl.Int64(),
    "attributes": pl.List(pl.String()),
    "run_dir": pl.String(),
    "trained_on": pl.List(pl.String()),
}
"""columns made of the task's id and of the run's config.json"""

REWARD_PREFIX = "reward/"
"""before the name of a reward component, one column each"""
MAX_COMPONENTS = 64
"""of a file: every name is a column, and a small file could have more cells than fit into memory"""

_IDENTITY = ("player", "params", "profile", "action_set", "frame_skip", "observes", "task", "episode", "seed")
"""rows of one directory that are equal in these are one and the same episode, and so are those outside a run directory
whose policy is known by its weights"""

_NUM_RESULTS = pl.max_horizontal(pl.col("score").n_unique(), pl.col("length_frames").drop_nulls().n_unique())
"""of the rows of one episode"""

_NOT_RECORDS = {"discarded", "work", "checkpoints", "policies", "tensorboard"}
"""folders of a run directory that hold no records, or only discarded ones"""

_PYTHON_TYPES: dict[type[pl.DataType], tuple[type, ...]] = {
    pl.String: (str,),
    pl.Int64: (int,),
    pl.Float64: (int, float),
    pl.Boolean: (bool,),
}


class RecordWarning(UserWarning):
    """Part of a record file could not be read."""


def read_evaluations(*paths: Path | str) -> pl.DataFrame:
    """The evaluation episodes in these files and directories, a row each.

    Args:
        paths: record files (.jsonl, .jsonl.gz), or directories: run directories, results of experiments; searched to
            any depth.

    Returns:
        The columns of REQUIRED, OPTIONAL and DERIVED, and one `reward/<name>` for each reward component; an episode
        that was found twice is there once. What cannot be read is warned of as RecordWarning, by file and line.

    Raises:
        ConfigError: a path does not exist.
    """
    frame, problems = collect_evaluations(paths)
    for problem in problems:
        warnings.warn(problem, RecordWarning, stacklevel=2)
    return frame


def collect_evaluations(paths: Iterable[Path | str]) -> tuple[pl.DataFrame, list[str]]:
    """`read_evaluations`, with the problems as messages instead of warnings.

    Raises:
        ConfigError: a path does not exist.
    """
    empty = pl.DataFrame(schema=REQUIRED | OPTIONAL | DERIVED)
    frames, problems = [empty], []
    for file in sorted(evaluation_files(paths), key=lambda file: not _is_of_run(file)):
        frame, found = _read_file(file)
        frames.append(frame)
        problems += found
    together = pl.concat(frames, how="diagonal")
    outside = pl.col("trained_on").is_null() & pl.col("params").is_not_null()
    seen_before = pl.int_range(pl.len()).over(_IDENTITY) > 0
    together, homeless = _at_home(together.filter(~(outside & seen_before)))
    problems += homeless
    unlike = together.filter(pl.col("params").is_null()).group_by("run_dir", *_IDENTITY, maintain_order=True)
    unlike = unlike.agg(num_results=_NUM_RESULTS).filter(pl.col("num_results") > 1)
    for player, num_episodes in unlike.group_by("player", maintain_order=True).len().iter_rows():
        problems.append(
            f"{player}: {num_episodes} of its episodes were found with several results, of which the first is kept; "
            "two players have this name, or two versions of one; give each a name of its own"
        )
    together = together.unique(("run_dir", *_IDENTITY), keep="first", maintain_order=True)
    # runs of several scenarios may have one name and seed
    one_policy = ("run_dir", "player", "num_updates", "scenario")
    policies = together.drop_nulls("params").group_by(one_policy, maintain_order=True)
    for run_dir, player, _, scenario, num_policies in policies.agg(pl.col("params").n_unique()).iter_rows():
        if num_policies > 1:
            problems.append(
                f"{run_dir}: {player} has episodes of {num_policies} policies (`params`) in {scenario}, which are put "
                "together as if they were of one; leave out the records of the others"
            )
    # a tuned engine plays the games of the one it is made of
    released = together["vizdoom"].str.split("+").list.first()
    if len(versions := released.drop_nulls().unique().sort()) > 1:
        problems.append(
            f"episodes were played with several versions of ViZDoom ({', '.join(versions)}), whose games may differ; "
            "play them again with one of these"
        )
    return together, problems


def _at_home(rows: pl.DataFrame) -> tuple[pl.DataFrame, list[str]]:
    """Gives rows outside run directories the directory of their run, or if that is not there, the first one that holds
    rows of it; says of which runs there are several.
    """
    astray = rows.filter(pl.col("trained_on").is_null())["run_dir"].drop_nulls().unique()
    outside = pl.col("run_dir").is_in([one for one in astray if not (Path(one) / "config.json").is_file()])
    known = rows.drop_nulls("trained_on").group_by("run", "run_seed", maintain_order=True)
    homes = known.agg(home=pl.col("run_dir").unique(maintain_order=True), their_tasks=pl.col("trained_on").first())
    rows = rows.join(homes, on=["run", "run_seed"], how="left", maintain_order="left")
    num_homes = pl.col("home").list.len()
    several = rows.filter(outside, num_homes > 1).select("run_dir", "run", "run_seed", num=num_homes)
    problems = [
        f"{run_dir}: has episodes of {run}, training seed {seed}, of which there are {num} run directories; they are "
        "taken for those of another run; put their file into the directory of theirs"
        for run_dir, run, seed, num in several.unique(maintain_order=True).iter_rows()
    ]
    found = outside & (num_homes == 1)
    homeless = outside & num_homes.is_null() & pl.col("params").is_not_null()
    first = pl.col("run_dir").first().over("run", "run_seed", "scenario")
    rows = rows.with_columns(
        run_dir=pl.when(found).then(pl.col("home").list.first()).when(homeless).then(first).otherwise("run_dir"),
        trained_on=pl.when(found).then("their_tasks").otherwise("trained_on"),
    )
    return rows.drop("home", "their_tasks"), problems


def _is_of_run(file: Path) -> bool:
    return (file.parent / "config.json").is_file()


def evaluation_files(paths: Iterable[Path | str]) -> list[Path]:
    """Files that may hold evaluation records, each once, in order.

    Raises:
        ConfigError: a path does not exist.
    """
    found: dict[Path, Path] = {}
    for path in map(Path, paths):
        if not path.exists():
            raise ConfigError(f"{path}: no such file or directory; want record files or directories that hold some")
        for file in [path] if path.is_file() else files_below(path, "*.jsonl*"):
            if path.is_file() or (_may_be_evaluation(file) and not is_in_folder_of_run(file, path, _NOT_RECORDS)):
                found.setdefault(file.resolve(), file)
    return list(found.values())


def _may_be_evaluation(file: Path) -> bool:
    training = {name.removesuffix(".jsonl") for name in (*RECORD_FILES, START_RECORDS)}
    return file.name.endswith(SUFFIXES) and file.name.partition(".")[0] not in training


def is_in_folder_of_run(file: Path, below: Path, names: Collection[str]) -> bool:
    """Whether a run directory in `below` has a folder of one of these names that the file is in. Other folders may be
    called so: that of the runs of `gvz train --name work`.
    """
    folders = file.relative_to(below).parents
    return any(folder.name in names and (below / folder.parent / "config.json").is_file() for folder in folders)


def _read_file(file: Path) -> tuple[pl.DataFrame, list[str]]:
    found, problems = records.read(file)
    rows = []
    for number, row in enumerate(found, 1):
        if wrong := _what_is_wrong(row):
            problems.append(f"{file}, row {number}: {wrong}")
        else:
            rows.append(row)
    problems = _collapsed(problems)
    columns = {name: pl.Series(name, [row.get(name) for row in rows], dtype) for name, dtype in _FIELDS.items()}
    components = sorted({name for row in rows for name in row.get("reward_components", {})})
    if len(components) > MAX_COMPONENTS:
        problems.append(
            f"{file}: got {len(components)} reward components, want at most {MAX_COMPONENTS}; none is shown"
        )
        components = []
    for name in components:
        values = [row.get("reward_components", {}).get(name) for row in rows]
        columns[REWARD_PREFIX + name] = pl.Series(values, dtype=pl.Float64)
    trained_on, trouble = _trained_on(file.parent)
    frame = pl.DataFrame(columns).with_columns(
        run_dir=pl.when(pl.col("run").is_not_null()).then(pl.lit(str(file.parent))),
        trained_on=pl.when(pl.col("run").is_not_null()).then(pl.lit(trained_on, pl.List(pl.String()))),
        truncated=pl.coalesce("truncated", ~pl.col("terminated")),
        base_seed=pl.col("base_seed").fill_null(0),
    )
    tasks, unknown = _task_columns(frame)
    problems += [f"{file}: {message}" for message in (*trouble, *unknown)]
    frame = frame.join(tasks, on=["task", "profile"], how="left", nulls_equal=True)
    percent = normalize(pl.col("score"), pl.col("bound"))
    return frame.with_columns(normalized_score=pl.coalesce("normalized_score", percent)).drop("bound"), problems


_FIELDS = REQUIRED | OPTIONAL


def _what_is_wrong(row: dict[str, Any]) -> str | None:
    for name, dtype in _FIELDS.items():
        value = row.get(name)
        if value is None:
            if name in REQUIRED:
                return f"no {name}, not a row of an evaluation"
        elif not fits(value, dtype):
            return f"{name} is {value!r}, want {dtype}"
    components = row.get("reward_components", {})
    is_map = isinstance(components, dict)
    if not is_map or not all(fits(n, pl.String()) and fits(v, pl.Float64()) for n, v in components.items()):
        return f"reward_components is {components!r:.200}, want name -> number"
    return None


def fits(value: Any, dtype: pl.DataType) -> bool:
    """Whether a value of JSON has a place in a column of texts, booleans, or finite numbers of 64 bits."""
    if type(value) not in _PYTHON_TYPES[type(dtype)]:
        return False
    if isinstance(value, str):
        # no file can hold halves of a pair
        return value.isascii() or not any("\ud800" <= letter <= "\udfff" for letter in value)
    return -(2**63) <= value < 2**63 if isinstance(value, int) else math.isfinite(value)


def _collapsed(problems: Sequence[str]) -> list[str]:
    """One message for all lines of a file that have the same fault."""
    alike: dict[str, list[str]] = {}
    for problem in problems:
        alike.setdefault(problem.rpartition(": ")[2], []).append(problem)
    return [first if not more else f"{first}; and {len(more)} more such lines" for first, *more in alike.values()]


def _trained_on(directory: Path) -> tuple[list[str] | None, list[str]]:
    """Ids of the tasks that the run in this directory was trained on, and what is wrong with its config.json."""
    file = directory / "config.json"
    try:
        tasks = json.loads(file.read_text())["resolved"]["tasks"]
        if not isinstance(tasks, list) or not all(fits(task, pl.String()) for task in tasks):
            raise ValueError("resolved.tasks: want a list of task ids")
    except FileNotFoundError:
        return None, []
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        return None, [
            f"its config.json cannot be read ({type(error).__name__}: {error}); what it was trained on is lost"
        ]
    return tasks, []


def _task_columns(frame: pl.DataFrame) -> tuple[pl.DataFrame, list[str]]:
    """What follows from a task's id, for each task and profile of the frame, and which tasks are unknown."""
    problems, rows = [], []
    for task_id, profile, num_rows in frame.group_by("task", "profile", maintain_order=True).len().iter_rows():
        task = _known_task(task_id)
        if isinstance(task, str):
            problems.append(f"{task}; its {num_rows} rows have no level")
            rows.append((task_id, profile, task_id.partition("/")[0], None, None, None))
            continue
        bound = task.scenario.upper_bounds.get("levdoom" if profile == "levdoom" else "thesis")
        rows.append((task_id, profile, task.scenario.id, task.level, list(task.attributes), bound))
    schema = {
        "task": pl.String(),
        "profile": pl.String(),
        **{n: DERIVED[n] for n in ("scenario", "level", "attributes")},
        "bound": pl.Float64(),
    }
    return pl.DataFrame(rows, schema, orient="row"), problems


@cache
def _known_task(task_id: str) -> Task | str:
    """The task, or why there is none."""
    try:
        return parse_task(task_id)
    except TaskError as error:
        return str(error)
