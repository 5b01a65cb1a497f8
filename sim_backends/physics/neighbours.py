"""Who may meet what before a list of neighbours ends, and how long everybody is free for certain."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

from fieldkit.core.model import Vector
from sim_backends.physics.body import Body, Pose
from sim_backends.physics.collisions import Footprint, gap_m
from sim_backends.physics.ground import Ground

HORIZON_S: Final = 0.2
"""How long a list holds: long enough that making it costs little, short enough that most bodies are in none."""


@dataclass(slots=True)
class Near:
    """What a body may meet.

    Attributes:
        footprints: Of obstacles, and of the ground for who flies.
        bodies: Names of other bodies.
        ground: The ground, if it is another nearby.
    """

    footprints: list[Footprint] = field(default_factory=list)
    bodies: list[str] = field(default_factory=list)
    ground: Ground | None = None


class _Mover(NamedTuple):
    """A body as it is now."""

    name: str
    body: Body[Any]
    place_m: Vector
    speed_m_s: float
    limit_m_s2: float
    top_speed_m_s: float


class Neighbours:
    """A list of neighbours.

    Args:
        bodies: All bodies.
        poses: How they are now.
        grounds: What each stands on, or flies over.
        horizon_s: For how long the list shall hold.

    Attributes:
        near: What each body may meet within the horizon, for those that may meet something.
        free_s: For how long each body meets nothing, at least.
    """

    def __init__(
        self,
        bodies: Mapping[str, Body[Any]],
        poses: Mapping[str, Pose],
        grounds: Mapping[str, Ground],
        horizon_s: float,
    ) -> None:
        self._horizon_s = horizon_s
        self.near: dict[str, Near] = {}
        self.free_s = dict.fromkeys(bodies, math.inf)
        movers = [_mover(name, body, poses[name]) for name, body in bodies.items()]
        for number, mover in enumerate(movers):
            self._stand(mover, grounds[mover.name])
            for other in movers[:number]:
                self._pair(mover, other)

    def _stand(self, mover: _Mover, ground: Ground) -> None:
        body, place_m = mover.body, mover.place_m
        for footprint in ground.around:
            if self._is_near(mover.name, _free_s(gap_m(footprint, body, place_m), mover)):
                self._near(mover.name).footprints.append(footprint)
        if self._is_near(mover.name, _free_s(ground.edge_m(place_m), mover)):
            self._near(mover.name).ground = ground

    def _pair(self, mover: _Mover, other: _Mover) -> None:
        one, two = mover.body, other.body
        (e, n, u), (other_e, other_n, other_u) = mover.place_m, other.place_m
        aside_m = math.hypot(e - other_e, n - other_n) - one.radius_m - two.radius_m
        over_m = max(u - other_u - two.height_m, other_u - u - one.height_m, 0.0)
        free_s = _free_s(math.hypot(max(aside_m, 0.0), over_m), mover, other)
        # Both, so that each is looked at as the other's time is told.
        if self._is_near(mover.name, free_s) | self._is_near(other.name, free_s):
            self._near(mover.name).bodies.append(other.name)
            self._near(other.name).bodies.append(mover.name)

    def _is_near(self, name: str, free_s: float) -> bool:
        self.free_s[name] = min(self.free_s[name], free_s)
        return free_s <= self._horizon_s

    def _near(self, name: str) -> Near:
        return self.near.setdefault(name, Near())


def _mover(name: str, body: Body[Any], pose: Pose) -> _Mover:
    return _Mover(name, body, pose.place_m, math.hypot(*pose.velocity_m_s), body.limit_m_s2(pose), body.top_speed_m_s)


def _free_s(gap_m: float, one: _Mover, other: _Mover | None = None) -> float:
    """Return how long it takes at least until a gap is closed, by one or by two, who may speed up."""
    v, a, top = one.speed_m_s, one.limit_m_s2, one.top_speed_m_s
    if other is not None:
        v, a, top = v + other.speed_m_s, a + other.limit_m_s2, top + other.top_speed_m_s
    # The positive root of a t^2 / 2 + v t = gap, in the form that loses no digits where a is small.
    return max(gap_m / top, 2 * gap_m / (v + math.sqrt(v * v + 2 * a * gap_m)) if gap_m else 0.0)
