"""Who may meet what before a list of neighbours ends, and how long everybody is free for certain."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from fieldkit.core.model import Vector
from sim_backends.physics.body import Body
from sim_backends.physics.collisions import Footprint, Ledge, gap_m
from sim_backends.physics.ground import Ground

HORIZON_S: Final = 0.2
"""How long a list holds: long enough that making it costs little, short enough that most bodies are in none."""


@dataclass(slots=True)
class Near:
    """What a body may meet.

    Attributes:
        footprints: Of obstacles, and of the ground for who flies.
        bodies: Names of other bodies.
        ledge: Ground that ends near it.
    """

    footprints: list[Footprint] = field(default_factory=list)
    bodies: list[str] = field(default_factory=list)
    ledge: Ledge | None = None


class Neighbours:
    """A list of neighbours.

    Args:
        bodies: All bodies.
        places_m: Where they are now.
        ground: The ground, and what stands on it.
        horizon_s: For how long the list shall hold.

    Attributes:
        near: What each body may meet within the horizon, for those that may meet something.
        free_s: For how long each body meets nothing, at least.
    """

    def __init__(
        self, bodies: Mapping[str, Body[Any]], places_m: Mapping[str, Vector], ground: Ground, horizon_s: float
    ) -> None:
        self._bodies = bodies
        self._places_m = places_m
        self._horizon_s = horizon_s
        self.near: dict[str, Near] = {}
        self.free_s = dict.fromkeys(bodies, math.inf)
        names = list(bodies)
        for number, name in enumerate(names):
            self._stand(name, ground)
            for other in names[:number]:
                self._pair(name, other)

    def _stand(self, name: str, ground: Ground) -> None:
        body, place_m = self._bodies[name], self._places_m[name]
        around = ground.around(flies=body.flies)
        for footprint in around:
            if self._is_near(name, gap_m(footprint, body, place_m) / body.top_speed_m_s):
                self._near(name).footprints.append(footprint)
        plateau = None if body.flies else ground.plateau(place_m)
        if plateau is not None and self._is_near(name, plateau.gap_m(place_m) / body.top_speed_m_s):
            self._near(name).ledge = plateau

    def _pair(self, name: str, other: str) -> None:
        one, two = self._bodies[name], self._bodies[other]
        (e, n, u), (other_e, other_n, other_u) = self._places_m[name], self._places_m[other]
        aside_m = math.hypot(e - other_e, n - other_n) - one.radius_m - two.radius_m
        over_m = max(u - other_u - two.height_m, other_u - u - one.height_m, 0.0)
        free_s = math.hypot(max(aside_m, 0.0), over_m) / (one.top_speed_m_s + two.top_speed_m_s)
        # Both, so that each is looked at as the other's time is told.
        if self._is_near(name, free_s) | self._is_near(other, free_s):
            self._near(name).bodies.append(other)
            self._near(other).bodies.append(name)

    def _is_near(self, name: str, free_s: float) -> bool:
        self.free_s[name] = min(self.free_s[name], free_s)
        return free_s <= self._horizon_s

    def _near(self, name: str) -> Near:
        return self.near.setdefault(name, Near())
