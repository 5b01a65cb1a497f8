"""Motion of robots: position and velocity of each at any time."""

import math
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from itertools import accumulate, pairwise
from typing import Final, NamedTuple, Protocol

from fieldkit.core.model import Vector

STILL: Final[Vector] = (0.0, 0.0, 0.0)


class State(NamedTuple):
    """Place and velocity of a robot; many are made, which a tuple is quicker at than a frozen dataclass.

    Attributes:
        position_m: Metres east, north, up.
        velocity_m_s: Metres per second east, north, up.
        heading_rad: Where it heads, from east towards north; None where its motion tells none.
    """

    position_m: Vector
    velocity_m_s: Vector = STILL
    heading_rad: float | None = None


class Motion(Protocol):
    """Robots that move. Time is in integer nanoseconds since the motion began."""

    @property
    def end_ns(self) -> int | None:
        """Time from which on all of them stand for good, nanoseconds; None where nobody knows."""
        ...

    def at(self, time_ns: int) -> Mapping[str, State]:
        """Return the state of each robot that it moves, by name; asked with times that never go back."""
        ...


class WayPoints:
    """One robot goes straight from point to point at one speed, and stands at the last.

    It is pure: the same time gives the same state, whatever was asked before. A corner is passed at the nanosecond
    that its distance along the way gives, so that rounding does not add up.

    Args:
        name: The robot.
        points_m: Where it goes, the first being where it is at time 0.
        speed_m_s: How fast.

    Raises:
        ValueError: There is no point, or the speed is not above 0.
    """

    def __init__(self, name: str, points_m: Sequence[Vector], speed_m_s: float) -> None:
        if not points_m or not speed_m_s > 0:
            raise ValueError(f"no way: {len(points_m)} points at {speed_m_s} m/s")
        self.name = name
        self._speed_m_s = speed_m_s
        self._points_m = tuple(points_m)
        so_far_m = accumulate((math.dist(*leg) for leg in pairwise(points_m)), initial=0.0)
        self._times_ns = tuple(round(metres / speed_m_s * 1e9) for metres in so_far_m)
        self._legs = [
            _leg(*ends, *times_ns)
            for ends, times_ns in zip(pairwise(points_m), pairwise(self._times_ns), strict=True)
        ]

    @property
    def end_ns(self) -> int:
        """See `Motion.end_ns`."""
        return self._times_ns[-1]

    def at(self, time_ns: int) -> Mapping[str, State]:
        """See `Motion.at`."""
        return {self.name: self._state(time_ns)}

    def limit_m_s2(self, time_ns: int) -> float:
        """Return an acceleration a such that who moves on at the velocity of now is off by at most a t^2 / 2.

        Up to the next corner, c from now, there is no error; behind it two velocities of speed v differ by at most
        2 v. So the error is at most 2 v (t - c), which is never more than (v / c) t^2 / 2.
        """
        passed = bisect_right(self._times_ns, time_ns)
        if passed == len(self._times_ns):
            return 0.0
        return self._speed_m_s * 1e9 / (self._times_ns[passed] - time_ns)

    def _state(self, time_ns: int) -> State:
        if time_ns < 0:
            return State(self._points_m[0])
        passed = bisect_right(self._times_ns, time_ns)
        if passed == len(self._times_ns):
            return State(self._points_m[-1])
        began_ns, takes_ns, (east_m, north_m, up_m), (e, n, u), velocity_m_s = self._legs[passed - 1]
        share = (time_ns - began_ns) / takes_ns
        return State((east_m + share * e, north_m + share * n, up_m + share * u), velocity_m_s)


def _leg(begin: Vector, end: Vector, begins_ns: int, ends_ns: int) -> tuple[int, int, Vector, Vector, Vector]:
    """Return when a leg begins, how long it takes, where it begins, how far it goes, and the velocity on it."""
    e, n, u = (there - here for here, there in zip(begin, end, strict=True))
    takes_ns = ends_ns - begins_ns
    per_s = 1e9 / max(takes_ns, 1)  # of no length: never on the way
    return begins_ns, takes_ns, begin, (e, n, u), (per_s * e, per_s * n, per_s * u)


class OnGround:
    """A motion whose robots stay on the ground, whatever height it gives them.

    Args:
        motion: The motion.
        up_m: Height of an antenna at a place, metres east and north.
    """

    def __init__(self, motion: Motion, up_m: Callable[[tuple[float, float]], float]) -> None:
        self._motion = motion
        self._up_m = up_m

    @property
    def end_ns(self) -> int | None:
        """See `Motion.end_ns`."""
        return self._motion.end_ns

    def at(self, time_ns: int) -> Mapping[str, State]:
        """See `Motion.at`."""
        return {name: self._on_ground(state) for name, state in self._motion.at(time_ns).items()}

    def _on_ground(self, state: State) -> State:
        east_m, north_m, _ = state.position_m
        return state._replace(position_m=(east_m, north_m, self._up_m((east_m, north_m))))
