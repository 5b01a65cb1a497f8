"""Ranges of a planar laser scanner.

Horizontal beams end at the first surface. Only the standard library is used, as in all modules of the sensors
process. Each surface is intersected only with the beams in its direction, so computing the ranges of a scan takes
about as long as computing their noise.
"""

import math
from collections.abc import Iterable, Iterator
from typing import Final

from fieldkit.core.model import Vector
from sim_backends.emulated.ros.sensor_specs import LaserTarget

_SLACK_BEAMS: Final = 1e-9
"""Tolerance in beams, so that rounding does not lose a beam that hits a corner."""


def ranges_m(
    targets: Iterable[LaserTarget], position_m: Vector, heading_rad: float, beams: int, reach_m: float
) -> list[float]:
    """Return the distance to the first surface along each beam, infinite beyond `reach_m`.

    Args:
        targets: Solids in the world.
        position_m: Position of the scanner, metres east, north, up.
        heading_rad: Direction of beam 0, from east towards north; the others follow counter-clockwise.
        beams: Number of beams.
        reach_m: Maximum range.
    """
    scan = _Scan(position_m, heading_rad, beams, reach_m)
    for target in targets:
        if not target.base_m <= position_m[2] <= target.top_m:
            continue
        if target.radius_m:
            scan.add_circle(target.outline_m[0], target.radius_m)
        else:
            for start, end in target.edges_m():
                scan.add_edge(start, end)
    return [range_m if range_m <= reach_m else math.inf for range_m in scan.ranges_m]


class _Scan:
    """Distance to the nearest added surface, per beam. The arguments are those of `ranges_m`."""

    def __init__(self, position_m: Vector, heading_rad: float, beams: int, reach_m: float) -> None:
        self.ranges_m = [math.inf] * beams
        self._east_m, self._north_m, _ = position_m
        self._heading_rad = heading_rad
        self._step_rad = 2 * math.pi / beams
        self._reach_m = reach_m

    def add_edge(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Add a straight surface.

        The beam t u, with the unit vector u, hits the line p + s q from `start` to `end` at t = (p x q) / (u x q).
        """
        x, y = start[0] - self._east_m, start[1] - self._north_m
        along_x, along_y = end[0] - start[0], end[1] - start[1]
        length_m = math.hypot(along_x, along_y)
        cross_product = x * along_y - y * along_x
        if cross_product == 0.0 or abs(cross_product) > self._reach_m * length_m:
            return  # The scanner is on the line, or the whole line is out of range.
        if (x * x + y * y) ** 0.5 > self._reach_m + length_m:
            return
        first_rad = math.atan2(y, x)
        # An edge that does not contain the scanner covers less than half a turn.
        arc_rad = math.remainder(math.atan2(y + along_y, x + along_x) - first_rad, 2 * math.pi)
        for beam, angle_rad in self._beams(min(first_rad, first_rad + arc_rad), abs(arc_rad)):
            divisor = math.cos(angle_rad) * along_y - math.sin(angle_rad) * along_x
            if divisor:
                self._record_hit(beam, cross_product / divisor)

    def add_circle(self, centre: tuple[float, float], radius_m: float) -> None:
        """Add an upright cylinder.

        A beam hits it at the distance m - sqrt(r^2 - d^2), with the radius r. The point of the beam that is nearest
        to the axis of the cylinder is at the distance m from the scanner, and d from the axis.
        """
        x, y = centre[0] - self._east_m, centre[1] - self._north_m
        distance_m = math.hypot(x, y)
        if distance_m <= radius_m or distance_m - radius_m > self._reach_m:
            return
        half_rad = math.asin(radius_m / distance_m)
        centre_rad = math.atan2(y, x)
        for beam, angle_rad in self._beams(centre_rad - half_rad, 2 * half_rad):
            offset_m = distance_m * math.sin(angle_rad - centre_rad)
            nearest_m = distance_m * math.cos(angle_rad - centre_rad)
            self._record_hit(beam, nearest_m - math.sqrt(max(radius_m**2 - offset_m**2, 0.0)))

    def _beams(self, from_rad: float, arc_rad: float) -> Iterator[tuple[int, float]]:
        """Yield number and direction of each beam within an arc."""
        start = (from_rad - self._heading_rad) / self._step_rad
        first = math.ceil(start - _SLACK_BEAMS)
        last = math.floor(start + arc_rad / self._step_rad + _SLACK_BEAMS)
        for number in range(first, last + 1):
            yield number % len(self.ranges_m), self._heading_rad + number * self._step_rad

    def _record_hit(self, beam: int, range_m: float) -> None:
        if 0.0 <= range_m < self.ranges_m[beam]:
            self.ranges_m[beam] = range_m
