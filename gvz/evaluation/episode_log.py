"""Evaluations on disk: episodes are played and appended to a record file. Those already there are not played again."""

import fcntl
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from gvz.core.env_config import EnvConfig, SimplePlayer
from gvz.core.errors import ConfigError
from gvz.evaluation.play import Episode, PlayerSpec, Row, play
from gvz.evaluation.players import SIMPLE_PLAYERS, Player, player_env
from gvz.run.rundir import RECORDS_SCHEMA, read_records
from gvz.tasks import Task, parse_task

_ROW_BEGINS = b'{"schema": '
_ANOTHER_FILE = "move the file aside or give another with --out"


def row_identity(player: Mapping[str, Any], env: EnvConfig) -> dict[str, Any]:
    """What tells one evaluation's rows from another's in the same file: who played, and by which rules.

    Args:
        player: fields that name the player, `player` among them.
        env: what it plays in. Sizes are left out: nobody's score depends on what it does not look at.
    """
    rules = {name: getattr(env, name) for name in ("profile", "action_set", "frame_skip")}
    return {**player, **rules}


def simple_player(kind: SimplePlayer, env: EnvConfig) -> PlayerSpec:
    """A random, idle or scripted player under the rules of `env`."""
    env = player_env(kind, env)
    return PlayerSpec(
        make_player=SIMPLE_PLAYERS[kind],
        env=env,
        identity=row_identity({"player": kind}, env),
        recycle_episodes=0,
    )


def wanted_episodes(tasks: Sequence[Task], episodes: int, base_seeds: Sequence[int] = (0,)) -> list[Episode]:
    """Episodes 0 .. episodes - 1 of each task and base seed."""
    return [Episode(task.id, n, base) for task in tasks for base in base_seeds for n in range(episodes)]


def rows_of(player_spec: PlayerSpec, rows: Iterable[Row]) -> dict[Episode, Row]:
    """The rows of a record file that are this player_spec's. Rows older than base seeds are of base seed 0."""
    mine = player_spec.identity.items()
    return {Episode(r["task"], r["episode"], r.get("base_seed", 0)): r for r in rows if mine <= r.items()}


def read_rows(file: Path) -> list[Row]:
    """The rows of a record file; none if there is no file yet. A half-written last row is cut off.

    Raises:
        ConfigError: a line that is damaged or of another schema.
    """
    if not file.exists():
        return []
    data = file.read_bytes()
    end = data.rfind(b"\n") + 1
    half = data[end:]
    if not half.startswith(_ROW_BEGINS[: len(half)]):  # somebody's text: not a byte of it is ours to cut
        raise ConfigError(f"{file}, last line: got {half[:20]!r}, no row of an evaluation; {_ANOTHER_FILE}")
    with file.open("r+b") as stream:
        stream.truncate(end)
    rows, problems = read_records(file)
    for number, row in enumerate(rows, 1):
        episode = row.get("task"), row.get("episode"), row.get("base_seed", 0)
        if tuple(map(type, episode)) != (str, int, int):
            problems.append(f"{file}, row {number}: got task, episode and base seed {episode}: no row of an evaluation")
    if problems:
        raise ConfigError(f"{problems[0]}; {_ANOTHER_FILE}")
    return [_at_most_the_bound(row) for row in rows]


def _at_most_the_bound(row: Row) -> Row:
    """The row; one with a score above the upper bound, as older rows of Seek and Kill have it, at the bound."""
    score, percent = row.get("score"), row.get("normalized_score")
    if not isinstance(score, float) or not isinstance(percent, float) or percent <= 100:
        return row
    return {**row, "score": 100 * score / percent, "normalized_score": 100.0}


class RecordFile:
    """A record file that this process alone appends to."""

    def __init__(self, path: Path):
        """Opens (or creates) the file and reads the rows it holds.

        Raises:
            ConfigError: it cannot be opened, another process uses it, or it holds something else.
        """
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._stream = path.open("a")
            fcntl.flock(self._stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            self._stream.close()
            raise ConfigError(f"--out: {path} is being written by another process") from error
        except OSError as error:
            raise ConfigError(f"--out: {path} cannot be written: {error.strerror}") from error
        try:
            self.rows = read_rows(path)
        except ConfigError:
            self.close()
            raise

    def append(self, row: Row) -> None:
        """Writes a row and flushes it."""
        self._stream.write(json.dumps({"schema": RECORDS_SCHEMA, **row}) + "\n")
        self._stream.flush()
        self.rows.append({"schema": RECORDS_SCHEMA, **row})

    def close(self) -> None:
        """Closes the file and gives it free."""
        self._stream.close()


def missing_jobs(
    player_specs: Mapping[PlayerSpec, RecordFile], episodes: Sequence[Episode]
) -> list[tuple[PlayerSpec, Episode]]:
    """What of `episodes` each player_spec's file does not hold yet."""
    return [
        (player_spec, episode)
        for player_spec, file in player_specs.items()
        for episode in dict.fromkeys(episodes).keys() - rows_of(player_spec, file.rows).keys()
    ]


def play_and_record(
    player_specs: Mapping[PlayerSpec, RecordFile], jobs: Iterable[tuple[PlayerSpec, Episode]], *, num_workers: int
) -> Iterator[Row]:
    """Plays episodes; each row is on disk before it is yielded.

    Raises:
        GvzError: an episode could not be played.
    """
    for player_spec, row in play(jobs, num_workers=num_workers):
        player_specs[player_spec].append({**player_spec.identity, **row})
        yield player_specs[player_spec].rows[-1]


def evaluate_player(
    make_player: Callable[[], Player],
    tasks: Sequence[Task | str],
    out: Path | str,
    *,
    name: str,
    episodes: int = 100,
    base_seed: int = 0,
    env: EnvConfig | None = None,
    num_workers: int = 0,
) -> list[Row]:
    """Evaluates any player by the benchmark's protocol; called again, it goes on where it was stopped.

    Args:
        make_player: makes it, in each process that plays; picklable unless `num_workers` is 0.
        tasks: tasks or their ids.
        out: record file, JSON lines; may hold other players' rows too.
        name: of the player; say in it what tells it from others in the same file (agent, seed, checkpoint).
        episodes: of each task.
        base_seed: draws another set of episodes; 0 is the one that everybody is compared on.
        env: what it plays in; default the thesis's.
        num_workers: processes that play; 0 plays in this one.

    Returns:
        All rows asked for, by task and episode, those that the file held before too.

    Raises:
        ConfigError, TaskError: an unknown task, or a file that cannot be written.
        GvzError: an episode could not be played.
    """
    env = EnvConfig() if env is None else env
    player_spec = PlayerSpec(make_player=make_player, env=env, identity=row_identity({"player": name}, env))
    parsed = [parse_task(task) if isinstance(task, str) else task for task in tasks]
    wanted = wanted_episodes(parsed, episodes, [base_seed])
    file = RecordFile(Path(out))
    try:
        player_specs = {player_spec: file}
        for _ in play_and_record(player_specs, missing_jobs(player_specs, wanted), num_workers=num_workers):
            pass
    finally:
        file.close()
    held = rows_of(player_spec, file.rows)
    return [held[episode] for episode in wanted]
