"""The training loop in this process, on real Doom: what a resumed run goes on with, and the last row of its metrics."""

import hashlib
import itertools
import json
import os
import re
import signal
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgpack
import numpy as np
import optax
import psutil
import pytest

from actors.config import ActorsConfig
from benchmarks.last_parameters import main, write_last_parameters
from gvz import launch
from gvz.cluster.config import ClusterConfig
from gvz.core import control_groups, records
from gvz.core.durable import saved_steps
from gvz.core.env_config import EnvConfig
from gvz.core.errors import CheckpointError, ConfigError, ResumeError
from gvz.core.stop import StopRequest
from gvz.run import machine
from gvz.run.config import CheckpointConfig, LogConfig, RunConfig
from gvz.run.curriculum_config import CurriculumConfig
from gvz.run.monitor import Counts
from gvz.run.rundir import RunDir
from gvz.run.saver import Saver
from gvz.run.train import Trainer, train, with_own_segmenters
from gvz.segmentation import segmenter_file
from learner.agents.configs.dqn import DQNConfig
from learner.agents.configs.ppo import PPOConfig
from learner.agents.configs.pqn import PQNConfig
from learner.agents.configs.rainbow import RainbowConfig
from learner.config import LearnerConfig, OnPolicyConfig, ReplayConfig
from tests.e2e.command import arrays_of
from tests.learner.test_checkpoint import forged
from tests.tensorboard_events import read_events
from tests.test_segmentation import write_network

pytestmark = pytest.mark.engine

DQN = RunConfig(
    name="dqn",
    tasks=("defend_the_center/default", "defend_the_center/fuzzy_enemies"),
    mode="sync",
    env=EnvConfig(frame_height=24, frame_width=32, render_width=160, render_height=120, grayscale=True, frame_skip=10),
    actors=ActorsConfig(num_actors=1, games_per_actor=2),
    agent=DQNConfig(
        conv_channels=(4,),
        conv_kernels=(8,),
        conv_strides=(4,),
        hidden_units=16,
        epsilon_decay_steps=100,
    ),
    replay=ReplayConfig(capacity=2_000, prioritized=False),
    learner=LearnerConfig(warmup_steps=60, env_steps_per_update=2.0, batch_size=8, publish_period_updates=100),
    log=LogConfig(period_updates=20, tensorboard=False),
)
PLAIN = replace(DQN, tasks=("defend_the_center/default",))
"""without fuzzy enemies, for which each episode starts an engine"""


def go_on(path: Path, config: RunConfig, total_updates: int) -> None:
    """Trains the run in `path` until it has so many updates."""
    config = replace(config, learner=replace(config.learner, total_updates=total_updates))
    with RunDir(path) as run:
        assert train(config, run, StopRequest()) == 0


def test_a_run_keeps_the_network_of_its_segmented_frames_and_goes_on_with_it(tmp_path):
    network, path = write_network(tmp_path / "fresh.onnx"), tmp_path / "run"
    env = EnvConfig(frames="segmented", segmenter=str(network), frame_height=24, frame_width=32)
    config = replace(PLAIN, env=env, learner=replace(PLAIN.learner, average_ema=0.9))
    first = network.read_bytes()
    go_on(path, config, 20)
    network.write_text("no network")
    go_on(path, config, 40)
    assert write_last_parameters(path, tmp_path / "last") == 40
    for directory in (path, tmp_path / "last"):
        assert (directory / "segmenters" / "defend_the_center.onnx").read_bytes() == first
        saved = json.loads((directory / "config.json").read_text())["config"]
        assert saved["env"]["segmenter"] == str(network), "what was asked for"
    with RunDir(path) as run:
        on_hosts = replace(
            config, cluster=ClusterConfig(address="127.0.0.1:6379", hosts=2), mode="async", replay=ReplayConfig()
        )
        with pytest.raises(ResumeError, match="networks for defend_the_center that are installed are not those in"):
            with_own_segmenters(on_hosts, run)
        network.write_bytes(first)
        assert with_own_segmenters(on_hosts, run).env == env, "another host has no copies"
    digests = [row["segmenters"] for row in records.read(path / "starts.jsonl")[0]]
    assert digests == [{"defend_the_center": hashlib.blake2b(first, digest_size=8).hexdigest()}] * 2


