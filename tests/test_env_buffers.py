"""What an environment shows beside the screen: buffers, classes of things, the whole map."""

import itertools
from typing import Any

import cv2
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence

from gvz import LABEL_CLASSES
from gvz.core.env_config import SIGHT_CLASSES, SIGHT_COLUMNS, Buffer, EnvConfig
from gvz.core.errors import ConfigError
from gvz.env import DoomEnv
from gvz.observation import CLASS_GREYS, label_class

pytestmark = pytest.mark.engine


def test_buffers_come_as_a_dict():
    env = DoomEnv("defend_the_center/default", buffers=("depth", "labels", "automap"))
    observation, _ = env.reset(seed=1)
    assert isinstance(observation, dict)
    assert {name: value.shape for name, value in observation.items()} == {
        "screen": (84, 84, 3),
        "depth": (84, 84, 1),
        "labels": (84, 84, 1),
        "automap": (84, 84, 3),
    }
    assert env.observation_space.contains(observation)
    assert len(np.unique(observation["depth"])) > 10
    assert {label.object_name for label in env.labels()} & {"MarineChainsawVzd", "Demon"}
    assert set(np.unique(observation["labels"])) == {
        LABEL_CLASSES.index(n) for n in ("wall", "plane", "weapon", "enemy")
    }
    env.close()


CLASSES = {
    "DoomPlayer": "weapon",
    **dict.fromkeys(("Demon", "MarineChainsawVzd", "DoomImp", "Zombieman", "Cacodemon", "LostSoul"), "enemy"),
    **dict.fromkeys(("DoomImpBall", "CacodemonBall"), "projectile"),
    **dict.fromkeys(("Medikit", "Stimpack"), "kit"),
    "Poison": "poison",
    **dict.fromkeys(("HeadsOnAStick", "LiveStick", "HeadCandles", "BlueTorch", "GreenTorch", "RedTorch"), "scenery"),
    **dict.fromkeys(("HeartColumn", "TallGreenColumn", "TallRedColumn", "FloatingSkull"), "scenery"),
    **dict.fromkeys(("BulletPuff", "Blood"), "effect"),
}


@pytest.mark.parametrize(
    ("task", "actions", "expected"),
    [
        ("defend_the_center/gore+fuzzy_enemies", (0, 1, 2), {"wall", "plane", "weapon", "enemy", "scenery", "effect"}),
        (
            "health_gathering/obstacles+poison+stimpacks+shaded_kits",
            (0, 1, 2),
            {"wall", "plane", "kit", "poison", "scenery"},
        ),
        (
            "seek_and_kill/mixed_enemies+obstacles+shadows",
            (3,),
            {"wall", "plane", "weapon", "enemy", "projectile", "scenery"},
        ),
        ("dodge_projectiles/flaming_skulls", (0, 1, 2), {"wall", "plane", "enemy", "projectile", "scenery"}),
    ],
)
def test_labels_are_classes_that_mean_the_same_in_every_frame(task: str, actions: tuple[int, ...], expected: set[str]):
    """Pixel by pixel: the observation is as large as the rendered screen, which ViZDoom's own labels describe."""
    size = {"frame_width": 160, "frame_height": 120, "render_width": 160, "render_height": 120}
    env = DoomEnv(task, buffers=("labels",), frame_skip=8, **size)
    rng = np.random.default_rng(1)
    observation, _ = env.reset(seed=3)
    seen: set[str] = set()
    for _ in range(40):
        assert isinstance(observation, dict)
        found, raw = observation["labels"][:, :, 0], env._state.labels_buffer
        values = {label.value: LABEL_CLASSES.index(CLASSES[label.object_name]) for label in env.labels()}
        for value in np.unique(raw):
            assert set(np.unique(found[raw == value])) == {values.get(value, value)}
        seen |= {LABEL_CLASSES[number] for number in np.unique(found)}
        observation, _, terminated, truncated, _ = env.step(rng.choice(actions))
        if terminated or truncated:
            observation, _ = env.reset()
    env.close()
    assert seen == expected


@pytest.mark.parametrize(
    "task", ["dodge_projectiles/procedural-test", "seek_and_kill/varied", "health_gathering/varied"]
)
def test_whatever_drawn_maps_have_is_of_a_class(task: str):
    env = DoomEnv(task, buffers=("labels",))
    for episode_seed in range(12):
        observation, _ = env.reset(options={"episode_seed": episode_seed})
        assert isinstance(observation, dict)
        assert not (observation["labels"] == LABEL_CLASSES.index("other")).any()
    env.close()


def test_trees_are_scenery_and_the_smoke_of_a_rocket_is_an_effect():
    """Categories as ViZDoom gives them."""
    assert label_class("Vegetation", "BigTree") == "scenery"
    assert label_class("SFX", "RocketSmokeTrail") == "effect"


