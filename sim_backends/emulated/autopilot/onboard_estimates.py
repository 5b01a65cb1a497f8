"""Estimates on board the emulated drone: its position, its landed state, and the charge of its battery."""

from typing import Final

from fieldkit.core.model import Vector

CELL_V: Final = (3.5, 4.2)
"""Voltage of a lithium polymer cell, empty and full."""
CELLS: Final = 3
"""Number of cells in series."""
FULL_V: Final = CELLS * CELL_V[1]
_HOVER_A: Final = 10.0
"""Current while the motors turn."""
_REST_A: Final = 0.5
"""Current while the motors are off."""

FLIGHT_S: Final = 15 * 60
"""Flight time of a full charge."""


class Battery:
    """Charge of the battery. The current is constant in flight, and lower at rest.

    Attributes:
        charge: Remaining charge, from 0 to 1.
        current_a: Current that the drone draws.
        full_v: Voltage of the full battery (SIM_BATT_VOLTAGE of ArduPilot's simulator).
        flight_s: Flight time of a full charge (SIM_BAT_DRAIN of PX4's simulator).
        min_charge: Minimum of `charge` (SIM_BAT_MIN_PCT as a fraction).
    """

    def __init__(self, now_ns: int) -> None:
        self._last_ns = now_ns
        self.charge = 1.0
        self.current_a = _REST_A
        self.full_v = FULL_V
        self.flight_s = float(FLIGHT_S)
        self.min_charge = 0.0

    def advance(self, now_ns: int, *, motors_on: bool) -> None:
        """Reduce the charge by the consumption since the last call."""
        self.current_a = _HOVER_A if motors_on else _REST_A
        consumption = (now_ns - self._last_ns) / 1e9 / self.flight_s * self.current_a / _HOVER_A
        self.charge, self._last_ns = max(min(self.min_charge, self.charge), self.charge - consumption), now_ns

    @property
    def used_mah(self) -> float:
        """Charge that has been used since power-on."""
        return (1 - self.charge) * self.flight_s * _HOVER_A / 3.6  # 1 mAh is 3.6 As

    @property
    def voltage_v(self) -> float:
        """Voltage of the battery, linear in the remaining charge."""
        empty, full = CELL_V
        return self.full_v * (empty + (full - empty) * self.charge) / full


_GOOD_FLAGS: Final = 831
"""Flags of a good estimate: EKF_STATUS_FLAGS of ArduPilot, ESTIMATOR_STATUS_FLAGS of PX4; the bits are the same."""


class PositionEstimate:
    """The position estimate.

    Args:
        boot_s: Time from power-on until it has an origin.
        starting_flags: Its flags until then.

    Attributes:
        booted_ns: Time of power-on or of the last reboot.
        origin_m: Origin of the local frame in the world, metres east, north, up; None until the estimate is good.
    """

    def __init__(self, boot_s: float, starting_flags: int) -> None:
        self._boot_ns = round(boot_s * 1e9)
        self._starting_flags = starting_flags
        self.booted_ns = 0
        self.origin_m: Vector | None = None

    def boot(self, now_ns: int) -> None:
        """Restart the estimate."""
        self.booted_ns, self.origin_m = now_ns, None

    def advance(self, now_ns: int, place_m: Vector) -> bool:
        """Set the origin to the position in the world when it is due; return True if it was set now."""
        if self.origin_m is not None or self.is_starting(now_ns):
            return False
        self.origin_m = place_m
        return True

    def is_starting(self, now_ns: int) -> bool:
        """Return True if the time until it has an origin has not passed."""
        return now_ns - self.booted_ns < self._boot_ns

    def has_fix(self, now_ns: int) -> bool:
        """Return True if the GPS receiver has a fix, which it gets after half of the time until the origin is set."""
        return self.origin_m is not None or now_ns - self.booted_ns >= self._boot_ns / 2

    @property
    def is_instant(self) -> bool:
        """True if it has an origin immediately after power-on."""
        return not self._boot_ns

    @property
    def flags(self) -> int:
        """The flags that it reports."""
        return self._starting_flags if self.origin_m is None else _GOOD_FLAGS

    def to_local(self, world_m: Vector) -> Vector | None:
        """Return a position in the world relative to the origin; None before there is an origin."""
        if self.origin_m is None:
            return None
        east, north, up = (world - origin for world, origin in zip(world_m, self.origin_m, strict=True))
        return east, north, up

    def to_world(self, local_m: Vector) -> Vector | None:
        """Return the position in the world of a point of the local frame; None before there is an origin."""
        if self.origin_m is None:
            return None
        east, north, up = (local + origin for local, origin in zip(local_m, self.origin_m, strict=True))
        return east, north, up


class LandDetector:
    """Detects take-off and landing.

    Args:
        landed_s: Time on the ground after which it has detected a landing.

    Attributes:
        has_landed: True if it has detected that the drone is on the ground.
        has_flown: True if the drone was in the air since it was armed last.
        grounded_ns: Last time at which the drone was in the air, or the time of `armed_ns` if that is later.
        armed_ns: Time when the drone was armed last, or placed on the ground since then.
    """

    def __init__(self, landed_s: float) -> None:
        self._landed_s = landed_s
        self.has_landed = True
        self.arm(0)

    def place(self, now_ns: int) -> None:
        """Start on the ground."""
        self.has_landed = True
        self.arm(now_ns)

    def arm(self, now_ns: int) -> None:
        """Record that the drone was armed."""
        self.has_flown = False
        self.grounded_ns = self.armed_ns = now_ns

    def advance(self, now_ns: int, *, on_ground: bool) -> None:
        """Update the state with the current contact with the ground."""
        if not on_ground:
            self.has_flown, self.has_landed, self.grounded_ns = True, False, now_ns
        elif now_ns - self.grounded_ns >= self._landed_s * 1e9:
            self.has_landed = True
