"""Evaluations on disk: episodes are played and appended to a record file. Those already there are not played again."""

import contextlib
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from gvz.core import records
from gvz.core.env_config import EnvConfig
from gvz.core.errors import ConfigError
from gvz.core.stop import StopRequest
from gvz.evaluation.play import Episode, PlayerSpec, Row, play
from gvz.evaluation.players import CLASSES, Player
from gvz.evaluation.simple import SIMPLE_PLAYERS, SimplePlayerName, player_env
from gvz.tasks import Task, id_for_processes, parse_task

_ANOTHER_FILE = "move the file aside or give another with --out"


def row_identity(player: Mapping[str, Any], env: EnvConfig) -> dict[str, Any]:
    """The fields that distinguish the rows of one evaluation from others in the same file: the player's, `player` among
    them, and the rules in `env`. Sizes are left out: they are part of the player.
    """
    rules = {name: getattr(env, name) for name in ("profile", "action_set", "frame_skip")}
    return {**player, **rules}


def _observes(env: EnvConfig) -> dict[str, str]:
    """The field `observes` of a player that has more or other than the screen; nothing for one that has it alone."""
    frames = [" ".join((env.frames, env.segmenter)).strip()] if env.frames != "screen" else []
    more = [*frames, *env.buffers, *(["sight"] if env.sight else [])]
    return {"observes": ", ".join(more)} if more else {}


def simple_player(name: SimplePlayerName, env: EnvConfig) -> PlayerSpec:
    """A simple player under the rules of `env`."""
    env = player_env(name, env)
    identity = row_identity({"player": name}, env)
    return PlayerSpec(make_player=CLASSES[name], env=env, identity=identity, recycle_episodes=0)


def wanted_episodes(tasks: Sequence[Task], episodes: int, base_seeds: Sequence[int] = (0,)) -> list[Episode]:
    """Episodes 0 .. episodes - 1 of each task and base seed."""
    return [Episode(task.id, n, base) for task in tasks for base in base_seeds for n in range(episodes)]


def rows_of(player_spec: PlayerSpec, rows: Iterable[Row]) -> dict[Episode, Row]:
    """The rows of a record file that are this player_spec's. Rows older than base seeds are of base seed 0."""
    mine, observes = player_spec.identity.items(), player_spec.identity.get("observes")
    found: dict[Episode, Row] = {}
    for r in rows:  # of two rows of one episode, the first counts
        if mine <= r.items() and r.get("observes") == observes:
            found.setdefault(Episode(r["task"], r["episode"], r.get("base_seed", 0)), r)
    return found


def read_rows(file: Path) -> list[Row]:
    """The rows of a record file; none if there is no file yet. A half-written last row is cut off.

    Raises:
        ConfigError: a line that is damaged or of another schema.
    """
    if not file.exists():
        return []
    if line := records.cut_half_row(file):  # somebody's text: not a byte of it is ours to cut
        raise ConfigError(f"{file}, last line: got {line[:20]!r}, no row of an evaluation; {_ANOTHER_FILE}")
    rows, problems = records.read(file)
    for number, row in enumerate(rows, 1):
        episode = row.get("task"), row.get("episode"), row.get("base_seed", 0)
        if tuple(map(type, episode)) != (str, int, int):
            problems.append(f"{file}, row {number}: got task, episode and base seed {episode}: no row of an evaluation")
    if problems:
        raise ConfigError(f"{problems[0]}; {_ANOTHER_FILE}")
    return rows


class RecordFile(records.Writer):
    """A record file that this process alone appends to."""

    def __init__(self, path: Path):
        """Opens (or creates) the file and reads the rows it holds.

        Raises:
            ConfigError: it cannot be opened, another process uses it, or it holds something else.
        """
        super().__init__(path)
        if path.suffix == ".gz":
            raise ConfigError(f"--out: got {path}, want a name without .gz: rows are appended as plain text")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.exists() and not path.is_file() and str(path) != os.devnull:
                raise ConfigError(f"--out: {path} is no regular file; want a file that rows can be read back from")
            locked = self.lock()
        except OSError as error:
            raise ConfigError(f"--out: {path} cannot be written: {error.strerror}") from error
        try:
            if not locked:
                raise ConfigError(f"--out: {path} is being written by another process")
            self.rows = read_rows(path)
        except ConfigError:
            self.close()
            raise

    def append(self, row: Row) -> None:
        """Writes a row and flushes it.

        Raises:
            GvzError: the disk is full, and too many rows wait in memory.
        """
        super().append(row)
        self.rows.append({"schema": records.SCHEMA, **row})


