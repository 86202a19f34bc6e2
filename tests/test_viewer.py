"""The window that shows a game."""

import time

import numpy as np
import pytest

from gvz.core.errors import ResourceError
from gvz.env import DoomEnv
from gvz.viewer import Window
from tests.episodes import TURN


@pytest.mark.engine
def test_human_mode_shows_a_window_at_game_speed(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = DoomEnv("defend_the_center/default", render_mode="human", frame_skip=7)
    env.reset(seed=1)
    start = time.monotonic()  # at once: what a busy machine loses from here on, the game catches up
    window = env._window
    assert window is not None
    shown = window._pygame.surfarray.array3d(window._pygame.display.get_surface()).swapaxes(0, 1)
    assert env._engine is not None
    scale = len(shown) // 144
    np.testing.assert_array_equal(shown[::scale, ::scale], env._engine.screen)
    for _ in range(5):
        env.step(TURN)
    assert 0.9 <= time.monotonic() - start < 30, "5 decisions of 7 tics are one second"
    assert env.render() is None
    env.close()


@pytest.mark.engine
def test_human_mode_without_a_display_says_so(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "no such driver")
    env = DoomEnv("defend_the_center/default", render_mode="human")
    with pytest.raises(ResourceError, match="render_mode human: no window can be opened"):
        env.reset(seed=1)
    env.close()


@pytest.mark.parametrize("event", ["QUIT", "KEYDOWN"])
def test_a_window_notices_that_it_is_closed(monkeypatch, event):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    window = Window("title", 64, 48)
    import pygame

    frame = np.zeros((48, 64, 3), np.uint8)
    window.show(frame)
    assert not window.closed
    pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.K_SPACE))
    window.show(frame)
    assert not window.closed
    pygame.event.post(
        pygame.event.Event(getattr(pygame, event), **({"key": pygame.K_ESCAPE} if "KEY" in event else {}))
    )
    window.show(frame)
    assert window.closed
    window.close()


def test_a_window_stays_until_the_last_game_that_draws_in_it_is_closed(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    import pygame

    frame = np.zeros((48, 64, 3), np.uint8)
    first, second = Window("first", 64, 48), Window("second", 64, 48)
    for _ in range(2):
        first.close()
        second.show(frame)
    second.close()
    assert not pygame.display.get_init()


def test_a_window_has_the_size_and_the_title_of_the_game_that_draws(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    import pygame

    first, second = Window("first", 64, 48), Window("second", 96, 48)
    for window, title, width in ((first, "first", 640), (second, "second", 960), (first, "first", 640)):
        window.show(np.zeros((48, width // 10, 3), np.uint8))
        assert pygame.display.get_caption()[0] == title
        assert pygame.display.get_surface().get_size() == (width, 480)
    first.close()
    second.close()
