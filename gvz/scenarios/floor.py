"""The check that a drawn map can be played, and the places for its decorations.

It looks at the lines and solid things of the finished map alone, so a mistake of what drew them is found.
"""

from collections.abc import Iterable

import cv2
import numpy as np

from gvz.scenarios.layout import FLOOR_UNIT, Place
from gvz.wad.udmf import NO_REFERENCE, UdmfMap


class Floor:
    """A raster of a map: how far each pixel is from the next wall or solid thing. Open lines are left out.

    Attributes:
        to_wall: f32[H, W], map units, exact to a pixel of 8 map units; rows from south to north.
    """

    def __init__(self, room: UdmfMap, solids: Iterable[tuple[Place, float]] = ()):
        """`solids` are (place, radius) of things that stop the agent."""
        corners = np.array([(vertex["x"], vertex["y"]) for vertex in room.vertices], float)
        self._low = corners.min(axis=0) - 2 * FLOOR_UNIT
        pixels = np.rint((corners - self._low) / FLOOR_UNIT).astype(np.int32)
        width, height = pixels.max(axis=0) + 3
        free = np.ones((height, width), np.uint8)
        lines = [line for line in room.linedefs if line.get("sideback", NO_REFERENCE) == NO_REFERENCE]
        cv2.polylines(free, [pixels[[line["v1"], line["v2"]]] for line in lines], False, 0)  # pyright: ignore
        for (x, y), radius in solids:
            row, column = self.pixel(x, y)
            cv2.circle(free, (column, row), round(radius / FLOOR_UNIT), 0, -1)
        self.to_wall = cv2.distanceTransform(free, cv2.DIST_L2, 5) * FLOOR_UNIT
        self._reached: dict[tuple[Place, float], np.ndarray] = {}

    def pixel(self, x: float, y: float) -> tuple[int, int]:
        """(row, column) of a place."""
        return round((y - self._low[1]) / FLOOR_UNIT), round((x - self._low[0]) / FLOOR_UNIT)

    def reached(self, start: Place, radius: float) -> np.ndarray:
        """bool[H, W]: where the middle of somebody of this radius can go from a start."""
        if (start, radius) not in self._reached:
            _, parts = cv2.connectedComponents((self.to_wall >= radius).astype(np.uint8), connectivity=4)
            part = parts[self.pixel(*start)]
            self._reached[start, radius] = (parts == part) & (part > 0)
        return self._reached[start, radius]

    def places(self, start: Place, radius: float) -> np.ndarray:
        """f64[N, 3]: (x, y, distance to the next wall) of the reached places of a grid of 16 map units."""
        rows, columns = np.nonzero(self.reached(start, radius)[::2, ::2])
        x, y = 2 * columns * FLOOR_UNIT + self._low[0], 2 * rows * FLOOR_UNIT + self._low[1]
        return np.stack([x, y, self.to_wall[2 * rows, 2 * columns]], axis=1)
