"""What a real run writes about itself is documented, and the same everywhere. (Weights & Biases: tests/interop.)"""

import json
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import msgspec
import pytest

from gvz.core import records
from gvz.core.env_config import EnvConfig
from gvz.core.errors import ConfigError
from gvz.run import machine
from gvz.run.config import LogConfig
from gvz.run.config_files import load_config
from gvz.run.rundir import RunDir
from gvz.run.telemetry import RECENT_EPISODES, Rates, Telemetry, start_wandb
from gvz.task_table import task_table
from gvz.transport.messages import EpisodeStats
from tests.full_disk import full_disk
from tests.tensorboard_events import read_events

METRICS_PAGE = Path(__file__).parents[2] / "docs" / "reference" / "metrics.md"
TASKS = ("defend_the_center/default", "defend_the_center/gore")
TABLE = task_table(TASKS, EnvConfig(), 0.99)
TINY = (
    "--config dqn_4task.py --mode sync --actors.games-per-actor 2 --env.frame-height 36 --env.frame-width 44 "
    "--env.grayscale --agent.conv-channels 8 8 --agent.conv-kernels 8 4 --agent.conv-strides 4 2 "
    "--agent.hidden-units 16 --replay.capacity 2000 --learner.warmup-steps 400 --learner.batch-size 8 "
    "--log.period-updates 10 --learner.total-updates 20 --checkpoint.period-updates 1000"
).split()


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory) -> Path:
    """A tiny run of the real command."""
    path = tmp_path_factory.mktemp("telemetry") / "run"
    command = [sys.executable, "-m", "gvz.launch", *TINY, "--tasks", *TASKS, "--run-dir", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=580, check=False)
    assert done.returncode == 0, done.stderr
    return path


def scalars_of(row: dict) -> dict[str, float]:
    return {name: value for name, value in row.items() if name not in ("schema", "num_updates", "time_s")}


def tensorboard_scalars(directory: Path) -> dict[int, dict[str, float]]:
    """Gradient steps -> scalars."""
    found: dict[int, dict[str, float]] = {}
    for event in read_events(directory):
        for value in event.summary.value:
            found.setdefault(event.step, {})[value.tag] = value.simple_value
    return found


@pytest.mark.engine
@pytest.mark.e2e
@pytest.mark.timeout(600)
def test_every_scalar_of_a_run_is_documented_and_every_documented_one_is_written(run_dir):
    rows, problems = records.read(run_dir / "metrics.jsonl")
    assert problems == []
    written = {re.sub("|".join(TASKS), "<task>", name) for row in rows for name in scalars_of(row)}
    every_runs, _, _ = METRICS_PAGE.read_text().partition("### Scalars of agents that learn on-policy")
    documented = re.findall(r"^\| `([^`]+/[^`]+)` \|", every_runs, flags=re.MULTILINE)
    assert sorted(written) == sorted(documented)


@pytest.mark.engine
@pytest.mark.e2e
@pytest.mark.timeout(600)
def test_tensorboard_has_the_scalars_of_the_records(run_dir):
    rows, _ = records.read(run_dir / "metrics.jsonl")
    events = tensorboard_scalars(run_dir / "tensorboard")
    assert list(events) == [row["num_updates"] for row in rows] == [10, 20]
    for row in rows:
        assert events[row["num_updates"]] == pytest.approx(scalars_of(row), rel=1e-6, nan_ok=True)


@pytest.mark.engine
@pytest.mark.e2e
@pytest.mark.timeout(600)
def test_a_run_says_on_what_it_was_started(run_dir):
    ([row], problems) = records.read(run_dir / "starts.jsonl")
    assert problems == []
    assert row["num_updates"] == 0
    told = {name: value for name, value in row.items() if name not in ("schema", "num_updates", "time_s")}
    assert told == {**json.loads(json.dumps(machine.describe())), "commit": told["commit"]}
    assert told["commit"] is None or re.fullmatch(r"[0-9a-f]{12}(\+changes)?", told["commit"])


@pytest.mark.engine
@pytest.mark.e2e
@pytest.mark.timeout(600)
def test_exported_tables_have_every_row_of_the_records(run_dir, tmp_path):
    import polars as pl

    from gvz import cli

    assert cli.main(["export", str(run_dir), "--format", "parquet", "--out", str(tmp_path)]) == 0
    for name in ("metrics", "episodes"):
        rows, _ = records.read(run_dir / f"{name}.jsonl")
        table = pl.read_parquet(tmp_path / f"{name}.parquet")
        assert table["num_updates"].to_list() == [row["num_updates"] for row in rows]


