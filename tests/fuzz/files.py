"""Fuzz targets: what is read from a disk. Configurations, records, run directories, plans, the janitor's records.

Imports gvz; the examples are committed results.
"""

import contextlib
import gzip
import itertools
import json
import os
from pathlib import Path

from actors.config import MAX_LANES
from gvz.commands.export import run_table, write_table
from gvz.core import janitor
from gvz.core.env_config import EnvConfig
from gvz.core.errors import ConfigError, ResumeError
from gvz.core.records import SCHEMA, read
from gvz.evaluation.dataset import OPTIONAL, REQUIRED, collect_evaluations
from gvz.evaluation.episode_log import read_rows, rows_of, simple_player
from gvz.evaluation.trained import read_run_config
from gvz.experiments.inventory import last_update, missing_player_episodes
from gvz.experiments.plan import Evaluation, read_plan, write_plan
from gvz.reports.results import read_results
from gvz.reports.run_section import run_sections
from gvz.run.config_files import config_from_dict, config_to_dict, load_config
from gvz.run.resume import differences
from gvz.run.rundir import RECORD_FILES, RunDir
from tests.fuzz.target import Target

RESULTS = Path(__file__).parents[2] / "results"
QUICK = RESULTS / "rainbow_quick" / "seed_1111"
JSON_WORDS = rb'NaN Infinity -1e999 1e300 null true "\ud800" "\u0000" {} []'.split()
JSON_WORDS += [b"9" * 30, b"[" * 2000, b'{"a":' * 2000, b'"schema": 2', b", ", b": ", b"\n", b"\xff"]


def _examples(name: str, num_lines: int = 3) -> bytes:
    """The first lines of a committed record file."""
    with gzip.open(QUICK / f"{name}.jsonl.gz", "rb") as stream:
        return b"".join(itertools.islice(stream, num_lines))


CONFIG_JSON = (QUICK / "config.json").read_bytes()
PLAN_JSON = b"""{
  "schema": 2,
  "scale": 0.5,
  "experiments": {"quick_comparison": null, "general_long": ["defend_the_center", "seek_and_kill"]}
}"""


def saved_config(directory: Path) -> Target:
    """A run's config.json: for the trainer that would go on, and for evaluation."""
    default = load_config("rainbow_4task")

    def run(data: bytes) -> bool:
        with RunDir(directory) as opened:
            (directory / "config.json").write_bytes(data)
            try:
                config = opened.saved_config()
            except ResumeError:
                config = None
        if config is None:
            try:
                read_run_config(directory)
            except ConfigError:
                return False
            raise AssertionError("evaluation takes what the trainer refuses")
        assert config.num_lanes <= MAX_LANES
        assert differences(config_from_dict(json.loads(json.dumps(config_to_dict(config)))), config) == []
        assert all(isinstance(line, str) for line in differences(default, config))
        with contextlib.suppress(ConfigError):  # an agent in a file
            assert read_run_config(directory) == config
        return True

    fresh = [json.dumps(config_to_dict(load_config(name))).encode() for name in ("rainbow_4task", "dqn_4task")]
    keys = [
        json.dumps(key).encode() for key in sorted({*config_to_dict(default)["config"], "v_min", "num_actors", "tasks"})
    ]
    return Target(run=run, seeds=[CONFIG_JSON, *fresh], words=[*JSON_WORDS, *keys, b"64", b'"sync"', b'"x.py"'])


def records(directory: Path) -> Target:
    """A record file, plain and compressed."""

    def run(data: bytes) -> bool:
        taken = False
        for name in ("rows.jsonl", "rows.jsonl.gz"):
            file = directory / name
            file.write_bytes(data)
            rows, problems = read(file)
            assert all(isinstance(row, dict) and row["schema"] == SCHEMA for row in rows)
            assert all(problem.startswith(str(file)) for problem in problems)
            if name == "rows.jsonl" and data:
                assert rows or problems, "bytes were passed over without a word"
            taken |= bool(rows)
        return taken

    plain = [_examples(name) for name in ("metrics", "episodes")]
    return Target(run=run, seeds=[*plain, *(gzip.compress(rows, mtime=0) for rows in plain)], words=JSON_WORDS)


def evaluation_records(directory: Path) -> Target:
    """Evaluation episodes: to be shown, and to be added to."""
    file = directory / "evaluation.jsonl"
    player_spec = simple_player("random", EnvConfig())

    def run(data: bytes) -> bool:
        file.write_bytes(data)
        frame, problems = collect_evaluations([file])
        assert {name: frame.schema[name] for name in REQUIRED | OPTIONAL} == REQUIRED | OPTIONAL
        assert frame.select(list(REQUIRED)).null_count().sum_horizontal().item() == 0
        assert frame["score"].is_finite().all()
        assert not data.strip() or len(frame) or problems, "bytes were passed over without a word"
        write_table(frame, directory / "table.csv")
        try:
            rows = read_rows(file)
        except ConfigError:
            assert file.read_bytes() == data or b'{"schema": '.startswith(data[data.rfind(b"\n") + 1 :][:11])
            return False
        kept = file.read_bytes()
        assert data.startswith(kept)
        assert kept[-1:] in (b"", b"\n")
        assert len(rows_of(player_spec, rows)) <= len(rows)
        return True

    seeds = [_examples("evaluation"), _examples("../evaluation_random"), _examples("evaluation")[:-9]]
    keys = [json.dumps(name).encode() + b": " for name in (*REQUIRED, *OPTIONAL, "reward_components")]
    return Target(run=run, seeds=seeds, words=[*JSON_WORDS, *keys])