def test_networks_of_a_first_start_that_was_refused_do_not_stay(tmp_path):
    """A run learns with networks from when it has a configuration on."""
    path = tmp_path / "run"
    (tmp_path / "bad.onnx").write_text("no network")
    good = write_network(tmp_path / "good.onnx")
    env = EnvConfig(frames="segmented", segmenter=str(tmp_path / "bad.onnx"), frame_height=24, frame_width=32)
    with pytest.raises(ConfigError, match="is no segmentation network"):
        go_on(path, replace(DQN, env=env), 20)
    with RunDir(path) as run:
        with_own_segmenters(replace(DQN, env=replace(env, segmenter=str(good))), run)
    assert (path / "segmenters" / "defend_the_center.onnx").read_bytes() == good.read_bytes()


def test_actors_find_the_networks_of_a_run_whose_directory_is_relative(tmp_path, monkeypatch):
    """They run in a directory of their own."""
    monkeypatch.chdir(tmp_path)
    config = replace(DQN, env=EnvConfig(frames="segmented"))
    with RunDir(Path("runs") / "one") as run:
        env = with_own_segmenters(config, run).env
    assert env.segmenter == str(tmp_path / "runs" / "one" / "segmenters")
    monkeypatch.chdir("runs")
    assert segmenter_file("defend_the_center", env).is_file()


def test_a_run_ends_when_its_processor_time_is_used_up_and_is_then_done_until_it_gets_more(tmp_path, capsys):
    limited = replace(PLAIN, max_processor_s=0.01)
    go_on(tmp_path, limited, 40)
    assert logged_updates(tmp_path) == [20], "it looks at its first row of metrics"
    (row,) = records.read(tmp_path / "metrics.jsonl")[0]
    assert row["run/processor_s"] >= 0.01
    assert [p.name for p in (tmp_path / "policies").iterdir()] == ["20"]
    assert "s of processor time (--max-processor-s) used up: writing the last checkpoint" in capsys.readouterr().err
    go_on(tmp_path, limited, 40)
    assert logged_updates(tmp_path) == [20], "nothing is left to do"
    assert "s of processor time (--max-processor-s) used up: no new gradient steps to save" in capsys.readouterr().err
    go_on(tmp_path, PLAIN, 40)
    assert logged_updates(tmp_path) == [20, 40]
    last = records.read(tmp_path / "metrics.jsonl")[0][-1]
    assert last["run/processor_s"] > row["run/processor_s"], "the time of all starts together"


def test_a_run_has_used_up_its_processor_time_when_its_last_row_says_so(tmp_path, monkeypatch):
    clock = itertools.count(0.0)
    monkeypatch.setattr(machine, "processor_s", lambda: next(clock))  # a second passes between two looks
    config = replace(PLAIN, checkpoint=CheckpointConfig(period_updates=20), max_processor_s=1.5)
    file = tmp_path / "metrics.jsonl"
    go_on(tmp_path, config, 60)
    assert used_s(file) == [(20, 1.0), (40, 2.0)], "the checkpoint at 20 has the time of its row"
    saved = msgpack.unpackb((tmp_path / "checkpoints" / "40" / "host.msgpack").read_bytes())
    assert saved["counts"]["processor_s"] == 2.0
    # an earlier version could end so: its row before the limit, its checkpoint after it
    file.write_text(file.read_text().replace('"run/processor_s": 2.0', '"run/processor_s": 1.4'))
    for _ in range(2):
        go_on(tmp_path, config, 60)
        assert used_s(file) == [(20, 1.0), (40, 1.4), (40, 2.0)]


def used_s(file: Path) -> list[tuple[int, float]]:
    """Gradient steps and processor time of every row of metrics."""
    return [(row["num_updates"], row["run/processor_s"]) for row in records.read(file)[0]]


def logged_updates(path: Path) -> list[int]:
    """Of every row of metrics, each of which must have rates."""
    rows, problems = records.read(path / "metrics.jsonl")
    assert problems == []
    assert all(row["learner/updates_per_s"] > 0 for row in rows)
    return [row["num_updates"] for row in rows]


