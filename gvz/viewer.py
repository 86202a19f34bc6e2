"""A window that shows a game and notes the keys that are pressed in it."""

import os

import numpy as np

from gvz.core.errors import ResourceError

_MIN_HEIGHT = 480
_UNSEEN_DRIVERS = ("dummy", "offscreen")
"""SDL's drivers without a display; used only if $SDL_VIDEODRIVER names one"""


class Window:
    """A window; shows frames enlarged by an integer factor, so that pixels stay sharp. A process has one at a time: it
    shows whatever was drawn last, and stays until the last `Window` is closed.

    Attributes:
        closed: the user has closed it or pressed Escape; the caller must react to this.
    """

    _num_open = 0
    _shown: tuple[tuple[int, int], str] = ((0, 0), "")
    """size and title of the one that was drawn last"""

    def __init__(self, title: str, width: int, height: int):
        """Opens the window, for frames of this width and height, pixels.

        Raises:
            ResourceError: there is no display.
        """
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        import pygame

        self._pygame = pygame
        self.closed = False
        self._down: list[str] = []
        self._released: set[str] = set()
        scale = max(1, -(-_MIN_HEIGHT // height))
        self._size, self._title = (width * scale, height * scale), title
        try:
            pygame.display.init()
            pygame.display.set_mode(self._size)
            driver = pygame.display.get_driver()
            if driver in _UNSEEN_DRIVERS and "SDL_VIDEODRIVER" not in os.environ:
                pygame.display.quit()
                raise pygame.error(f"no display; SDL would draw {driver}")
        except pygame.error as error:
            raise ResourceError(f"render_mode human: no window can be opened ({error}); use rgb_array") from error
        pygame.display.set_caption(title)
        Window._shown = self._size, title
        self._open = True
        Window._num_open += 1

    def show(self, frame: np.ndarray) -> None:
        """Draws a frame, uint8 [H, W, 3]."""
        size, title = Window._shown
        if size != self._size:  # another game has drawn since
            self._pygame.display.set_mode(self._size)
        if title != self._title:
            self._pygame.display.set_caption(self._title)
        Window._shown = self._size, self._title
        picture = self._pygame.surfarray.make_surface(frame.swapaxes(0, 1))
        surface = self._pygame.display.get_surface()
        assert surface is not None, "it is there as long as a Window is open"
        self._pygame.transform.scale(picture, surface.get_size(), surface)
        self._pygame.display.flip()
        self._read_events()  # else the desktop would call the window unresponsive

    def pressed_keys(self) -> tuple[str, ...]:
        """pygame's names of the keys that are down, or were since the last call: the one pressed last comes last."""
        self._read_events()
        found = tuple(self._down)
        self._down = [key for key in self._down if key not in self._released]
        self._released.clear()
        return found

    def close(self) -> None:
        """Closes the window. Can be repeated."""
        if self._open:
            self._open = False
            Window._num_open -= 1
            if Window._num_open == 0:
                self._pygame.display.quit()

    def _read_events(self) -> None:
        pygame = self._pygame
        for event in pygame.event.get():
            if event.type == pygame.QUIT or (event.type == pygame.KEYDOWN and event.key == pygame.K_ESCAPE):
                self.closed = True
            elif event.type == pygame.KEYDOWN:
                name = pygame.key.name(event.key)
                self._down = [key for key in self._down if key != name] + [name]
                self._released.discard(name)
            elif event.type == pygame.KEYUP:
                self._released.add(pygame.key.name(event.key))
