"""The real command with actor hosts and real engines: a killed host, a stop, a killed learner, and the end."""

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from benchmarks import hosts_soak
from benchmarks.soak import processes
from gvz.core import janitor, records
from gvz.core.durable import saved_steps
from tests.cluster.conftest import RayCluster
from tests.waiting import wait_until

pytestmark = [
    pytest.mark.e2e,
    pytest.mark.engine,
    pytest.mark.timeout(900),
]
TIMEOUT_S = 240.0
METRICS_PAGE = Path(__file__).parents[2] / "docs" / "reference" / "metrics.md"
SMALL = (
    "--actors.num-actors 1 --actors.games-per-actor 2 --actors.placement free "
    "--env.frame-height 36 --env.frame-width 44 --env.grayscale --agent.conv-channels 8 8 --agent.conv-kernels 8 4 "
    "--agent.conv-strides 4 2 --agent.hidden-units 32 --log.period-updates 20 --checkpoint.period-updates 50 "
    "--cluster.hosts 2 --cluster.batch-records 64"
).split()
RAINBOW = (
    "--config rainbow_4task --replay.capacity 4000 --learner.warmup-steps 300 --learner.batch-size 8 "
    "--learner.target-period-updates 50"
).split()
PPO = (
    "--config ppo_quick --learner.rollout-steps 32 --learner.num-minibatches 2 --learner.num-epochs 2 "
    "--learner.total-updates 60"
).split()