def test_a_run_that_explores_by_epsilon_goes_on_bit_for_bit_between_two_publications(tmp_path):
    """The cut lies after the last publication and in a fuzzy enemies' episode that is not its game's first."""
    config = replace(DQN, curriculum=CurriculumConfig(kind="uniform"))
    go_on(tmp_path / "whole", config, 80)
    rarely = replace(config, log=replace(DQN.log, period_updates=1_000))
    go_on(tmp_path / "cut", rarely, 50)
    assert logged_updates(tmp_path / "cut") == [50], "a run that ends before its log period leaves a row"
    go_on(tmp_path / "cut", config, 80)
    whole, cut = (arrays_of(tmp_path / name / "checkpoints" / "80") for name in ("whole", "cut"))
    assert len(np.unique(whole["['replay'].store.action"])) > 1
    assert [name for name in whole if not np.array_equal(whole[name], cut[name])] == []
    assert (tmp_path / "whole" / "episodes.jsonl").read_bytes() == (tmp_path / "cut" / "episodes.jsonl").read_bytes()
    hosts = [
        msgpack.unpackb((tmp_path / name / "checkpoints/80/host.msgpack").read_bytes()) for name in ("whole", "cut")
    ]
    for host in hosts:
        del host["counts"]["processor_s"], host["records"]
    assert hosts[0] == hosts[1]
    episodes, _ = records.read(tmp_path / "whole" / "episodes.jsonl")
    assert len({(row["lane"], row["task"]) for row in episodes}) > 2, "tasks of games change"
    assert logged_updates(tmp_path / "whole") == [20, 40, 60, 80]
    assert logged_updates(tmp_path / "cut") == [50, 60, 80]


def test_parameters_are_published_when_warm_up_ends_and_then_every_period():
    published, trainer = list[tuple[int, int]](), Trainer.__new__(Trainer)
    learner = replace(DQN.learner, warmup_steps=60, publish_period_updates=10)
    parts: Any = SimpleNamespace(pool_config=SimpleNamespace(layout_hash=0))
    pool: Any = SimpleNamespace(publish=lambda _, header: published.append((header.version, header.num_updates)))
    trainer._config, trainer._parts, trainer._pool = replace(DQN, learner=learner), parts, pool
    trainer._learner = SimpleNamespace(acting_params=lambda: None, epsilon=lambda _: 0.5)  # pyright: ignore
    trainer._counts = counts = Counts()
    for counts.env_steps, counts.updates in ((59, 0), (60, 0), (70, 9), (80, 11), (90, 19), (99, 40), (120, 49)):
        trainer._broadcast()
    assert published == [(1, 0), (2, 11), (3, 40)]


def test_a_host_state_that_no_run_can_go_on_from_is_named(tmp_path):
    go_on(tmp_path, PLAIN, 4)
    forged("host.msgpack", msgpack.packb({"records": {}}))(tmp_path / "checkpoints" / "4")
    said = r"checkpoints/4: its host state is not one of a run \(KeyError\('counts'\)\); move it aside"
    with pytest.raises(CheckpointError, match=said):
        go_on(tmp_path, PLAIN, 8)


def test_an_epsilon_may_be_a_number_of_jax_or_numpy(tmp_path):
    @dataclass(frozen=True, kw_only=True)
    class Scheduled(DQNConfig):
        def epsilon(self, env_steps: int) -> float:
            return optax.linear_schedule(1.0, 0.0, 100)(env_steps)  # pyright: ignore

    agent = Scheduled(conv_channels=(4,), conv_kernels=(8,), conv_strides=(4,), hidden_units=16)
    go_on(tmp_path, replace(PLAIN, agent=agent), 4)
    assert saved_steps(tmp_path / "checkpoints") == [4]


def test_an_epsilon_that_is_no_probability_ends_a_run_which_is_saved_first(tmp_path):
    smallest = -10.0

    @dataclass(frozen=True, kw_only=True)
    class Falling(DQNConfig):
        def epsilon(self, env_steps: int) -> float:
            return max(smallest, 1.0 - env_steps / 100)

    config = replace(PLAIN, agent=Falling(conv_channels=(4,), conv_kernels=(8,), conv_strides=(4,), hidden_units=16))
    said = r"agent\.name: the `epsilon` of 'dqn' gives -\d\.\d+ after \d+ decisions of the run; want 0\.\.1"
    with pytest.raises(ConfigError, match=said):
        go_on(tmp_path, config, 120)
    (saved,) = saved_steps(tmp_path / "checkpoints")
    assert saved > 0
    others = psutil.Process().children(recursive=True)  # of this test's process
    with pytest.raises(ConfigError, match=said):
        go_on(tmp_path, config, 120)
    left = set(psutil.Process().children(recursive=True)) - set(others)
    assert not left, "games that had begun have ended"
    smallest = 0.0  # the user mends it
    go_on(tmp_path, config, 120)


