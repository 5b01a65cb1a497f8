"""The battery of the emulated drone."""

from typing import Final

CELL_V: Final = (3.5, 4.2)
"""Voltage of a lithium polymer cell, empty and full."""
CELLS: Final = 3
FULL_V: Final = CELLS * CELL_V[1]
_HOVER_A: Final = 10.0
_REST_A: Final = 0.5

FLIGHT_S: Final = 15 * 60
"""Flight time of a full charge."""


class Battery:
    """Charge of the battery, used up by flight; at rest it lasts longer by the ratio of the currents.

    Attributes:
        left: Remaining charge, from 0 to 1.
        current_a: Current.
        full_v: Voltage of the full battery (SIM_BATT_VOLTAGE of ArduPilot's simulator).
        flight_s: Flight time of a full charge (SIM_BAT_DRAIN of PX4's simulator).
        least: Minimum of `left` (SIM_BAT_MIN_PCT as a fraction).
    """

    def __init__(self, now_ns: int) -> None:
        self._last_ns = now_ns
        self.left = 1.0
        self.current_a = _REST_A
        self.full_v = FULL_V
        self.flight_s = float(FLIGHT_S)
        self.least = 0.0

    def advance(self, now_ns: int, *, driven: bool) -> None:
        """Use up the charge of the time since the last call."""
        self.current_a = _HOVER_A if driven else _REST_A
        used = (now_ns - self._last_ns) / 1e9 / self.flight_s * self.current_a / _HOVER_A
        self.left, self._last_ns = max(min(self.least, self.left), self.left - used), now_ns

    @property
    def used_mah(self) -> float:
        """Charge used so far."""
        return (1 - self.left) * self.flight_s / 3.6 * _HOVER_A

    @property
    def voltage_v(self) -> float:
        """Voltage of the battery, linear in the remaining charge."""
        empty, full = CELL_V
        return self.full_v * (empty + (full - empty) * self.left) / full
