"""Episodes in a window, at the game's speed."""

import time
from collections.abc import Iterable

import numpy as np
from PIL.Image import Image

from gvz.core.errors import ResourceError
from gvz.env import TICS_PER_SECOND
from gvz.evaluation.panel import HEIGHT, WIDTH, Panel
from gvz.evaluation.playback import END_S, Moment
from gvz.viewer import Window

_MOST_LATE_S = 0.2
"""what a slow machine catches up with; if it is later than this, the game waits for it"""


def open_window(command: str, title: str, instead: str) -> Window:
    """A window for the pictures of a panel.

    Args:
        command: of gvz, for the error.
        title: of the window.
        instead: what a user without a display can do, for the error.

    Raises:
        ResourceError: there is no display.
    """
    try:
        return Window(title, WIDTH, HEIGHT)
    except ResourceError as error:
        raise ResourceError(
            f"{command}: no window can be opened, there seems to be no display ($DISPLAY); {instead}"
        ) from error


def show(
    window: Window, panel: Panel, moments: Iterable[Moment], *, speed: float = 1.0, prompt: str | None = None
) -> Moment | None:
    """Shows an episode.

    Args:
        window: where.
        panel: of this episode.
        moments: of `perform`.
        speed: how many times the game's own speed of 35 tics a second.
        prompt: a line that stands over the first picture until a key is pressed; None: it begins at once.

    Returns:
        Its last moment; None if somebody closed the window before.

    Raises:
        EngineError: as `perform`.
    """
    begun_s, last = 0.0, None
    for last in moments:
        if last.frames == 0:
            if prompt is not None:
                panel.draw(last)
                _wait_for_key(window, panel.announce(prompt))
            begun_s = time.monotonic()  # the engines have started
        late_s = time.monotonic() - begun_s - last.frames / TICS_PER_SECOND / speed
        begun_s += max(late_s - _MOST_LATE_S, 0)
        ended = last.terminated or last.truncated
        if late_s > 0 and not last.decided and not ended:
            continue  # a slow machine shows every decision, but not every tic
        time.sleep(max(-late_s, 0))
        window.show(np.asarray(panel.draw(last)))
        if window.closed:
            return None
        if ended:
            time.sleep(END_S / speed)
    return last


def _wait_for_key(window: Window, picture: Image) -> None:
    """Shows a picture until a key was pressed and let go, or the window is closed."""
    window.pressed_keys()  # those from before do not count
    pressed = False
    while not window.closed:
        window.show(np.asarray(picture))
        time.sleep(1 / TICS_PER_SECOND)
        down = bool(window.pressed_keys())
        if pressed and not down:
            return
        pressed = pressed or down
