"""Motion of robots: position and velocity of each at any time."""

import math
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from itertools import accumulate, pairwise
from typing import Final, NamedTuple, Protocol

from fieldkit.core.model import Vector

STILL: Final[Vector] = (0.0, 0.0, 0.0)
"""Velocity of a robot that does not move."""

GRAVITY_M_S2: Final = 9.80665
"""Standard acceleration of gravity (CGPM 1901)."""


LEVEL: Final = (0.0, 0.0)
"""Roll and pitch of a robot on level ground."""


class State(NamedTuple):
    """Position and velocity of a robot; a tuple, which is faster to create than a frozen dataclass.

    Attributes:
        position_m: Metres east, north, up.
        velocity_m_s: Metres per second east, north, up.
        heading_rad: Heading, from east towards north; None if its motion does not define one.
    """

    position_m: Vector
    velocity_m_s: Vector = STILL
    heading_rad: float | None = None

    @property
    def tilt_rad(self) -> tuple[float, float]:
        """Roll (positive with the left side up) and pitch (positive with the nose down)."""
        return self._tilt_rad if isinstance(self, TiltedState) else LEVEL


class TiltedState(State):
    """The state of a robot that is not level.

    The tilt is not an item of the tuple: it is not recorded and not sent to external federates, and it does not
    affect whether two states are equal.
    """

    _tilt_rad: tuple[float, float] = LEVEL

    @classmethod
    def of(
        cls, position_m: Vector, velocity_m_s: Vector, heading_rad: float | None, tilt_rad: tuple[float, float]
    ) -> State:
        """Return a state with this tilt."""
        if tilt_rad == LEVEL:
            return State(position_m, velocity_m_s, heading_rad)
        state = cls(position_m, velocity_m_s, heading_rad)
        state._tilt_rad = tilt_rad
        return state


class Attitude(NamedTuple):
    """Orientation of a body: the rotation by roll about forward, then pitch about left, then yaw about up.

    Attributes:
        yaw_rad: Heading, from east towards north.
        pitch_rad: Positive with the nose down.
        roll_rad: Positive with the left side up.
    """

    yaw_rad: float = 0.0
    pitch_rad: float = 0.0
    roll_rad: float = 0.0


def attitude_of(state: State, *, before: Attitude) -> Attitude:
    """Return the attitude of a robot.

    A robot without a heading faces the direction in which it moves; at rest it keeps the yaw of `before`.
    """
    yaw_rad = state.heading_rad
    if yaw_rad is None:
        east_m_s, north_m_s, _ = state.velocity_m_s
        yaw_rad = math.atan2(north_m_s, east_m_s) if east_m_s or north_m_s else before.yaw_rad
    roll_rad, pitch_rad = state.tilt_rad
    return Attitude(yaw_rad, pitch_rad, roll_rad)


class Lifetime(NamedTuple):
    """The time in which a robot exists.

    Attributes:
        appears_ns: Time from which the robot exists.
        disappears_ns: Time from which it does not exist; None if it never disappears.
    """

    appears_ns: int = 0
    disappears_ns: int | None = None

    @property
    def changes_ns(self) -> tuple[int, ...]:
        """The times after 0 at which the robot appears or disappears."""
        return tuple(at_ns for at_ns in self if at_ns)

    def contains(self, at_ns: int) -> bool:
        """Return True if the robot exists at a time."""
        return self.appears_ns <= at_ns and (self.disappears_ns is None or at_ns < self.disappears_ns)


class Motion(Protocol):
    """Robots that move. Time is in integer nanoseconds since the start of the motion."""

    @property
    def end_ns(self) -> int | None:
        """Time in nanoseconds after which all robots are at rest; None if it is unknown."""
        ...

    def at(self, time_ns: int) -> Mapping[str, State]:
        """Return the state of each robot that it moves, by name; times must not decrease between calls."""
        ...


