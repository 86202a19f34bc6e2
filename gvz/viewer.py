"""A window that shows what an agent sees, for people. Imports pygame (when a window opens), numpy, gvz.errors."""

import os

import numpy as np

from gvz.errors import ResourceError

_MIN_HEIGHT = 480


class Window:
    """One window; shows frames enlarged by a whole factor, so that every pixel stays one."""

    def __init__(self, title: str, width: int, height: int):
        """Opens the window.

        Args:
            title: its title.
            width: of the frames it will show, pixels.
            height: likewise.

        Raises:
            ResourceError: there is no display.
        """
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        import pygame

        self._pygame = pygame
        scale = max(1, -(-_MIN_HEIGHT // height))
        try:
            pygame.display.init()
            self._surface = pygame.display.set_mode((width * scale, height * scale))
        except pygame.error as error:
            raise ResourceError(f"render_mode human: no window can be opened ({error}); use rgb_array") from error
        pygame.display.set_caption(title)

    def show(self, frame: np.ndarray) -> None:
        """Draws a frame, uint8 [H, W, 3]."""
        picture = self._pygame.surfarray.make_surface(frame.swapaxes(0, 1))
        self._pygame.transform.scale(picture, self._surface.get_size(), self._surface)
        self._pygame.display.flip()
        self._pygame.event.pump()  # else the desktop calls the window unresponsive

    def close(self) -> None:
        """Closes the window."""
        self._pygame.display.quit()
