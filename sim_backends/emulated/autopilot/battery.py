"""The battery of the emulated drone."""

from typing import Final

CELL_V: Final = (3.5, 4.2)
"""Voltage of a lithium polymer cell, empty and full."""
CELLS: Final = 3
_HOVER_A: Final = 10.0
_REST_A: Final = 0.5

FLIGHT_S: Final = 15 * 60
"""How long a charge lasts in the air."""


class Battery:
    """A charge that flying uses up; at rest it lasts longer by the ratio of the currents."""

    def __init__(self, now_ns: int) -> None:
        self._last_ns = now_ns
        self.left = 1.0
        self.current_a = _REST_A

    def advance(self, now_ns: int, *, driven: bool) -> None:
        """Use what the time since the last call takes."""
        self.current_a = _HOVER_A if driven else _REST_A
        used = (now_ns - self._last_ns) / 1e9 / FLIGHT_S * self.current_a / _HOVER_A
        self.left, self._last_ns = max(0.0, self.left - used), now_ns

    @property
    def voltage_v(self) -> float:
        """That of the whole battery, in proportion to what is left."""
        empty, full = CELL_V
        return CELLS * (empty + (full - empty) * self.left)
