"""Programs that steer a body through waypoints, using only the body's own state."""

import math
from collections.abc import Sequence
from typing import Final

from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Vector
from sim_backends.cosim.federates import Action
from sim_backends.cosim.programs.beats import PERIOD_NS, NeverSends, PeriodicTimer
from sim_backends.network.packets import Received
from sim_backends.physics.body import Twist, Velocity
from sim_backends.world.motion import State

_TURNING_PER_S: Final = 2.0
"""Rate of turn per radian of heading error."""
_APPROACH_PER_S: Final = 1.0
"""Speed per metre of distance from the waypoint, for bodies that fly."""


class DriveThrough(NeverSends):
    """Drives a wheeled body from point to point, and stops at the last.

    It turns towards a point at a rate proportional to the heading error, and drives slower the larger that error is.

    Args:
        points_m: The waypoints, metres east and north.
        speed_m_s: Speed.
        begin_ns: Time of the first command.
        period_ns: Time between commands.
        reached_m: Distance within which a point counts as reached.
        braking_m_s2: Deceleration before the last point.

    Raises:
        ConfigurationError: There are no points, or speed or period is not above 0.
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
        self._timer = PeriodicTimer(period_ns, begin_ns)
        self._has_arrived = False
        self._reached_m = reached_m
        self._braking_m_s2 = braking_m_s2
        self._next = 0

    def next_wake_ns(self) -> int | None:
        """Return the time of the next command, or None after the last point."""
        return None if self._has_arrived else self._timer.next_ns

    def wake(self, now_ns: int, own_state: State, received: Sequence[Received]) -> Action:  # noqa: ARG002 (Program)
        """Steer towards the next point if a command is due."""
        if self._has_arrived or not self._timer.fire_if_due(now_ns):
            return Action()
        here_m = own_state.position_m[:2]
        while self._next < len(self._points_m) and math.dist(here_m, self._points_m[self._next]) <= self._reached_m:
            self._next += 1
        if self._next == len(self._points_m):
            self._has_arrived = True
            return Action(command=Twist())
        speed_m_s = self._speed_m_s
        if self._next == len(self._points_m) - 1:
            left_m = math.dist(here_m, self._points_m[-1])
            speed_m_s = min(speed_m_s, math.sqrt(2 * self._braking_m_s2 * left_m))
        return Action(command=drive_towards(own_state, self._points_m[self._next], speed_m_s))


class FlyThrough(NeverSends):
    """Flies a body from point to point, and hovers at the last.

    Args:
        points_m: The waypoints, metres east, north, up.
        speed_m_s: Speed.
        begin_ns: Time of the first command.
        period_ns: Time between commands.
        reached_m: Distance within which a point counts as reached.

    Raises:
        ConfigurationError: There are no points, or speed or period is not above 0.
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
        self._timer = PeriodicTimer(period_ns, begin_ns)
        self._reached_m = reached_m
        self._next = 0

    def next_wake_ns(self) -> int:
        """Return the time of the next command."""
        return self._timer.next_ns

    def wake(self, now_ns: int, own_state: State, received: Sequence[Received]) -> Action:  # noqa: ARG002 (Program)
        """Steer towards the next point if a command is due."""
        if not self._timer.fire_if_due(now_ns):
            return Action()
        last = len(self._points_m) - 1
        while self._next < last and math.dist(own_state.position_m, self._points_m[self._next]) <= self._reached_m:
            self._next += 1
        stops = self._next == last
        return Action(command=fly_towards(own_state, self._points_m[self._next], self._speed_m_s, stops=stops))


def drive_towards(own_state: State, point_m: tuple[float, float], speed_m_s: float) -> Twist:
    """Return the command that drives a wheeled body towards a point.

    Args:
        own_state: State of the body.
        point_m: The point, metres east and north.
        speed_m_s: Speed when the body heads towards the point.

    Raises:
        ConfigurationError: The state has no heading.
    """
    if own_state.heading_rad is None:
        raise ConfigurationError(
            "a program that drives needs the heading of its robot, and the states of this motion have none",
            remedy="use a body that has a heading, such as DifferentialDrive",
        )
    bearing_rad = math.atan2(point_m[1] - own_state.position_m[1], point_m[0] - own_state.position_m[0])
    error_rad = math.remainder(bearing_rad - own_state.heading_rad, math.tau)
    return Twist(speed_m_s * max(math.cos(error_rad), 0.0), _TURNING_PER_S * error_rad)


def fly_towards(own_state: State, point_m: Vector, speed_m_s: float, *, stops: bool = True) -> Velocity:
    """Return the command that flies a body towards a point.

    Args:
        own_state: State of the body.
        point_m: The point, metres east, north, up.
        speed_m_s: Top speed.
        stops: True to slow down and stop at the point.
    """
    off_m = [there - here for here, there in zip(own_state.position_m, point_m, strict=True)]
    left_m = math.hypot(*off_m)
    if not left_m:
        return Velocity()
    target_m_s = min(speed_m_s, _APPROACH_PER_S * left_m) if stops else speed_m_s
    east, north, up = (target_m_s * part / left_m for part in off_m)
    return Velocity((east, north, up))


def _check(points_m: Sequence[Sequence[float]], speed_m_s: float) -> None:
    if not points_m or not 0 < speed_m_s < math.inf:
        raise ConfigurationError(
            f"{len(points_m)} points at {speed_m_s:g} m/s are not a path",
            remedy="add at least one point, and a speed above 0",
        )