def test_on_a_full_disk_the_events_end_and_the_records_go_on(tmp_path):
    with RunDir(tmp_path) as run:
        log = Telemetry(run, TABLE, LogConfig(), 0)
        with full_disk(2000):
            for num_updates in range(1, 400):  # more than any buffer or queue holds
                log.scalars(num_updates, {"learner/loss": 0.5})
        log.scalars(400, {"learner/loss": 0.5})
        log.close()
    rows, problems = records.read(tmp_path / "metrics.jsonl")
    assert problems == []
    assert [row["num_updates"] for row in rows] == list(range(1, 401))
    ([fault], _) = records.read(tmp_path / "faults.jsonl")
    assert fault["kind"] == "tensorboard"
    assert fault["message"].startswith("TensorBoard's events end at update ")
    assert fault["message"].endswith("No space left on device); metrics.jsonl has the same scalars")


def telemetry(run: RunDir) -> Telemetry:
    run.write_config(load_config("rainbow_quick"))
    return Telemetry(run, TABLE, LogConfig(tensorboard=False, wandb=True), 0)


CUT = EpisodeStats(
    lane=0, task=1, episode=0, seed=1, score=9.0, reward=0.0, reward_components={}, length_frames=8,
    length_steps=2, params_version=0, terminated=False, truncated=True, cut=True,
)  # fmt: skip


def test_an_episode_that_was_cut_is_recorded_and_has_no_part_in_the_score_of_its_task(tmp_path):
    with RunDir(tmp_path) as run:
        telemetry = Telemetry(run, TABLE, LogConfig(tensorboard=False), 0)
        telemetry.episode(CUT, num_updates=0, env_steps=0)
        telemetry.scalars(0, {})
        assert [status.episodes for status in telemetry.task_statuses()] == [0, 0]
        for score in (2.0, 4.0):
            telemetry.episode(msgspec.structs.replace(CUT, cut=False, score=score), num_updates=1, env_steps=0)
        telemetry.scalars(1, {})
    first, second = records.read(tmp_path / "metrics.jsonl")[0]
    assert not [name for name in first if name.startswith("task/")]
    assert {name: second[name] for name in second if name.startswith("task/")} == {f"task/{TASKS[1]}/score": 3.0}
    episodes, _ = records.read(tmp_path / "episodes.jsonl")
    assert [row["cut"] for row in episodes] == [True, False, False]
    percents = [100 * score / TABLE.rows[1].upper_bound for score in (9.0, 2.0, 4.0)]
    assert [row["normalized_score"] for row in episodes] == pytest.approx(percents)


def test_a_run_that_goes_on_has_the_episodes_and_the_recent_scores_of_before(tmp_path):
    with RunDir(tmp_path) as run:
        before, after = (Telemetry(run, TABLE, LogConfig(tensorboard=False), 0) for _ in range(2))

        def play(telemetry: Telemetry, score: float, episodes: int) -> tuple[int, float]:
            for _ in range(episodes):
                telemetry.episode(msgspec.structs.replace(CUT, cut=False, score=score), num_updates=1, env_steps=0)
            status = telemetry.task_statuses()[1]
            return status.episodes, status.score

        play(before, 2.0, RECENT_EPISODES)
        after.restore(msgspec.msgpack.decode(msgspec.msgpack.encode(before.state())))
        assert play(after, 8.0, RECENT_EPISODES // 2) == (RECENT_EPISODES * 3 // 2, 5.0)
        assert play(after, 8.0, RECENT_EPISODES) == (RECENT_EPISODES * 5 // 2, 8.0)


def test_rates_count_from_the_last_look_and_not_from_the_beginning_of_a_run_that_goes_on(monkeypatch):
    now_s = [100.0]
    monkeypatch.setattr("gvz.run.telemetry.time.monotonic", lambda: now_s[0])
    rates, found = Rates(), []
    for now_s[0], updates in ((101.0, 5_000), (103.0, 5_010), (113.0, 5_020)):
        found.append(rates({"updates": updates}))
    assert found == [{"updates": 0.0}, {"updates": 5.0}, {"updates": 1.0}]


def test_wandb_that_is_not_installed_is_an_error_with_its_remedy(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)  # what `import` takes for "not to be found"
    with RunDir(tmp_path) as run, pytest.raises(ConfigError, match=r"log\.wandb: .*pip install 'gvizdoom\[wandb\]'"):
        telemetry(run)


def test_a_run_whose_first_start_met_a_full_disk_has_one_id_with_wandb_ever_after(tmp_path, monkeypatch):
    ids: list[str] = []
    started = SimpleNamespace(define_metric=lambda *_, **__: None, finish=lambda: None)
    fake = SimpleNamespace(
        Settings=type("Settings", (SimpleNamespace,), {"model_fields": {}}),
        init=lambda **given: ids.append(given["id"]) or started,
        Error=RuntimeError,
    )
    monkeypatch.setitem(sys.modules, "wandb", fake)
    with RunDir(tmp_path) as run:
        run.write_config(load_config("rainbow_quick"))
        with full_disk(0), pytest.raises(OSError, match="File too large"):
            start_wandb(run)
        for _ in range(2):
            start_wandb(run)
    assert len(ids[0]) == 12
    assert ids == 2 * ids[:1]
