"""Neighbour lists: possible contacts of each body before a list expires, and the minimum time to a contact.

A grid over the ground finds the bodies near a position without a search through all bodies.
"""

import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

from fieldkit.core.model import Vector
from sim_backends.physics.body import Body, Pose
from sim_backends.physics.collisions import Footprint, gap_m
from sim_backends.physics.ground import Ground

_ROUNDING: Final = 1 + 1e-9
"""Factor by which cells are larger than required, because the number of a cell is computed with a rounding error."""


class CellGrid:
    """Indices of bodies, grouped by square cells. The nine cells around a position contain all bodies near it.

    Args:
        distance_m: Horizontal distance, in metres, up to which a body is near.
    """

    def __init__(self, distance_m: float) -> None:
        # Cells may be larger than the distance. The minimum of 1 m keeps cell numbers finite for any finite position.
        self._cell_m = max(distance_m * _ROUNDING, 1.0)
        self._cells: defaultdict[tuple[int, int], list[int]] = defaultdict(list)

    def add(self, index: int, place_m: Vector) -> None:
        """Add the index of a body at a position, in finite metres."""
        self._cells[self._cell(place_m)].append(index)

    def nearby_indices(self, place_m: Vector) -> list[int]:
        """Return the indices of all bodies near a position, and of some that are farther away, in ascending order."""
        east, north = self._cell(place_m)
        cells = [(east + e, north + n) for e in (-1, 0, 1) for n in (-1, 0, 1)]
        return sorted(index for cell in cells if cell in self._cells for index in self._cells[cell])

    def _cell(self, place_m: Vector) -> tuple[int, int]:
        return math.floor(place_m[0] / self._cell_m), math.floor(place_m[1] / self._cell_m)


HORIZON_S: Final = 0.2
"""Validity of a list: long enough that building it costs little, short enough that most bodies have no neighbour."""


@dataclass(slots=True)
class ContactCandidates:
    """Possible contacts of a body.

    Attributes:
        footprints: Footprints of obstacles, and of the ground for a flying body.
        bodies: Names of other bodies.
        ground: The ground, if its height changes nearby.
    """

    footprints: list[Footprint] = field(default_factory=list)
    bodies: list[str] = field(default_factory=list)
    ground: Ground | None = None


class _Kinematics(NamedTuple):
    """The current position and speed of a body, its maximum acceleration and its top speed."""

    name: str
    body: Body[Any]
    place_m: Vector
    speed_m_s: float
    limit_m_s2: float
    top_speed_m_s: float


class Neighbours:
    """The possible contacts of all bodies until a horizon, after which the list expires.

    Args:
        bodies: All bodies.
        poses: Their current poses, with finite positions.
        grounds: The ground of each body.
        horizon_s: Validity of the list.

    Attributes:
        candidates: Possible contacts within the horizon, for the bodies that have any.
    """

    def __init__(
        self,
        bodies: Mapping[str, Body[Any]],
        poses: Mapping[str, Pose],
        grounds: Mapping[str, Ground],
        horizon_s: float,
    ) -> None:
        self.candidates: dict[str, ContactCandidates] = {}
        self._grounds = grounds
        self._horizon_s = horizon_s
        self._kinematics_by_name = {name: _kinematics(name, body, poses[name]) for name, body in bodies.items()}
        self._min_times_s: dict[str, float] = {}
        movers = list(self._kinematics_by_name.values())
        reach_m = max((mover.body.radius_m + mover.top_speed_m_s * horizon_s for mover in movers), default=0.0)
        grid = CellGrid(2 * reach_m)
        for index, mover in enumerate(movers):
            self._add_ground_candidates(mover, grounds[mover.name])
            for other in grid.nearby_indices(mover.place_m):
                self._add_pair_candidates(mover, movers[other])
            grid.add(index, mover.place_m)

    def min_time_to_contact_s(self, name: str) -> float:
        """Return the minimum time from the creation of the list to a contact of a body."""
        if name not in self._min_times_s:
            mover, ground = self._kinematics_by_name[name], self._grounds[name]
            others = (_pair_time_s(mover, other) for other in self._kinematics_by_name.values() if other is not mover)
            self._min_times_s[name] = min(*_ground_times_s(mover, ground), *others, math.inf)
        return self._min_times_s[name]

    def _add_ground_candidates(self, mover: _Kinematics, ground: Ground) -> None:
        edge_s, *obstacle_times_s = _ground_times_s(mover, ground)
        for footprint, time_s in zip(ground.obstacles, obstacle_times_s, strict=True):
            if time_s <= self._horizon_s:
                self._candidates_of(mover.name).footprints.append(footprint)
        if edge_s <= self._horizon_s:
            self._candidates_of(mover.name).ground = ground

    def _add_pair_candidates(self, mover: _Kinematics, other: _Kinematics) -> None:
        if _pair_time_s(mover, other) <= self._horizon_s:
            self._candidates_of(mover.name).bodies.append(other.name)
            self._candidates_of(other.name).bodies.append(mover.name)

    def _candidates_of(self, name: str) -> ContactCandidates:
        return self.candidates.setdefault(name, ContactCandidates())


def _ground_times_s(mover: _Kinematics, ground: Ground) -> list[float]:
    """Return the minimum times to reach the ground's edge and each obstacle on the ground."""
    body, place_m = mover.body, mover.place_m
    gaps_m = [ground.edge_m(place_m), *(gap_m(footprint, body, place_m) for footprint in ground.obstacles)]
    return [_closing_time_s(gap, mover) for gap in gaps_m]


def _pair_time_s(mover: _Kinematics, other: _Kinematics) -> float:
    """Return the minimum time to a contact of two bodies; the result is exactly the same for both orders of them."""
    first, second = mover.body, other.body
    (e, n, u), (other_e, other_n, other_u) = mover.place_m, other.place_m
    horizontal_m = math.hypot(e - other_e, n - other_n) - (first.radius_m + second.radius_m)
    vertical_m = max(u - other_u - second.height_m, other_u - u - first.height_m, 0.0)
    return _closing_time_s(math.hypot(max(horizontal_m, 0.0), vertical_m), mover, other)


def _kinematics(name: str, body: Body[Any], pose: Pose) -> _Kinematics:
    return _Kinematics(
        name, body, pose.place_m, math.hypot(*pose.velocity_m_s), body.limit_m_s2(pose), body.top_speed_m_s
    )


def _closing_time_s(gap_m: float, mover: _Kinematics, other: _Kinematics | None = None) -> float:
    """Return the minimum time in which one or two bodies can close a gap, including acceleration."""
    v, a, top = mover.speed_m_s, mover.limit_m_s2, mover.top_speed_m_s
    if other is not None:
        v, a, top = v + other.speed_m_s, a + other.limit_m_s2, top + other.top_speed_m_s
    # The positive root of a t^2 / 2 + v t = gap, in a form that loses no digits for small a.
    return max(gap_m / top, 2 * gap_m / (v + math.sqrt(v * v + 2 * a * gap_m)) if gap_m else 0.0)
