"""The training loop in this process, on real Doom: what a resumed run goes on with, and the last row of its metrics."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from actors.config import ActorsConfig
from gvz.core.env_config import EnvConfig
from gvz.core.stop import StopRequest
from gvz.run.config import LogConfig, RunConfig
from gvz.run.rundir import RunDir, read_records
from gvz.run.train import train
from learner.config import AgentConfig, LearnerConfig, ReplayConfig
from tests.e2e.command import arrays_of

pytestmark = pytest.mark.engine

DQN = RunConfig(
    name="dqn",
    tasks=("defend_the_center/default", "defend_the_center/fuzzy_enemies"),
    mode="sync",
    env=EnvConfig(frame_height=24, frame_width=32, render_width=160, render_height=120, grayscale=True, frame_skip=10),
    actors=ActorsConfig(num_actors=1, games_per_actor=2),
    agent=AgentConfig(
        name="dqn",
        double=False,
        dueling=False,
        noisy="off",
        distributional=False,
        n_steps=1,
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


def go_on(path: Path, config: RunConfig, total_updates: int) -> None:
    """Trains the run in `path` until it has so many updates."""
    config = replace(config, learner=replace(config.learner, total_updates=total_updates))
    with RunDir(path) as run:
        assert train(config, run, StopRequest()) == 0


def logged_updates(path: Path) -> list[int]:
    """Of every row of metrics, each of which must have rates."""
    rows, problems = read_records(path / "metrics.jsonl")
    assert problems == []
    assert all(row["learner/updates_per_s"] > 0 for row in rows)
    return [row["num_updates"] for row in rows]


def test_a_run_that_explores_by_epsilon_goes_on_bit_for_bit_between_two_publications(tmp_path):
    """The cut lies after the last publication and in a fuzzy enemies' episode that is not its game's first."""
    go_on(tmp_path / "whole", DQN, 80)
    rarely = replace(DQN, log=replace(DQN.log, period_updates=1_000))
    go_on(tmp_path / "cut", rarely, 50)
    assert logged_updates(tmp_path / "cut") == [50], "a run that ends before its log period leaves a row"
    go_on(tmp_path / "cut", DQN, 80)
    whole, cut = (arrays_of(tmp_path / name / "checkpoints" / "80") for name in ("whole", "cut"))
    assert len(np.unique(whole["['replay'].action"])) > 1
    assert [name for name in whole if not np.array_equal(whole[name], cut[name])] == []
    assert (tmp_path / "whole" / "episodes.jsonl").read_bytes() == (tmp_path / "cut" / "episodes.jsonl").read_bytes()
    assert logged_updates(tmp_path / "whole") == [20, 40, 60, 80]
    assert logged_updates(tmp_path / "cut") == [50, 60, 80]