def run_directory(directory: Path) -> Target:
    """A directory of results as a report, an export and the experiments' status read it."""
    results = directory / "results"
    run_dir = results / "runs" / "quick"
    run_dir.mkdir(parents=True, exist_ok=True)
    names = ("config.json", "metrics.jsonl", "episodes.jsonl", "evaluation.jsonl", "faults.jsonl", "starts.jsonl")
    between = b"\n%%%%\n"

    def run(data: bytes) -> bool:
        pieces = data.split(between)
        for name, piece in itertools.zip_longest(names, pieces[: len(names)]):
            (run_dir / name).unlink(missing_ok=True)
            if piece is not None:
                (run_dir / name).write_bytes(piece)
        found = read_results([results])
        assert len(found.runs) <= 1
        assert found.runs or found.problems
        assert len(run_sections(found, directory / "report")) >= 1
        for name in RECORD_FILES:
            with contextlib.suppress(ConfigError):
                write_table(run_table([run_dir], name, []), directory / "table.csv")
        assert last_update(run_dir) >= 0
        missing_player_episodes(run_dir / "evaluation.jsonl", Evaluation(tasks=("a/b",), episodes=2))
        return bool(found.runs)

    start = b'{"schema": 1, "num_updates": 0, "time_s": 1.5, "cpu": "x", "cores": 2, "versions": {"jax": "1"}}\n'
    fault = b'{"schema": 1, "num_updates": 3, "time_s": 2.5, "actor": 0, "lane": null, "kind": "k", "message": "m"}\n'
    rows = [_examples(name, 2) for name in ("metrics", "episodes", "evaluation")]
    whole = between.join([CONFIG_JSON, *rows, fault, start])
    return Target(
        run=run,
        seeds=[whole, between.join([CONFIG_JSON, *rows])],
        words=[*JSON_WORDS, b'"num_updates": ', b'"total_updates": ', b'"tasks": ', between],
        max_bytes=16384,
        num_inputs=100,
    )


def plan(directory: Path) -> Target:
    """What experiments were asked for."""

    def run(data: bytes) -> bool:
        (directory / "plan.json").write_bytes(data)
        try:
            found = read_plan(directory)
        except ConfigError:
            return False
        assert found is not None
        assert write_plan(directory, found) == found
        assert read_plan(directory) == found
        return True

    return Target(run=run, seeds=[PLAN_JSON], words=[*JSON_WORDS, b'"quick_comparison"', b"0.001", b'"scale": '])


def janitor_record(directory: Path) -> Target:
    """A record of a thing that may be removed, and an engine's instance file beside it."""
    runtime, shm = directory / "runtime", directory / "shm"
    for folder in (runtime, shm):
        folder.mkdir(mode=0o700, exist_ok=True)
    engine = directory / f"{janitor.PREFIX}x"
    precious = directory / "precious"
    precious.write_text("")

    def run(data: bytes) -> bool:
        record, _, instance = data.partition(b"\n%%%%\n")
        environment, shm_directory = os.environ.get("GVZ_RUNTIME_DIR"), janitor.SHM_DIR
        os.environ["GVZ_RUNTIME_DIR"], janitor.SHM_DIR = str(runtime), shm
        try:
            (janitor.runtime_dir() / "gvz-engine-x.json").write_bytes(record)
            engine.mkdir(exist_ok=True)
            (engine / janitor.INSTANCE_FILE).write_bytes(instance)
            dead = janitor.dead_instances()
            if all(not name.startswith("/") or Path(name) == engine for name in dead):  # not what is really there
                done = janitor.clean_dead_instances()
                assert dead or not record or all(line.startswith("left alone") for line in done)
                assert precious.exists()
            return bool(dead)
        finally:
            janitor.SHM_DIR = shm_directory
            os.environ.pop("GVZ_RUNTIME_DIR")
            if environment is not None:
                os.environ["GVZ_RUNTIME_DIR"] = environment

    def record(name: str) -> bytes:
        return json.dumps({"directory": name, "owner_pid": 1}).encode()

    seeds = [record(str(engine))]
    seeds += [record(str(engine)) + b"\n%%%%\n" + instance for instance in (b"1 2 Abc\n", b"1 2 ../x\n")]
    return Target(run=run, seeds=seeds, words=[*JSON_WORDS, b'"engine"', b'"directory"', b"../", b"/", b"9" * 400])
