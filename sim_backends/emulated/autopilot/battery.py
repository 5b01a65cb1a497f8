"""The battery of the emulated drone."""

from typing import Final

CELL_V: Final = (3.5, 4.2)
"""Voltage of a lithium polymer cell, empty and full."""
CELLS: Final = 3
FULL_V: Final = CELLS * CELL_V[1]
_HOVER_A: Final = 10.0
_REST_A: Final = 0.5

FLIGHT_S: Final = 15 * 60
"""How long a charge lasts in the air."""


class Battery:
    """A charge that flying uses up; at rest it lasts longer by the ratio of the currents.

    Attributes:
        left: Charge that is left, of 1.
        current_a: Current now.
        full_v: Voltage of the full battery (SIM_BATT_VOLTAGE of ArduPilot's simulator).
        flight_s: How long a charge lasts in the air (SIM_BAT_DRAIN of PX4's simulator).
        least: `left` is never less (SIM_BAT_MIN_PCT, of 1).
    """

    def __init__(self, now_ns: int) -> None:
        self._last_ns = now_ns
        self.left = 1.0
        self.current_a = _REST_A
        self.full_v = FULL_V
        self.flight_s = float(FLIGHT_S)
        self.least = 0.0

    def advance(self, now_ns: int, *, driven: bool) -> None:
        """Use what the time since the last call takes."""
        self.current_a = _HOVER_A if driven else _REST_A
        used = (now_ns - self._last_ns) / 1e9 / self.flight_s * self.current_a / _HOVER_A
        self.left, self._last_ns = max(min(self.least, self.left), self.left - used), now_ns

    @property
    def used_mah(self) -> float:
        """Charge that was used."""
        return (1 - self.left) * self.flight_s / 3.6 * _HOVER_A

    @property
    def voltage_v(self) -> float:
        """Voltage of the whole battery, linear in what is left."""
        empty, full = CELL_V
        return self.full_v * (empty + (full - empty) * self.left) / full
