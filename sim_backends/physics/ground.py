"""Ground that bodies on wheels stand on: flat, raised in places, and rising where there are ramps.

Its upright faces are walls from below, and edges from above, that nobody drives off; where a ramp leads to raised
ground there is neither. For a robot, ground is steep if its tires do not hold on it: then it is a wall, too.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

from fieldkit.core.model import Vector
from sim_backends.physics.collisions import Footprint, Surface, of_shape, rectangle
from sim_backends.world.obstacles import Raised, Ramp
from sim_backends.world.world import World

_LEVEL_M: Final = 1e-3
"""What differs by less in height is level: who rolls over it does not notice."""
_FLOOR: Final = Footprint("ground", lambda east_m, north_m: (east_m, north_m), 0.0, -math.inf, 0.0)


@dataclass(frozen=True)
class _Piece:
    """A piece of ground that is higher than around it.

    Attributes:
        obstacle: It.
        nearest_m: Returns the point on it that is nearest to a point, metres east and north.
    """

    obstacle: Raised | Ramp
    nearest_m: Callable[[float, float], tuple[float, float]]

    def off_m(self, east_m: float, north_m: float) -> float:
        """Return how far a place is from it; 0 on it."""
        on_e_m, on_n_m = self.nearest_m(east_m, north_m)
        return math.hypot(on_e_m - east_m, on_n_m - north_m)

    def edge_m(self, east_m: float, north_m: float) -> float:
        """Return how far a place is from its edge, inside or outside."""
        obstacle = self.obstacle
        e, n = east_m - obstacle.centre_m[0], north_m - obstacle.centre_m[1]
        cos, sin = math.cos(math.radians(obstacle.yaw_deg)), math.sin(math.radians(obstacle.yaw_deg))
        inside_m = min(
            obstacle.size_m[0] / 2 - abs(e * cos + n * sin), obstacle.size_m[1] / 2 - abs(n * cos - e * sin)
        )
        return inside_m if inside_m >= 0 else self.off_m(east_m, north_m)


class Ground:
    """The ground of a world for bodies of one kind, and what stands on it.

    Args:
        world: The world; None for open flat ground.
        steepest: The steepest that they drive on, rise over run; None for those who fly.

    Attributes:
        around: What may be in their way, sides of higher ground included; for those who fly, the floor too.
    """

    def __init__(self, world: World | None, steepest: float | None) -> None:
        self._pieces = []
        around: list[Footprint] = [] if steepest is not None else [_FLOOR]
        for obstacle in world.obstacles if world is not None else ():
            if (
                steepest is not None
                and isinstance(obstacle, Raised | Ramp)
                and math.hypot(*obstacle.grade) <= steepest
            ):
                nearest_m = rectangle(obstacle.centre_m, obstacle.size_m, math.radians(obstacle.yaw_deg))
                self._pieces.append(_Piece(obstacle, nearest_m))
            else:
                around += [of_shape(part.obstacle, part.shape) for part in obstacle.parts()]
        self.around: Sequence[Footprint] = (*around, *map(self._side, self._pieces))
        self._steepest = max((math.hypot(*piece.obstacle.grade) for piece in self._pieces), default=0.0)

    def surface(self, east_m: float, north_m: float) -> Surface:
        """Return the ground at a place: the highest of what is there."""
        on = [piece.obstacle for piece in self._pieces if piece.off_m(east_m, north_m) <= _LEVEL_M / 1000]
        highest = max(on, key=lambda one: one.height_m((east_m, north_m)), default=None)
        if highest is None:
            return Surface(0.0)
        return Surface(highest.height_m((east_m, north_m)), highest.grade)

    def edge_m(self, place_m: Vector) -> float:
        """Return how far it is, at least, until the ground below a body is another."""
        return min((piece.edge_m(place_m[0], place_m[1]) for piece in self._pieces), default=math.inf)

    def back_m(self, from_m: Vector, to_m: Vector) -> tuple[str, Vector] | None:
        """Return the edge that a body would drive off on its way, and where it stops there; None for none."""
        east_m, north_m, up_m = to_m
        dropped_m = from_m[2] - self.surface(east_m, north_m).height_m
        if dropped_m <= _LEVEL_M + self._steepest * math.dist(from_m, to_m):
            return None
        under = [
            piece
            for piece in self._pieces
            if piece.off_m(from_m[0], from_m[1]) <= _LEVEL_M
            and abs(piece.obstacle.height_m((from_m[0], from_m[1])) - from_m[2]) <= _LEVEL_M
        ]
        if not under:
            return None
        stays = min(under, key=lambda piece: piece.off_m(east_m, north_m))
        return stays.obstacle.name, (*stays.nearest_m(east_m, north_m), up_m)

    def _side(self, piece: _Piece) -> Footprint:
        top_m = piece.obstacle.size_m[2]
        return Footprint(piece.obstacle.name, piece.nearest_m, 0.0, 0.0, top_m, partial(self._wall_m, piece))

    def _wall_m(self, piece: _Piece, east_m: float, north_m: float) -> float:
        """Return how high a piece's side is at a point of it: nothing where other ground leads up to it."""
        height_m = piece.obstacle.height_m((east_m, north_m))
        others = (other for other in self._pieces if other is not piece and other.off_m(east_m, north_m) <= _LEVEL_M)
        lower_m = height_m - _LEVEL_M
        return 0.0 if any(other.obstacle.height_m((east_m, north_m)) >= lower_m for other in others) else lower_m
