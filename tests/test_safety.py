"""What comes from a file or a peer is never executed, and what a run makes is its user's alone."""

import ast
import gzip
import json
import os
import pickle
import stat
import threading
import time
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import jax
import numpy as np
import pytest
import vizdoom

from gvz.core import janitor
from gvz.core.errors import CheckpointError, ConfigError, EngineError, GvzError
from gvz.engine.probe import probe_wad
from gvz.evaluation.dataset import collect_evaluations
from gvz.evaluation.episode_log import read_rows
from gvz.evaluation.trained import trained_player
from gvz.reports.results import read_results
from gvz.run.config import RunConfig
from gvz.run.config_files import config_to_dict
from gvz.run.rundir import RunDir
from gvz.run.telemetry import Telemetry
from gvz.wad.acs import compile_acs
from gvz.wad.lumps import Lump, read_wad, write_wad
from learner import checkpoint
from tests.learner.test_checkpoint import forged
from tests.waiting import wait_until

ROOT = Path(__file__).parent.parent
MODULES = sorted(file for package in ("gvz", "actors", "learner", "configs") for file in (ROOT / package).rglob("*.py"))
STOCK_WAD = Path(vizdoom.scenarios_path) / "defend_the_center.wad"

UNPICKLERS = {"pickle", "_pickle", "cPickle", "cloudpickle", "dill", "joblib", "marshal", "shelve", "yaml", "torch"}
EXECUTORS = {"eval", "exec", "compile", "__import__", "os.system", "os.popen"}
EXECUTING_METHODS = {"import_module", "exec_module", "load_module", "run_path", "run_module"}
ALLOWED = {
    ("gvz/run/config_files.py", "exec"): "a config file, which the user names",
    ("gvz/run/config_files.py", "compile"): "likewise",
    ("gvz/core/registry.py", "exec_module"): "the file of an agent or an encoder, which the user names",
    ("gvz/engine/tuned/build_vizdoom.py", "import_module"): "setuptools, which pip brings where the engine is built",
    ("gvz/core/registry.py", "import_module"): "modules of our own packages, found on the disk",
    ("actors/loop.py", "import_module"): "the environment's class, which the learner names to the actor it started",
}
PROCESS_POOLS = {
    "gvz/evaluation/workers.py": "starts the workers of the two below",
    "gvz/evaluation/play.py": "pickles what the parent gives to the workers it started, and their rows",
    "gvz/evaluation/segmentation.py": "pickles what the parent gives to the workers it started, and their batches",
}
SERVERS = {"bind", "listen", "create_server", "start_server", "serve_forever", "start_unix_server"}


def called(node: ast.Call) -> str:
    """The last name of what is called: `c` of `a.b.c(...)`."""
    match node.func:
        case ast.Attribute(attr=name) | ast.Name(id=name):
            return name
        case _:
            return ""


@cache
def nodes(file: Path) -> list[ast.AST]:
    return list(ast.walk(ast.parse(file.read_text())))


def calls(file: Path) -> Iterator[tuple[str, ast.Call]]:
    for node in nodes(file):
        if isinstance(node, ast.Call):
            yield called(node), node


def imported(file: Path) -> set[str]:
    """First parts of the names of imported modules."""
    names: set[str] = set()
    for node in nodes(file):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {node.module or ""}
    return {name.partition(".")[0] for name in names}


@pytest.mark.parametrize("file", MODULES, ids=lambda file: str(file.relative_to(ROOT)))
def test_nothing_is_unpickled_or_executed_but_what_the_user_names(file: Path):
    where = str(file.relative_to(ROOT))
    assert not imported(file) & UNPICKLERS
    if imported(file) & {"multiprocessing", "concurrent"}:
        assert where in PROCESS_POOLS
    for name, call in calls(file):
        keywords = {keyword.arg: keyword.value for keyword in call.keywords}
        if name in EXECUTING_METHODS or ast.unparse(call.func) in EXECUTORS:
            assert (where, name) in ALLOWED, f"{where}:{call.lineno}: {ast.unparse(call)[:80]}"
        for dangerous in ("allow_pickle", "shell"):
            assert dangerous not in keywords, f"{where}:{call.lineno}: {dangerous}"


def test_the_list_of_exceptions_has_no_more_than_there_are():
    there = {(str(file.relative_to(ROOT)), name) for file in MODULES for name, _ in calls(file)}
    assert set(ALLOWED) <= there