class Command:
    """`python -m gvz.launch` on a cluster; the same again resumes it."""

    def __init__(self, cluster: RayCluster, run: Path):
        self.run, self._cluster = run, cluster

    def start(self, *flags: str, agent: list[str] = RAINBOW) -> subprocess.Popen[str]:
        words = [*agent, *SMALL, "--run-dir", str(self.run), "--cluster.address", self._cluster.address, *flags]
        return subprocess.Popen(
            [sys.executable, "-m", "gvz.launch", *words],
            env=self._cluster.environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def rows(self, name: str) -> list[dict[str, Any]]:
        file = self.run / name
        return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []

    def num_updates(self) -> int:
        return max((row["num_updates"] for row in self.rows("metrics.jsonl")), default=0)


@pytest.fixture
def command(cluster: RayCluster, tmp_path: Path) -> Iterator[Command]:
    yield Command(cluster, tmp_path / "run")
    wait_until(lambda: not processes(), "hosts, actors and engines to end", 60)
    wait_until(lambda: not janitor.dead_instances(), f"{janitor.dead_instances()} to be removed", 10)


@pytest.mark.slow
def test_a_run_survives_a_killed_host_a_stop_and_a_killed_learner(command: Command):
    learner = command.start("--learner.total-updates", "10000")
    try:
        wait_until(lambda: command.num_updates() >= 40, "the first updates", TIMEOUT_S)
        processes("host")[0].kill()
        wait_until(lambda: any(f["kind"] == "host_died" for f in command.rows("faults.jsonl")), "the fault", TIMEOUT_S)
        wait_until(lambda: command.rows("metrics.jsonl")[-1]["cluster/hosts"] == 2, "a host in its place", TIMEOUT_S)
        replaced_at = command.num_updates()
        wait_until(lambda: command.num_updates() >= replaced_at + 40, "training to go on", TIMEOUT_S)
        learner.send_signal(signal.SIGTERM)
        _, err = learner.communicate(timeout=120)
        assert learner.returncode == 143, err
        stopped_at = saved_steps(command.run / "checkpoints")[-1]
        assert stopped_at >= replaced_at + 40
        row = command.rows("metrics.jsonl")[-1]
        assert row["cluster/host_restarts"] == 1
        assert 0 <= row["cluster/cut_episodes"] <= 2
        assert row["cluster/received_bytes"] > 0
        documented = re.findall(r"^\| `(cluster/[^`]+)` \|", METRICS_PAGE.read_text(), re.MULTILINE)
        assert sorted(documented) == sorted(name for name in row if name.startswith("cluster/"))

        learner = command.start("--learner.total-updates", "10000")
        wait_until(lambda: command.num_updates() >= stopped_at + 40, "the resumed run", TIMEOUT_S)
        learner.kill()
        learner.communicate(timeout=60)
        wait_until(lambda: not processes(), "the hosts to end by themselves", TIMEOUT_S)

        learner = command.start("--learner.total-updates", "10000")
        wait_until(lambda: len(command.rows("starts.jsonl")) == 3, "the second resume", TIMEOUT_S)
        resumed_at = command.rows("starts.jsonl")[-1]["num_updates"]
        wait_until(lambda: command.num_updates() >= resumed_at + 40, "training to go on again", TIMEOUT_S)
        learner.send_signal(signal.SIGINT)
        _, err = learner.communicate(timeout=120)
        assert learner.returncode == 130, err
    finally:
        learner.kill()
        learner.communicate(timeout=60)
    episodes, problems = records.read(command.run / "episodes.jsonl")
    assert problems == []
    numbers = [(row["lane"], row["episode"]) for row in episodes]
    assert len(set(numbers)) == len(numbers), "no episode is played twice"
    assert {lane for lane, _ in numbers} == {0, 1, 2, 3}
    assert [row["num_updates"] for row in command.rows("starts.jsonl")] == [0, stopped_at, resumed_at]


@pytest.mark.slow
def test_an_agent_that_learns_on_policy_can_have_hosts(command: Command):
    learner = command.start(agent=PPO)
    _, err = learner.communicate(timeout=240)
    assert learner.returncode == 0, err
    row = command.rows("metrics.jsonl")[-1]
    assert (row["num_updates"], row["cluster/hosts"]) == (60, 2)
    assert row["rollout/age_max_versions"] >= row["rollout/age_mean_versions"] > 0
    assert not [fault for fault in command.rows("faults.jsonl") if fault["kind"] != "warning"]


@pytest.mark.slow
def test_a_run_of_two_hosts_goes_on_on_one_machine(command: Command):
    """The lanes of a run are fixed; who plays them is not."""
    first = command.start("--learner.total-updates", "40")
    _, err = first.communicate(timeout=240)
    assert first.returncode == 0, err
    words = [*RAINBOW, *SMALL[: SMALL.index("--cluster.hosts")], "--run-dir", str(command.run)]
    changes = ["--actors.num-actors", "2", "--learner.total-updates", "60"]
    words[words.index("--actors.num-actors") : words.index("--actors.num-actors") + 2] = []
    done = subprocess.run(
        [sys.executable, "-m", "gvz.launch", *words, *changes],
        env=dict(os.environ),
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert command.rows("starts.jsonl")[-1]["num_updates"] == 40


@pytest.mark.slow
def test_the_short_soak_loses_nothing_and_leaves_nothing(cluster: RayCluster):
    frames = SMALL[SMALL.index("--env.frame-height") : SMALL.index("--log.period-updates")]
    flags = (*RAINBOW[2:], *frames, "--cluster.batch-records", "64")
    options = hosts_soak.HostsSoak(minutes=0.3, kill_every_s=8.0, hosts=2, sample_s=1.0, flags=flags)
    made = hosts_soak.soak(options, cluster, Console(quiet=True))
    assert len(made["kills"]) >= 1
    assert made["host_restarts"] == len(made["kills"]) == made["faults"]["host_died"]
    assert (made["repeated_episodes"], made["damaged_rows"], made["left_behind"]) == (0, 0, [])
    assert made["exit_code"] == 128 + signal.SIGTERM
    assert max(made["samples"]["engines"]) == 8
    assert f"| hosts replaced, as the run counted | {len(made['kills'])} |" in hosts_soak.table(made)


def test_bad_input_is_one_line_and_exit_2_before_anything_starts(tmp_path: Path):
    for flags, text in (
        (["--mode", "sync"], 'mode: got "sync" with cluster.hosts 2; want "async"'),
        (["--actors.inference", "device"], 'actors.inference: got "device" with cluster.hosts 2; want "actors"'),
        (["--replay.capacity", "500"], "replay.capacity: got 500, want at least 512 with cluster.hosts"),
    ):
        words = [*RAINBOW, *SMALL, "--run-dir", str(tmp_path / "run"), "--cluster.address", "10.0.0.1:6379", *flags]
        if "--replay.capacity" in flags:
            words[words.index("--replay.capacity") : words.index("--replay.capacity") + 2] = []
        done = subprocess.run([sys.executable, "-m", "gvz.launch", *words], capture_output=True, text=True, check=False)
        assert done.returncode == 2, done.stderr
        assert text in done.stderr
        assert not (tmp_path / "run" / "config.json").exists()
