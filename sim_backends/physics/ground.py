"""Ground that bodies stand on: flat, raised in places, with upright sides that nobody climbs or drives off."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from fieldkit.core.model import Vector
from sim_backends.physics.collisions import TOUCH_M, Footprint, of_shape, rectangle
from sim_backends.world.obstacles import Raised
from sim_backends.world.world import World


@dataclass(frozen=True)
class Plateau:
    """Raised ground of one height; where pieces of it meet, it is one.

    Attributes:
        name: Of its first piece.
        pieces: The pieces.
    """

    name: str
    pieces: Sequence[Raised]

    def back_m(self, place_m: Vector) -> Vector:
        """See `Ledge.back_m`."""
        east_m, north_m, up_m = place_m
        nearest = (
            rectangle(piece.centre_m, piece.size_m, math.radians(piece.yaw_deg))(east_m, north_m)
            for piece in self.pieces
        )
        off_m, on_e_m, on_n_m = min((math.hypot(e - east_m, n - north_m), e, n) for e, n in nearest)
        return place_m if off_m <= TOUCH_M else (on_e_m, on_n_m, up_m)

    def gap_m(self, place_m: Vector) -> float:
        """Return how far it is, at least, from a place on it to an edge."""
        return max((_inside_m(piece, place_m) for piece in self.pieces), default=0.0)


_FLOOR: Final = Footprint("ground", lambda east_m, north_m: (east_m, north_m), 0.0, -math.inf, 0.0)


class Ground:
    """The ground of a world, and what stands on it.

    Args:
        world: The world; None for open flat ground.
    """

    def __init__(self, world: World | None) -> None:
        self._world = world
        self._obstacles = tuple(of_shape(part.obstacle, part.shape) for part in world.parts) if world else ()

    def around(self, *, flies: bool) -> Sequence[Footprint]:
        """Return what may be in a body's way, sides of raised ground included; for one that flies, the ground too."""
        return (*self._obstacles, _FLOOR) if flies else self._obstacles

    def height_m(self, east_m: float, north_m: float) -> float:
        """Return the height of the ground at a place."""
        return self._world.ground_m((east_m, north_m)) if self._world else 0.0

    def plateau(self, place_m: Vector) -> Plateau | None:
        """Return the raised ground that a body stands on; None where it stands on no such, or flies."""
        if self._world is None or not place_m[2]:
            return None
        pieces = [one for one in self._world.obstacles if isinstance(one, Raised) and one.size_m[2] == place_m[2]]
        under = [piece for piece in pieces if _inside_m(piece, place_m) >= -TOUCH_M]
        return Plateau(under[0].name, pieces) if under else None


def _inside_m(piece: Raised, place_m: Vector) -> float:
    """Return how far it is from a place to the nearest edge of a piece; below 0 outside."""
    e, n = place_m[0] - piece.centre_m[0], place_m[1] - piece.centre_m[1]
    yaw = math.radians(piece.yaw_deg)
    along_m, across_m = e * math.cos(yaw) + n * math.sin(yaw), n * math.cos(yaw) - e * math.sin(yaw)
    return min(piece.size_m[0] / 2 - abs(along_m), piece.size_m[1] / 2 - abs(across_m))