LISTENER = ROOT / "gvz" / "run" / "relay.py"


@pytest.mark.parametrize("file", MODULES, ids=lambda file: str(file.relative_to(ROOT)))
def test_nothing_listens_on_a_network(file: Path):
    """The one socket there is connects a learner to its own actor. A group of learner processes listens where the user
    says (`--group.coordinator`), in one file.
    """
    if file == LISTENER:
        return
    assert not imported(file) & {"http", "socketserver", "xmlrpc", "ssl"}
    for name, call in calls(file):
        assert name not in SERVERS or "inspect.signature(" in ast.unparse(call.func), f"{file}:{call.lineno}"
        if name == "socket":
            assert [keyword.arg for keyword in call.keywords] == ["fileno"], "a socket that it was handed"
        if name == "socketpair":
            assert ast.unparse(call.args[0]) == "socket.AF_UNIX"


# ------------------------------------------------------------------------------------------------------- private


CONFIG = RunConfig(name="small", seed=7)


@pytest.fixture
def open_umask() -> Iterator[None]:
    """A user who lets everybody read and write what he makes."""
    before = os.umask(0)
    yield
    assert os.umask(before) == 0, "a run directory that was closed gives the umask back"


def modes(directory: Path) -> dict[str, int]:
    return {str(path.relative_to(directory)): stat.S_IMODE(path.stat().st_mode) for path in directory.rglob("*")}


@pytest.mark.usefixtures("open_umask")
def test_a_run_directory_and_all_in_it_are_private_whatever_the_umask(tmp_path: Path):
    tree = {"w": np.ones(3, np.float32)}
    with RunDir(tmp_path / "run") as run:
        run.write_config(CONFIG)
        run.append("metrics.jsonl", {"num_updates": 1})
        lengths = run.record_lengths()
        run.append("metrics.jsonl", {"num_updates": 2})
        run.truncate_records(lengths)
        saver = checkpoint.Checkpointer(run.path, keep=1)
        saver.save(1, tree, tree, {"num_updates": 1})
        saver.wait()
        assert saver.outcome() == ""
        telemetry = Telemetry(run, CONFIG.table, CONFIG.log, 0)
        telemetry.scalars(1, {"learner/loss": 1.0})
        telemetry.close()
    found = modes(tmp_path)
    assert {"run", "run/discarded", "run/tensorboard", "run/checkpoints/1/arrays"} <= set(found)
    assert {"run/lock", "run/config.json", "run/metrics.jsonl", "run/policies/1/host.msgpack"} <= set(found)
    open_to_others = {name: oct(mode) for name, mode in found.items() if mode & 0o077}
    assert open_to_others == {}