def test_a_run_goes_on_bit_for_bit_within_a_stretch_of_noise(tmp_path):
    """With a loss of sight. The cut at 80 of each game's 110 decisions lies in the third stretch, after the warm-up."""
    agent = RainbowConfig(**NETWORK, noisy_sigma=0.5, noisy_period_steps=30, num_atoms=5, sight_weight=1.0)
    config = replace(DQN, name="rainbow", agent=agent)
    go_on(tmp_path / "whole", config, 80)
    go_on(tmp_path / "cut", config, 50)
    saved = msgpack.unpackb((tmp_path / "cut" / "checkpoints" / "50" / "host.msgpack").read_bytes())
    assert saved["pool"]["loop"]["num_calls"] % 30 not in (0, 29)
    go_on(tmp_path / "cut", config, 80)
    whole, cut = (arrays_of(tmp_path / name / "checkpoints" / "80") for name in ("whole", "cut"))
    assert [name for name in whole if not np.array_equal(whole[name], cut[name])] == []
    assert (tmp_path / "whole" / "episodes.jsonl").read_bytes() == (tmp_path / "cut" / "episodes.jsonl").read_bytes()
    episodes, _ = records.read(tmp_path / "whole" / "episodes.jsonl")
    assert len({(row["lane"], row["task"]) for row in episodes}) == 2, "games keep their tasks"
    assert len(np.unique(whole["['replay'].store.action"])) > 1
    assert 0 < whole["['replay'].store.sight"].mean() < 1, "the loss of sight had something to learn from"


NETWORK = {"conv_channels": (4,), "conv_kernels": (8,), "conv_strides": (4,), "hidden_units": 16, "past_actions": 2}
ON_POLICY = OnPolicyConfig(rollout_steps=12, num_epochs=2, num_minibatches=3, average_ema=0.9)
"""6 gradient steps for each rollout of 24 steps"""


@pytest.mark.parametrize("agent", [PPOConfig(**NETWORK), PQNConfig(**NETWORK)], ids=["ppo", "pqn"])
def test_an_on_policy_run_goes_on_bit_for_bit_between_two_rollouts(tmp_path, agent):
    """The cut lies in both games' episodes; the windows after it begin with records from before it."""
    config = replace(DQN, name="on_policy", agent=agent, replay=None, learner=ON_POLICY)
    go_on(tmp_path / "whole", config, 36)
    rarely = replace(config, log=replace(config.log, period_updates=1_000))
    go_on(tmp_path / "cut", rarely, 18)
    go_on(tmp_path / "cut", config, 36)
    whole, cut = (arrays_of(tmp_path / name / "checkpoints" / "36") for name in ("whole", "cut"))
    assert [name for name in whole if not np.array_equal(whole[name], cut[name])] == []
    assert write_last_parameters(tmp_path / "whole", tmp_path / "last") == 36
    for name, part in (("whole", "average_params"), ("last", "params")):
        policy = arrays_of(tmp_path / name / "policies" / "36")
        wanted = {
            leaf.removeprefix(f"['learner'].{part}"): whole[leaf] for leaf in whole if f"['learner'].{part}[" in leaf
        }
        assert policy.keys() == wanted.keys()
        assert all(np.array_equal(policy[leaf], wanted[leaf]) for leaf in policy)
    assert (tmp_path / "whole" / "episodes.jsonl").read_bytes() == (tmp_path / "cut" / "episodes.jsonl").read_bytes()
    rows, _ = records.read(tmp_path / "whole" / "metrics.jsonl")
    assert [row["num_updates"] for row in rows] == [24, 36], "at the end of the rollout in which the log period ends"
    assert rows[-1]["actors/env_steps"] > 100
    page = (Path(__file__).parents[2] / "docs" / "reference" / "metrics.md").read_text()
    everyones, own = (
        re.findall(rf"^\| `([^`]+/[^`]+)` \| {agents}", page, re.MULTILINE) for agents in ("", f"(?:both|{agent.name})")
    )
    for row in rows:
        written = {re.sub("|".join(DQN.tasks or ()), "<task>", name) for name in row if "/" in name}
        assert written <= set(everyones)
        assert set(own) <= written
        assert row["rollout/age_max_versions"] == 1
        assert row["rollout/age_mean_versions"] < 0.2, "only a window's first action is of the parameters before"
        assert row["learner/loss"] == row["learner/loss"]