class WayPoints:
    """One robot moves straight from point to point at one speed, and stops at the last point.

    It has no mutable state: a state depends only on the time. The time at each corner is computed from the distance
    along the whole path, so that rounding errors do not add up.

    Args:
        name: The robot.
        points_m: Its points; the first is its position at time 0.
        speed_m_s: Its speed.

    Raises:
        ValueError: There is no point, or the speed is not above 0.
    """

    def __init__(self, name: str, points_m: Sequence[Vector], speed_m_s: float) -> None:
        if not points_m or not speed_m_s > 0:
            raise ValueError(
                f"a path of {len(points_m)} points at {speed_m_s} m/s is invalid: use a point and a speed above 0"
            )
        self.name = name
        self._speed_m_s = speed_m_s
        self._points_m = tuple(points_m)
        distances_m = accumulate((math.dist(*leg) for leg in pairwise(points_m)), initial=0.0)
        self._times_ns = tuple(round(metres / speed_m_s * 1e9) for metres in distances_m)
        self._legs = [
            _leg(*ends, *times_ns)
            for ends, times_ns in zip(pairwise(points_m), pairwise(self._times_ns), strict=True)
        ]

    @property
    def end_ns(self) -> int:
        """Implement `Motion.end_ns`."""
        return self._times_ns[-1]

    def at(self, time_ns: int) -> Mapping[str, State]:
        """Implement `Motion.at`."""
        return {self.name: self._state(time_ns)}

    def limit_m_s2(self, time_ns: int) -> float:
        """Return an acceleration a for which an extrapolation by the time t has an error of at most a t^2 / 2.

        The extrapolation uses the current velocity, so it has no error until the robot is at the next corner, after
        the time c. From then on, neither the true nor the extrapolated velocity exceeds the speed v, so they differ
        by at most 2 v. The error is therefore at most 2 v (t - c), which is at most (v / c) t^2 / 2.
        """
        corner = bisect_right(self._times_ns, time_ns)
        if corner == len(self._times_ns):
            return 0.0
        return self._speed_m_s * 1e9 / (self._times_ns[corner] - time_ns)

    def _state(self, time_ns: int) -> State:
        if time_ns < 0:
            return State(self._points_m[0])
        corner = bisect_right(self._times_ns, time_ns)
        if corner == len(self._times_ns):
            return State(self._points_m[-1])
        start_ns, duration_ns, (east_m, north_m, up_m), (e, n, u), velocity_m_s = self._legs[corner - 1]
        share = (time_ns - start_ns) / duration_ns
        return State((east_m + share * e, north_m + share * n, up_m + share * u), velocity_m_s)


def _leg(start: Vector, end: Vector, start_ns: int, end_ns: int) -> tuple[int, int, Vector, Vector, Vector]:
    """Return start time, duration, start, displacement and velocity of a leg."""
    e, n, u = (last - first for first, last in zip(start, end, strict=True))
    duration_ns = end_ns - start_ns
    per_s = 1e9 / max(duration_ns, 1)  # a leg without length would divide by 0; `_state` never uses it
    return start_ns, duration_ns, start, (e, n, u), (per_s * e, per_s * n, per_s * u)


class OnGround:
    """A motion whose robots stay on the ground; the heights of the motion are ignored.

    Args:
        motion: The motion.
        up_m: Returns the height of an antenna at a position, metres east and north.
    """

    def __init__(self, motion: Motion, up_m: Callable[[tuple[float, float]], float]) -> None:
        self._motion = motion
        self._up_m = up_m

    @property
    def end_ns(self) -> int | None:
        """Implement `Motion.end_ns`."""
        return self._motion.end_ns

    def at(self, time_ns: int) -> Mapping[str, State]:
        """Implement `Motion.at`."""
        return {name: self._on_ground(state) for name, state in self._motion.at(time_ns).items()}

    def _on_ground(self, state: State) -> State:
        east_m, north_m, _ = state.position_m
        return state._replace(position_m=(east_m, north_m, self._up_m((east_m, north_m))))
