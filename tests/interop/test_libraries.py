"""Other libraries train on GViZDoom's environments, in an environment of their own without JAX: `make test-interop`.

Run by that environment's pytest (examples/requirements.txt); the project's own has none of these libraries.
"""

import importlib.util
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parent.parent.parent / "examples"


def run(name: str, *arguments: str, where: Path) -> str:
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / name), *arguments],
        cwd=where,
        env={**os.environ, "OMP_NUM_THREADS": "1"},  # threads of torch that spin stand in the games' way
        capture_output=True,
        text=True,
        timeout=550,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_this_environment_has_no_jax():
    assert importlib.util.find_spec("jax") is None


def test_stable_baselines3_trains_and_is_evaluated_by_the_protocol(tmp_path):
    small = ("--steps", "128", "--n-steps", "32", "--episodes", "1", "--max-tasks", "1")
    out = run("stable_baselines3_ppo.py", *small, where=tmp_path)
    assert "total_timesteps | 128" in " ".join(out.split())
    (row,) = map(json.loads, (tmp_path / "sb3_ppo.jsonl").read_text().splitlines())
    assert row["task"] == "defend_the_center/gore+mossy_bricks"
    assert re.fullmatch("sb3_ppo@128 [0-9a-f]{8}", row["player"]), "one name for each model"
    assert f"mean score {row['score']:.1f} of 1 episodes" in out


def test_a_cleanrl_style_dqn_plays_and_learns(tmp_path):
    out = run("cleanrl_style_dqn.py", "--steps", "240", "--warmup", "220", "--capacity", "240", where=tmp_path)
    assert "of 1100, epsilon" in out


def test_a_cleanrl_style_ppo_learns_from_the_vector_environment(tmp_path):
    out = run("cleanrl_style_ppo.py", "--steps", "1280", "--num-envs", "4", "--num-steps", "160", where=tmp_path)
    assert ": score " in out


def test_tianshou_trains_and_tests(tmp_path):
    out = run("tianshou_dqn.py", "--epochs", "1", "--epoch-steps", "48", where=tmp_path)
    assert "best reward of a test episode: " in out


def test_gymnasium_records_a_video(tmp_path):
    from moviepy import VideoFileClip

    task = "GViZDoom/DefendTheCenter-Gore-v0"
    out = run("vector_envs.py", "--mode", "sync", "--steps", "2", "--task", task, "--video", "videos", where=tmp_path)
    (video,) = (tmp_path / "videos").glob("*.mp4")
    assert video.name in out
    assert video.stat().st_size > 10_000
    with VideoFileClip(str(video)) as clip:
        assert clip.fps == 35 / 4, "it plays at the game's speed"


def test_environments_are_checked_by_stable_baselines3():
    from stable_baselines3.common.env_checker import check_env

    import gvz

    for grayscale in (False, True):
        env = gvz.make("dodge_projectiles/flames", grayscale=grayscale)
        check_env(env)
        env.close()


@pytest.mark.parametrize(
    ("library", "name", "want"),
    [
        ("stable_baselines3", "Sb3VecEnv", 'want autoreset_mode="SameStep"'),
        ("tianshou", "TianshouVectorEnv", 'want batch_size=1 and autoreset_mode="Disabled"'),
    ],
)
def test_games_made_in_a_way_that_a_library_cannot_use_are_refused(library, name, want):
    import gvz

    adapter = getattr(importlib.import_module(f"gvz.vector.adapters.{library}"), name)
    envs = gvz.make_vec("dodge_projectiles/flames", 1)
    with pytest.raises(ValueError, match=f"{name}: got .*'NextStep'.*{want}"):
        adapter(envs)
    envs.close()
