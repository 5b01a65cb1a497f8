"""The position estimate of an autopilot: it has an origin some time after power-on."""

from typing import Final

from fieldkit.core.model import Vector

_GOOD: Final = 831
"""Flags of a good estimate: EKF_STATUS_FLAGS of ArduPilot, ESTIMATOR_STATUS_FLAGS of PX4; the bits are the same."""


class PositionEstimate:
    """The position estimate.

    Args:
        boot_s: Time from power-on until it has an origin.
        starting_flags: Its flags until then.

    Attributes:
        booted_ns: When the autopilot was switched on, or booted again.
        origin_m: Origin of the local frame in the world, metres east, north, up; None until the estimate is good.
    """

    def __init__(self, boot_s: float, starting_flags: int) -> None:
        self._boot_ns = round(boot_s * 1e9)
        self._starting_flags = starting_flags
        self.booted_ns = 0
        self.origin_m: Vector | None = None

    def boot(self, now_ns: int) -> None:
        """Start anew."""
        self.booted_ns, self.origin_m = now_ns, None

    def advance(self, now_ns: int, place_m: Vector) -> bool:
        """Set the origin to the place in the world when the time has come; return whether that was now."""
        if self.origin_m is not None or self.is_starting(now_ns):
            return False
        self.origin_m = place_m
        return True

    def is_starting(self, now_ns: int) -> bool:
        """Return whether the time until it has an origin is not over."""
        return now_ns - self.booted_ns < self._boot_ns

    def has_fix(self, now_ns: int) -> bool:
        """Return whether the GPS receiver has a fix: after half of that time."""
        return self.origin_m is not None or now_ns - self.booted_ns >= self._boot_ns / 2

    @property
    def is_instant(self) -> bool:
        """Whether it has an origin from power-on."""
        return not self._boot_ns

    @property
    def flags(self) -> int:
        """Flags that it reports."""
        return self._starting_flags if self.origin_m is None else _GOOD

    def to_local(self, world_m: Vector) -> Vector | None:
        """Return a place in the world relative to the origin; None before there is an origin."""
        if self.origin_m is None:
            return None
        east, north, up = (place - origin for place, origin in zip(world_m, self.origin_m, strict=True))
        return east, north, up

    def to_world(self, local_m: Vector) -> Vector | None:
        """Return a place of the local frame in the world; None before there is an origin."""
        if self.origin_m is None:
            return None
        east, north, up = (place + origin for place, origin in zip(local_m, self.origin_m, strict=True))
        return east, north, up
