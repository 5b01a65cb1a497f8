"""Programs that steer a body through points, by what it senses of itself and nothing else."""

import math
from collections.abc import Sequence
from typing import Final

from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Vector
from sim_backends.cosim.federates import Action
from sim_backends.cosim.programs.beats import PERIOD_NS, Beat, NeverSends
from sim_backends.network.packets import Received
from sim_backends.physics.body import Twist, Velocity
from sim_backends.world.motion import State

_TURNING_PER_S: Final = 2.0
"""Rate of turn for each radian that the heading is off."""
_NEARING_PER_S: Final = 1.0
"""Speed for each metre that a body in the air is off its point."""


class DriveThrough(NeverSends):
    """Drives a body on wheels from point to point, and stops at the last.

    It turns towards a point at a rate that goes with the angle, and drives the slower the more it heads elsewhere.

    Args:
        points_m: Where it goes, metres east and north.
        speed_m_s: How fast.
        begin_ns: When it starts.
        period_ns: From one command to the next.
        reached_m: How near it has to come to a point.
        braking_m_s2: How it slows down before the last.

    Raises:
        ConfigurationError: There is no point, or speed or period is not above 0.
    """

    def __init__(
        self,
        points_m: Sequence[tuple[float, float]],
        speed_m_s: float,
        *,
        begin_ns: int = 0,
        period_ns: int = PERIOD_NS,
        reached_m: float = 0.1,
        braking_m_s2: float = 0.5,
    ) -> None:
        _check(points_m, speed_m_s)
        self._points_m = tuple(points_m)
        self._speed_m_s = speed_m_s
        self._beat = Beat(period_ns, begin_ns)
        self._arrived = False
        self._reached_m = reached_m
        self._braking_m_s2 = braking_m_s2
        self._next = 0

    def next_wake_ns(self) -> int | None:
        """See `Program.next_wake_ns`."""
        return None if self._arrived else self._beat.next_ns

    def wake(self, now_ns: int, own: State, received: Sequence[Received]) -> Action:  # noqa: ARG002 (see Program)
        """See `Program.wake`."""
        if self._arrived or not self._beat.is_due(now_ns):
            return Action()
        here_m = own.position_m[:2]
        while self._next < len(self._points_m) and math.dist(here_m, self._points_m[self._next]) <= self._reached_m:
            self._next += 1
        if self._next == len(self._points_m):
            self._arrived = True
            return Action(command=Twist())
        speed_m_s = self._speed_m_s
        if self._next == len(self._points_m) - 1:
            left_m = math.dist(here_m, self._points_m[-1])
            speed_m_s = min(speed_m_s, math.sqrt(2 * self._braking_m_s2 * left_m))
        return Action(command=drive_towards(own, self._points_m[self._next], speed_m_s))


class FlyThrough(NeverSends):
    """Flies a body from point to point, and stays at the last.

    Args:
        points_m: Where it goes, metres east, north, up.
        speed_m_s: How fast.
        begin_ns: When it starts.
        period_ns: From one command to the next.
        reached_m: How near it has to come to a point.

    Raises:
        ConfigurationError: There is no point, or speed or period is not above 0.
    """

    def __init__(
        self,
        points_m: Sequence[Vector],
        speed_m_s: float,
        *,
        begin_ns: int = 0,
        period_ns: int = PERIOD_NS,
        reached_m: float = 0.3,
    ) -> None:
        _check(points_m, speed_m_s)
        self._points_m = tuple(points_m)
        self._speed_m_s = speed_m_s
        self._beat = Beat(period_ns, begin_ns)
        self._reached_m = reached_m
        self._next = 0

    def next_wake_ns(self) -> int:
        """See `Program.next_wake_ns`."""
        return self._beat.next_ns

    def wake(self, now_ns: int, own: State, received: Sequence[Received]) -> Action:  # noqa: ARG002 (see Program)
        """See `Program.wake`."""
        if not self._beat.is_due(now_ns):
            return Action()
        last = len(self._points_m) - 1
        while self._next < last and math.dist(own.position_m, self._points_m[self._next]) <= self._reached_m:
            self._next += 1
        slows = self._next == last
        return Action(command=fly_towards(own, self._points_m[self._next], self._speed_m_s, slows=slows))


def drive_towards(own: State, point_m: tuple[float, float], speed_m_s: float) -> Twist:
    """Return what brings a body on wheels to a point.

    Args:
        own: Its state.
        point_m: The point, metres east and north.
        speed_m_s: How fast it goes when it heads there.

    Raises:
        ConfigurationError: Its state tells no heading.
    """
    if own.heading_rad is None:
        raise ConfigurationError(
            "a program that drives needs to know where its robot heads, which its motion does not tell",
            remedy="let it run on a body, such as DifferentialDrive",
        )
    bearing_rad = math.atan2(point_m[1] - own.position_m[1], point_m[0] - own.position_m[0])
    off_rad = math.remainder(bearing_rad - own.heading_rad, math.tau)
    return Twist(speed_m_s * max(math.cos(off_rad), 0.0), _TURNING_PER_S * off_rad)


def fly_towards(own: State, point_m: Vector, speed_m_s: float, *, slows: bool = True) -> Velocity:
    """Return what brings a body in the air to a point.

    Args:
        own: Its state.
        point_m: The point, metres east, north, up.
        speed_m_s: The most that it flies.
        slows: Whether it shall stop there.
    """
    off_m = [there - here for here, there in zip(own.position_m, point_m, strict=True)]
    left_m = math.hypot(*off_m)
    if not left_m:
        return Velocity()
    wanted_m_s = min(speed_m_s, _NEARING_PER_S * left_m) if slows else speed_m_s
    east, north, up = (wanted_m_s * part / left_m for part in off_m)
    return Velocity((east, north, up))


def _check(points_m: Sequence[Sequence[float]], speed_m_s: float) -> None:
    if not points_m or not 0 < speed_m_s < math.inf:
        raise ConfigurationError(
            f"no way: {len(points_m)} points at {speed_m_s:g} m/s",
            remedy="give it at least one point, and a speed above 0",
        )