def missing_jobs(
    player_spec: PlayerSpec, file: RecordFile, episodes: Iterable[Episode]
) -> list[tuple[PlayerSpec, Episode]]:
    """What of `episodes` the player's file does not hold yet."""
    return [(player_spec, episode) for episode in set(episodes) - rows_of(player_spec, file.rows).keys()]


def play_and_record(
    player_specs: Mapping[PlayerSpec, RecordFile],
    jobs: Iterable[tuple[PlayerSpec, Episode]],
    *,
    num_workers: int,
    stop: StopRequest | None = None,
) -> Iterator[Row]:
    """Plays episodes; each row is on disk before it is yielded.

    Raises:
        KeyboardInterrupt: `stop` was requested.
        GvzError: an episode could not be played.
    """
    for player_spec, row in play(jobs, num_workers=num_workers, stop=stop):
        player_specs[player_spec].append({**player_spec.identity, **row})
        yield player_specs[player_spec].rows[-1]


def evaluate_player(
    make_player: Callable[[], Player],
    tasks: Task | str | Sequence[Task | str],
    out: Path | str,
    *,
    name: str,
    episodes: int = 100,
    base_seed: int = 0,
    env: EnvConfig | None = None,
    num_workers: int = 0,
) -> list[Row]:
    """Evaluates any player by the benchmark's protocol. A second call resumes what was stopped: episodes that the file
    holds under this name are not played again, and a line on stderr says how many these are.

    Args:
        make_player: makes it, in each process that plays; picklable unless `num_workers` is 0.
        tasks: tasks or their ids, or one of them.
        out: record file, JSON lines; may hold other players' rows too.
        name: of the player, unique in the file: with agent, seed and checkpoint. What is trained again, or changed,
            needs another one. Those of the simple players ("random", ...) are theirs alone.
        episodes: of each task.
        base_seed: another one draws other episodes; comparisons use 0.
        env: what it plays in; default the thesis's. Actions are not repeated by chance, whatever it says.
        num_workers: processes that play; 0 plays in this one.

    Returns:
        The rows of all these episodes, by task and episode, with those that the file held before.

    Raises:
        ConfigError, TaskError: an unknown task, one that only this process knows, no task or episode, a name or base
            seed that is none, or a file that cannot be written.
        GvzError: an episode could not be played.
    """
    if not name.strip() or name in SIMPLE_PLAYERS:
        raise ConfigError(
            f"evaluate_player: name: got {name!r}, want a name of its own, not {', '.join(SIMPLE_PLAYERS)}"
        )
    if episodes < 1 or not 0 <= base_seed < 2**63:  # what a report reads
        raise ConfigError(
            f"evaluate_player: got {episodes} episodes, base_seed {base_seed}; want 1 or more, a seed of 0 to 2^63 - 1"
        )
    tasks = [tasks] if isinstance(tasks, Task | str) else tasks
    if not tasks:
        raise ConfigError("evaluate_player: tasks: got none, want at least one")
    env = EnvConfig() if env is None else env
    identity = row_identity({"player": name}, env) | _observes(env)
    player_spec = PlayerSpec(make_player=make_player, env=env, identity=identity)
    parsed = [parse_task(id_for_processes(task)) for task in tasks]
    wanted = wanted_episodes(parsed, episodes, [base_seed])
    with contextlib.closing(RecordFile(Path(out))) as file:
        jobs, num_wanted = missing_jobs(player_spec, file, wanted), len(set(wanted))
        if held := num_wanted - len(jobs):
            note = f"{out}: holds {held} of these {num_wanted} episodes of {name!r}, which are not played again"
            print(f"{note}; another player needs another name", file=sys.stderr)
        for _ in play_and_record({player_spec: file}, jobs, num_workers=num_workers):
            pass
    found = rows_of(player_spec, file.rows)
    return [found[episode] for episode in wanted]
