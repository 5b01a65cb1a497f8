"""A grid over the ground: who may be near a place, without a look at everybody."""

import math
from collections import defaultdict
from typing import Final

from fieldkit.core.model import Vector

_ROUNDING: Final = 1 + 1e-9


class CellGrid:
    """Numbers by the square cell in which they stand, so that all within a distance are in nine cells.

    Args:
        within_m: That distance, as seen from above, in metres.
    """

    def __init__(self, within_m: float) -> None:
        # In larger cells nobody is missed either, and no finite place is beyond all numbers of cells.
        self._cell_m = max(within_m * _ROUNDING, 1.0)
        self._cells: defaultdict[tuple[int, int], list[int]] = defaultdict(list)

    def add(self, number: int, place_m: Vector) -> None:
        """Put a number at a place, in finite metres."""
        self._cells[self._cell(place_m)].append(number)

    def near(self, place_m: Vector) -> list[int]:
        """Return, in order, all numbers within the distance of a place, and some that are farther."""
        east, north = self._cell(place_m)
        around = [(east + e, north + n) for e in (-1, 0, 1) for n in (-1, 0, 1)]
        return sorted(number for cell in around if cell in self._cells for number in self._cells[cell])

    def _cell(self, place_m: Vector) -> tuple[int, int]:
        return math.floor(place_m[0] / self._cell_m), math.floor(place_m[1] / self._cell_m)