@pytest.mark.usefixtures("open_umask")
def test_private_directories_and_the_records_of_them_are_private_whatever_the_umask(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    tmp_path.chmod(0o700)
    monkeypatch.setenv("GVZ_RUNTIME_DIR", str(tmp_path))
    with janitor.temporary_directory() as directory:
        assert stat.S_IMODE(directory.stat().st_mode) == 0o700
        assert set(modes(tmp_path).values()) == {0o700, 0o600}


# ------------------------------------------------------------------------------------------------- from strangers


class Bomb:
    """Makes a file when it is unpickled."""

    def __init__(self, mark: Path):
        self._mark = mark

    def __reduce__(self):
        return Path.touch, (self._mark,)


def test_a_bomb_goes_off_when_it_is_unpickled(tmp_path: Path):
    pickle.loads(pickle.dumps(Bomb(tmp_path / "mark")))
    assert (tmp_path / "mark").exists()


def test_a_checkpoint_full_of_pickles_is_refused_and_not_unpickled(tmp_path: Path):
    mark, bomb = tmp_path / "mark", pickle.dumps(Bomb(tmp_path / "mark"))
    tree = {"w": np.ones(3, np.float32)}
    template = {"w": jax.ShapeDtypeStruct((3,), np.float32)}
    directory = tmp_path / "checkpoints" / "1"
    num_refused = 0
    for index in range(100):
        checkpoint.write(directory, tree, {"num_updates": 1})
        files = sorted(file for file in directory.rglob("*") if file.is_file() and file.name != "manifest.json")
        if index == len(files):
            break
        forged(str(files[index].relative_to(directory)), bomb)(directory)
        try:
            arrays, _ = checkpoint.read(directory, template)
        except CheckpointError:
            num_refused += 1
        else:  # a file that nothing is read from
            assert np.array_equal(arrays["w"], tree["w"])
        assert not mark.exists(), files[index].name
    assert index == len(files) >= 5
    assert num_refused >= 3, "host state and array data at least"


def test_a_run_directory_of_pickles_is_told_of_and_not_unpickled(tmp_path: Path):
    mark, bomb = tmp_path / "mark", pickle.dumps(Bomb(tmp_path / "mark"))
    run = tmp_path / "run"
    policy = run / "policies" / "10"
    policy.mkdir(parents=True)
    for name in ("manifest.json", "host.msgpack", "arrays", "data.npy", "params.pkl"):
        (policy / name).write_bytes(bomb)
    for name in ("metrics.jsonl", "episodes.jsonl", "evaluation.jsonl", "starts.jsonl", "plan.json"):
        (run / name).write_bytes(bomb + b"\n")
    (run / "more.jsonl.gz").write_bytes(gzip.compress(bomb))
    (run / "config.json").write_text(json.dumps(config_to_dict(CONFIG)))
    with pytest.raises(CheckpointError, match=r"no readable manifest\.json"):
        trained_player(run, CONFIG, 10)
    frame, problems = collect_evaluations([run])
    assert frame.is_empty()
    assert problems
    with pytest.raises(ConfigError, match=r"evaluation\.jsonl, line 1: not JSON"):
        read_rows(run / "evaluation.jsonl")
    assert len(read_results([run]).problems) >= 4
    (run / "config.json").write_bytes(bomb)
    with RunDir(run) as opened, pytest.raises(GvzError, match=r"config\.json cannot be read"):
        opened.saved_config()
    assert read_results([run]).runs == ()
    assert not mark.exists()


# ----------------------------------------------------------------------------------------------------- users' maps


def with_script(path: Path, source: str) -> Path:
    """The stock map with other scripts."""
    behavior = compile_acs(source)
    lumps = [lump for lump in read_wad(STOCK_WAD.read_bytes()) if lump.name != "BEHAVIOR"]
    lumps.insert([lump.name for lump in lumps].index("ENDMAP"), Lump("BEHAVIOR", behavior))
    path.write_bytes(write_wad(lumps))
    return path


def engines_on(wad: Path) -> dict[int, str]:
    """Process id -> /proc/<pid>/limits of the engines that have loaded a file."""
    found: dict[int, str] = {}
    for process in Path("/proc").glob("[0-9]*"):
        try:
            words = (process / "cmdline").read_bytes().split(b"\0")
            if str(wad).encode() in words and words[0].endswith(b"/vizdoom"):
                found[int(process.name)] = (process / "limits").read_text()
        except OSError:  # it has ended
            continue
    return found


@pytest.mark.engine
def test_a_map_that_never_ends_its_work_is_told_of(tmp_path: Path):
    wad = with_script(tmp_path / "runaway.wad", "script 1 OPEN { int x; while (1) x++; }")
    with pytest.raises(EngineError, match=r"cannot be played: Runaway script 1 terminated"):
        probe_wad(wad)


@pytest.mark.engine
def test_a_map_that_keeps_the_processor_busy_is_held_by_limits_and_ended(tmp_path: Path):
    scripts = "".join(f"script {number} OPEN {{ int x; while (1) x++; }}\n" for number in range(1, 20_000))
    wad = with_script(tmp_path / "busy.wad", scripts)
    errors: list[EngineError] = []

    def probe() -> None:
        try:
            probe_wad(wad, timeout_s=8.0)
        except EngineError as error:
            errors.append(error)

    thread = threading.Thread(target=probe)
    thread.start()
    limits: dict[int, str] = {}
    while thread.is_alive():
        limits |= engines_on(wad)
        time.sleep(0.01)
    thread.join()
    assert len(errors) == 1
    assert limits, "no engine was seen at work"
    for text in limits.values():
        by_name = {line[:26].strip(): line[26:].split()[:2] for line in text.splitlines()}
        assert by_name["Max cpu time"] == ["9", "9"]
        assert by_name["Max address space"] == [str(4 * 2**30)] * 2
        assert by_name["Max core file size"] == ["0", "0"]
    wait_until(lambda: not engines_on(wad), "the end of the probe's engine")
