"""Lists of neighbours: who may meet what before a list ends, and how long everybody is free for certain."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

from fieldkit.core.model import Vector
from sim_backends.physics.body import Body, Pose
from sim_backends.physics.collisions import Footprint, gap_m
from sim_backends.physics.grid import CellGrid
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
        poses: How they are now, at places in finite metres.
        grounds: What each stands on, or flies over.
        horizon_s: For how long the list shall hold.

    Attributes:
        near: What each body may meet within the horizon, for those that may meet something.
    """

    def __init__(
        self,
        bodies: Mapping[str, Body[Any]],
        poses: Mapping[str, Pose],
        grounds: Mapping[str, Ground],
        horizon_s: float,
    ) -> None:
        self.near: dict[str, Near] = {}
        self._grounds = grounds
        self._horizon_s = horizon_s
        self._movers = {name: _mover(name, body, poses[name]) for name, body in bodies.items()}
        self._free_s: dict[str, float] = {}
        movers = list(self._movers.values())
        reach_m = max((one.body.radius_m + one.top_speed_m_s * horizon_s for one in movers), default=0.0)
        grid = CellGrid(2 * reach_m)
        for number, mover in enumerate(movers):
            self._stand(mover, grounds[mover.name])
            for other in grid.near(mover.place_m):
                self._pair(mover, movers[other])
            grid.add(number, mover.place_m)

    def free_s(self, name: str) -> float:
        """Return for how long a body meets nothing, at least, from when the list was made."""
        if name not in self._free_s:
            mover, ground = self._movers[name], self._grounds[name]
            others = (_pair_free_s(mover, other) for other in self._movers.values() if other is not mover)
            self._free_s[name] = min(*_ground_free_s(mover, ground), *others, math.inf)
        return self._free_s[name]

    def _stand(self, mover: _Mover, ground: Ground) -> None:
        edge_s, *footprints_s = _ground_free_s(mover, ground)
        for footprint, free_s in zip(ground.around, footprints_s, strict=True):
            if free_s <= self._horizon_s:
                self._near(mover.name).footprints.append(footprint)
        if edge_s <= self._horizon_s:
            self._near(mover.name).ground = ground

    def _pair(self, mover: _Mover, other: _Mover) -> None:
        if _pair_free_s(mover, other) <= self._horizon_s:
            self._near(mover.name).bodies.append(other.name)
            self._near(other.name).bodies.append(mover.name)

    def _near(self, name: str) -> Near:
        return self.near.setdefault(name, Near())


def _ground_free_s(mover: _Mover, ground: Ground) -> list[float]:
    """Return for how long a body meets neither the ground's edge nor, one by one, what stands on it."""
    body, place_m = mover.body, mover.place_m
    gaps_m = [ground.edge_m(place_m), *(gap_m(footprint, body, place_m) for footprint in ground.around)]
    return [_free_s(gap, mover) for gap in gaps_m]


def _pair_free_s(mover: _Mover, other: _Mover) -> float:
    """Return for how long two bodies do not meet; the same, to the last digit, whichever is named first."""
    one, two = mover.body, other.body
    (e, n, u), (other_e, other_n, other_u) = mover.place_m, other.place_m
    aside_m = math.hypot(e - other_e, n - other_n) - (one.radius_m + two.radius_m)
    over_m = max(u - other_u - two.height_m, other_u - u - one.height_m, 0.0)
    return _free_s(math.hypot(max(aside_m, 0.0), over_m), mover, other)


def _mover(name: str, body: Body[Any], pose: Pose) -> _Mover:
    return _Mover(name, body, pose.place_m, math.hypot(*pose.velocity_m_s), body.limit_m_s2(pose), body.top_speed_m_s)


def _free_s(gap_m: float, one: _Mover, other: _Mover | None = None) -> float:
    """Return how long it takes at least until a gap is closed, by one or by two, who may speed up."""
    v, a, top = one.speed_m_s, one.limit_m_s2, one.top_speed_m_s
    if other is not None:
        v, a, top = v + other.speed_m_s, a + other.limit_m_s2, top + other.top_speed_m_s
    # The positive root of a t^2 / 2 + v t = gap, in the form that loses no digits where a is small.
    return max(gap_m / top, 2 * gap_m / (v + math.sqrt(v * v + 2 * a * gap_m)) if gap_m else 0.0)
