"""A grid over the ground, to find what is near a position without a search through everything."""

import math
from collections import defaultdict
from typing import Final

from fieldkit.core.model import Vector

_ROUNDING: Final = 1 + 1e-9


class CellGrid:
    """Numbers by the square cell of their position; all within a given distance are in nine cells.

    Args:
        within_m: That distance, horizontally, in metres.
    """

    def __init__(self, within_m: float) -> None:
        # Larger cells contain these as well; the minimum of 1 m keeps cell numbers finite for any finite position.
        self._cell_m = max(within_m * _ROUNDING, 1.0)
        self._cells: defaultdict[tuple[int, int], list[int]] = defaultdict(list)

    def add(self, number: int, place_m: Vector) -> None:
        """Add a number at a position, in finite metres."""
        self._cells[self._cell(place_m)].append(number)

    def near(self, place_m: Vector) -> list[int]:
        """Return, in order, all numbers within the distance of a position, and some that are farther away."""
        east, north = self._cell(place_m)
        cells = [(east + e, north + n) for e in (-1, 0, 1) for n in (-1, 0, 1)]
        return sorted(number for cell in cells if cell in self._cells for number in self._cells[cell])

    def _cell(self, place_m: Vector) -> tuple[int, int]:
        return math.floor(place_m[0] / self._cell_m), math.floor(place_m[1] / self._cell_m)