def test_last_parameters_are_of_a_run_that_keeps_an_average(tmp_path, capsys):
    """It has a policy with its whole checkpoint, and what is written is a new directory."""
    for name, config in (("none", DQN), ("whole", replace(DQN, learner=replace(DQN.learner, average_ema=0.9)))):
        with RunDir(tmp_path / name) as run:
            run.write_config(config)
    for name, out, message in (
        ("missing", "new", "is not a run directory"),
        ("none", "new", "it keeps no average (learner.average_ema)"),
        ("whole", "none", "is already there"),
        ("whole", "new", "holds no policy"),
    ):
        assert main(tmp_path / name, tmp_path / out) == 2
        assert message in capsys.readouterr().err


def test_tensorboard_shows_the_rows_of_the_records_after_every_kind_of_stop(tmp_path):
    """A stop between two rows, whose last row is set aside, and one at a row, which stays."""
    config = replace(PLAIN, log=replace(PLAIN.log, tensorboard=True))
    for updates in (50, 80, 100):
        go_on(tmp_path, config, updates)
    shown: set[int] = set()
    for event in read_events(tmp_path / "tensorboard"):
        if event.HasField("session_log"):  # TensorBoard hides what it has of these steps and later ones
            shown = {step for step in shown if step < event.step}
        shown |= {event.step} if event.summary.value else set()
    rows, _ = records.read(tmp_path / "metrics.jsonl")
    assert sorted(shown) == [row["num_updates"] for row in rows] == [20, 40, 50, 60, 80, 100]


def test_a_run_says_whether_its_end_has_anything_to_save(tmp_path, capsys):
    stopped = StopRequest()
    stopped.signal = signal.SIGINT
    with RunDir(tmp_path) as run:
        assert train(PLAIN, run, stopped) == 130
    assert "stopping: no new gradient steps to save" in capsys.readouterr().err
    assert list((tmp_path / "checkpoints").iterdir()) == []
    go_on(tmp_path, PLAIN, 20)
    assert "done: writing the last checkpoint" in capsys.readouterr().err
    go_on(tmp_path, PLAIN, 20)
    assert "done: no new gradient steps to save" in capsys.readouterr().err


def test_a_signal_in_the_last_save_of_a_complete_run_leaves_it_complete(tmp_path, monkeypatch):
    save_last = Saver.save_last

    def interrupted(self: Saver, *arguments: Any) -> None:
        signal.raise_signal(signal.SIGTERM)
        save_last(self, *arguments)

    monkeypatch.setattr(Saver, "save_last", interrupted)
    config = replace(PLAIN, learner=replace(PLAIN.learner, total_updates=20))
    with RunDir(tmp_path) as run, StopRequest() as stop:
        assert train(config, run, stop) == 0
        assert stop.requested
    assert saved_steps(tmp_path / "checkpoints") == [20]


def test_an_on_policy_run_learns_from_what_was_chosen_on_the_learners_device(tmp_path):
    """Log-probabilities come with the actions: the first rollout's are those of the parameters that learn from it."""
    actors = ActorsConfig(num_actors=2, games_per_actor=1, inference="device")
    agent, learner = PPOConfig(**NETWORK), replace(ON_POLICY, num_epochs=1, num_minibatches=1)
    config = replace(DQN, name="on_policy", mode="async", agent=agent, replay=None, learner=learner, actors=actors)
    go_on(tmp_path, replace(config, log=replace(config.log, period_updates=1)), 12)
    rows, _ = records.read(tmp_path / "metrics.jsonl")
    assert len(rows) == 12
    for row in rows:
        assert np.isfinite(row["learner/loss"])
        assert row["rollout/age_max_versions"] <= 12
    assert abs(rows[0]["learner/kl"]) < 1e-6


@pytest.mark.parametrize(("cores", "size"), [(1, "1"), (2, None)])
def test_under_a_quota_xla_has_no_thread_for_each_core_of_the_machine(tmp_path, monkeypatch, cores, size):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    monkeypatch.setattr(control_groups, "num_cores", lambda: cores)
    monkeypatch.setenv("NPROC", "")
    monkeypatch.delenv("NPROC")
    found = []
    monkeypatch.setattr("gvz.run.train.train", lambda *_: found.append(os.environ.get("NPROC")) or 0)
    assert launch.main(["--config", "rainbow_quick", "--run-dir", str(tmp_path / "run")]) == 0
    assert found == [size]