def test_the_automap_is_whole_and_stands_still_and_buffers_change_no_screen():
    task = "dodge_projectiles/default"  # a room that is wider than what the automap shows of itself
    plain, env = DoomEnv(task), DoomEnv(task, buffers=("depth", "labels", "automap"), frame_height=144, frame_width=256)
    frame, _ = plain.reset(seed=1)
    observation, _ = env.reset(seed=1)
    automaps = []
    for _ in range(10):
        np.testing.assert_array_equal(
            cv2.resize(observation["screen"], (84, 84), interpolation=cv2.INTER_LINEAR), frame
        )
        frame, observation = plain.step(1)[0], env.step(1)[0]
        automaps.append(observation["automap"])
    plain.close()
    env.close()
    inside = (automaps[-1] != automaps[-1][0, 0]).any(-1)
    assert not inside[[0, -1]].any()
    assert not inside[:, [0, -1]].any()
    rows, columns = np.flatnonzero(inside.any(1)), np.flatnonzero(inside.any(0))
    assert np.ptp(rows) >= 0.8 * 144
    assert np.ptp(columns) == pytest.approx(np.ptp(rows) * 640 / 448, abs=3)
    assert 0 < (automaps[-1] != automaps[0]).any(-1).mean() < 0.02, "only the agent moves"


@pytest.mark.parametrize(
    ("task", "buffers"), [("seek_and_kill/default", ()), ("health_gathering/default", ("automap",))]
)
def test_no_picture_depends_on_the_episode_before(task: str, buffers: tuple[Buffer, ...]):
    """The weapon swung on after a walk, and the automap had the colours of the screen before."""
    env = DoomEnv(task, buffers=buffers, action_set="combinations")
    walk = env.action_meanings.index(("MOVE_FORWARD",))

    def episode() -> list[object]:
        return [env.reset(options={"episode_seed": 9}), *(env.step(walk) for _ in range(12))]

    first = episode()
    assert data_equivalence(episode(), first, exact=True), "in an engine that has played"
    env.reset()
    assert data_equivalence(episode(), first, exact=True), "after an episode without a step"
    env.close()


def test_frames_of_classes_are_the_labels_as_grey_levels():
    task = "defend_the_center/gore"
    whole = {"frame_width": 160, "frame_height": 120, "render_width": 160, "render_height": 120}
    classes, labels = DoomEnv(task, frames="classes", **whole), DoomEnv(task, buffers=("labels",), **whole)
    small = DoomEnv(task, frames="classes", **whole | {"frame_width": 84, "frame_height": 84})
    assert small.observation_space.shape == (84, 84, 1)
    greys = np.array([CLASS_GREYS[name] for name in LABEL_CLASSES])
    seen = set()
    for env in (classes, labels, small):
        env.reset(options={"episode_seed": 4})
    for action in (1, 1, 0, 2, 2) * 4:
        frame, expected = classes.step(action)[0], labels.step(action)[0]["labels"]
        np.testing.assert_array_equal(frame, greys[expected])
        np.testing.assert_array_equal(small.step(action)[0][:, :, 0], cv2.resize(frame, (84, 84)))
        seen |= set(np.unique(frame))
    assert {0, 20, 40, 60, 170} <= seen, "wall, plane, weapon, scenery, enemy"
    for env in (classes, labels, small):
        env.close()
    with pytest.raises(ConfigError, match=r"env\.buffers: got depth with env\.frames classes, want none"):
        DoomEnv(task, frames="classes", buffers=("depth",))


@pytest.mark.parametrize("shown", [{}, {"buffers": ("labels",)}, {"frames": "classes"}])
def test_sight_says_which_columns_of_the_frame_have_what(shown: dict[str, Any]):
    """Against ViZDoom's own labels of a frame of the rendered size, counted pixel by pixel."""
    size = {"frame_width": 160, "frame_height": 120, "render_width": 160, "render_height": 120}
    env = DoomEnv("seek_and_kill/mixed_enemies+obstacles+shadows", sight=True, **size, **shown)
    _, info = env.reset(seed=3)
    bounds = np.cumsum([0] + [14] * 4 + [13] * 8)  # 160 pixels in 12 columns
    found = dict.fromkeys(SIGHT_CLASSES, 0)
    for _ in range(60):
        assert list(info["sight"]) == list(SIGHT_CLASSES)
        for name, flags in info["sight"].items():
            values = [one.value for one in env._state.labels if CLASSES.get(one.object_name) == name]
            pixels = np.isin(env._state.labels_buffer, values)
            assert flags == [bool(pixels[:, a:b].sum() >= 2) for a, b in itertools.pairwise(bounds)]
            assert len(flags) == SIGHT_COLUMNS
            found[name] += sum(flags)
        *_, info = env.step(1)
    assert found["enemy"] > 0
    assert found["kit"] == found["poison"] == 0
    env.close()


def test_a_frame_with_fewer_pixels_than_columns_of_sight_is_refused():
    with pytest.raises(ConfigError, match=r"env\.frame_width: got 11 with env\.sight, want 12 or more"):
        DoomEnv("defend_the_center/default", sight=True, frame_width=11)
    EnvConfig(sight=True, frame_width=12)
