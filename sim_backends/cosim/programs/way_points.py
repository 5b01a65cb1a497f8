"""Programs that steer an agent along waypoints, or with a sequence of velocities."""

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Final

from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Vector
from fieldkit.core.units import format_count
from sim_backends.cosim.federates import Action
from sim_backends.network.packets import ReceivedDatagram
from sim_backends.physics.body import Twist, Velocity
from sim_backends.world.motion import State

PERIOD_NS: Final = 50_000_000
"""Period of the usual control rate of 20 Hz (ROS 2 Navigation, `controller_frequency`)."""


class NeverSends:
    """A program that steers its body, and sends nothing."""

    def next_send_ns(self) -> None:
        """Return None: it never sends."""


class PeriodicTimer:
    """A timer with a fixed period.

    Args:
        period_ns: Its period.
        begin_ns: Time at which it fires first.

    Attributes:
        next_ns: Time at which it fires next.

    Raises:
        ConfigurationError: The period is not above 0.
    """

    def __init__(self, period_ns: int, begin_ns: int = 0) -> None:
        if period_ns <= 0:
            raise ConfigurationError(f"a period of {period_ns} ns is not above 0", remedy="set a period above 0")
        self.next_ns = begin_ns
        self._period_ns = period_ns

    def fire_if_due(self, now_ns: int) -> bool:
        """Return True if the timer fires; missed periods, for example after a clock was set ahead, are skipped."""
        late_ns = now_ns - self.next_ns
        if late_ns < 0:
            return False
        self.next_ns += self._period_ns * (late_ns // self._period_ns + 1)
        return True


_TURNING_PER_S: Final = 2.0
"""Rate of turn per radian of heading error."""
_APPROACH_PER_S: Final = 1.0
"""Speed per metre of distance from the waypoint, for bodies that fly."""


class DriveThrough(NeverSends):
    """Drives a wheeled body from point to point, and stops at the last point.

    It turns towards a point at a rate proportional to the heading error. A larger error reduces its speed.

    Args:
        points_m: The waypoints, metres east and north.
        speed_m_s: Speed when it heads towards the next point, before it brakes.
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
        _check_path(points_m, speed_m_s)
        self._points_m = tuple(points_m)
        self._speed_m_s = speed_m_s
        self._timer = PeriodicTimer(period_ns, begin_ns)
        self._has_arrived = False
        self._reached_m = reached_m
        self._braking_m_s2 = braking_m_s2
        self._next_index = 0

    def next_wake_ns(self) -> int | None:
        """Return the time of the next command, or None after the last point."""
        return None if self._has_arrived else self._timer.next_ns

    def wake(self, now_ns: int, own_state: State, received_datagrams: Sequence[ReceivedDatagram]) -> Action:  # noqa: ARG002 (Program)
        """Steer towards the next point if a command is due."""
        if self._has_arrived or not self._timer.fire_if_due(now_ns):
            return Action()
        here_m = own_state.position_m[:2]
        while (
            self._next_index < len(self._points_m)
            and math.dist(here_m, self._points_m[self._next_index]) <= self._reached_m
        ):
            self._next_index += 1
        if self._next_index == len(self._points_m):
            self._has_arrived = True
            return Action(command=Twist())
        speed_m_s = self._speed_m_s
        if self._next_index == len(self._points_m) - 1:
            remaining_m = math.dist(here_m, self._points_m[-1])
            speed_m_s = min(speed_m_s, math.sqrt(2 * self._braking_m_s2 * remaining_m))
        return Action(command=drive_towards(own_state, self._points_m[self._next_index], speed_m_s))


class FlyThrough(NeverSends):
    """Flies a body from point to point, and hovers at the last point.

    Args:
        points_m: The waypoints, metres east, north, up.
        speed_m_s: Speed, before it slows down at the last point.
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
        _check_path(points_m, speed_m_s)
        self._points_m = tuple(points_m)
        self._speed_m_s = speed_m_s
        self._timer = PeriodicTimer(period_ns, begin_ns)
        self._reached_m = reached_m
        self._next_index = 0

    def next_wake_ns(self) -> int:
        """Return the time of the next command."""
        return self._timer.next_ns

    def wake(self, now_ns: int, own_state: State, received_datagrams: Sequence[ReceivedDatagram]) -> Action:  # noqa: ARG002 (Program)
        """Steer towards the next point if a command is due."""
        if not self._timer.fire_if_due(now_ns):
            return Action()
        last_index = len(self._points_m) - 1
        while (
            self._next_index < last_index
            and math.dist(own_state.position_m, self._points_m[self._next_index]) <= self._reached_m
        ):
            self._next_index += 1
        stops = self._next_index == last_index
        return Action(command=fly_towards(own_state, self._points_m[self._next_index], self._speed_m_s, stops=stops))


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
            "a program that drives needs the heading of its robot, but the states of this body have no heading",
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
    offset_m = [target - position for position, target in zip(own_state.position_m, point_m, strict=True)]
    remaining_m = math.hypot(*offset_m)
    if not remaining_m:
        return Velocity()
    target_m_s = min(speed_m_s, _APPROACH_PER_S * remaining_m) if stops else speed_m_s
    east, north, up = (target_m_s * part / remaining_m for part in offset_m)
    return Velocity((east, north, up))


def _check_path(points_m: Sequence[Sequence[float]], speed_m_s: float) -> None:
    if not points_m or not 0 < speed_m_s < math.inf:
        raise ConfigurationError(
            f"a path of {format_count(len(points_m), 'point')} at {speed_m_s:g} m/s is impossible",
            remedy="use at least one point and a finite speed above 0",
        )


@dataclass(frozen=True, slots=True)
class ProfileLeg:
    """A part of a velocity profile.

    Attributes:
        duration_ns: Its duration.
        command: The command to the body.
    """

    duration_ns: int
    command: Twist | Velocity


class VelocityProfile(NeverSends):
    """Commands the body with the velocity of each leg in order, and then stops it.

    Args:
        legs: The legs.
        begin_ns: Beginning of the first leg.

    Raises:
        ConfigurationError: There are no legs, or a duration is not above 0.
    """

    def __init__(self, legs: Sequence[ProfileLeg], *, begin_ns: int = 0) -> None:
        if not legs or any(leg.duration_ns <= 0 for leg in legs):
            raise ConfigurationError(
                "a velocity profile has no legs, or a leg without a duration",
                remedy="give each leg a duration above 0",
            )
        stop = Twist() if isinstance(legs[-1].command, Twist) else Velocity()
        self._commands = [*(leg.command for leg in legs), stop]
        self._times_ns = list(accumulate((leg.duration_ns for leg in legs), initial=begin_ns))
        self._next_index = 0

    def next_wake_ns(self) -> int | None:
        """Return the beginning of the next leg or, during the last leg, its end; None after the end."""
        return self._times_ns[self._next_index] if self._next_index < len(self._times_ns) else None

    def wake(self, now_ns: int, own_state: State, received_datagrams: Sequence[ReceivedDatagram]) -> Action:  # noqa: ARG002 (Program)
        """Return the command of a leg that has begun, or to stop if the last leg has ended; else no command."""
        begun_legs = bisect_right(self._times_ns, now_ns)
        if begun_legs == self._next_index:
            return Action()
        self._next_index = begun_legs
        return Action(command=self._commands[begun_legs - 1])


class SpeedOscillation(NeverSends):
    """Drives straight ahead at a speed that oscillates as a sine; used to measure string stability.

    Args:
        mean_m_s: Mean of the speed.
        amplitude_m_s: Amplitude of the oscillation.
        period_s: Period of the oscillation.
        every_ns: Time between commands.

    Raises:
        ConfigurationError: A period is not above 0.
    """

    def __init__(self, mean_m_s: float, amplitude_m_s: float, period_s: float, *, every_ns: int = 10_000_000) -> None:
        if not 0 < period_s < math.inf:
            raise ConfigurationError(
                f"a period of {period_s:g} s is not above 0 and finite", remedy="set a period above 0"
            )
        self._mean_m_s = mean_m_s
        self._amplitude_m_s = amplitude_m_s
        self._rate_rad_s = math.tau / period_s
        self._timer = PeriodicTimer(every_ns)

    def next_wake_ns(self) -> int:
        """Return the time of the next command."""
        return self._timer.next_ns

    def wake(self, now_ns: int, own_state: State, received_datagrams: Sequence[ReceivedDatagram]) -> Action:  # noqa: ARG002 (Program)
        """Return the command for the current speed if it is due."""
        if not self._timer.fire_if_due(now_ns):
            return Action()
        return Action(command=Twist(self._mean_m_s + self._amplitude_m_s * math.sin(self._rate_rad_s * now_ns / 1e9)))
