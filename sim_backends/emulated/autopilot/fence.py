"""Fence of the autopilot, a cylinder around home, and the reaction of the vehicle to a breach.

ArduCopter: https://ardupilot.org/copter/docs/common-ac2_simple_geofence.html. PX4 refuses goals outside its fence.
"""

import math
from typing import Final

from fieldkit.core.model import Vector
from sim_backends.emulated.autopilot.failsafes import Reaction, VehicleState
from sim_backends.emulated.autopilot.mavlink import dialect
from sim_backends.emulated.autopilot.modes import LANDING, Mode
from sim_backends.emulated.autopilot.parameters import Parameters

_ACTIONS: Final = {0: None, 1: Mode.RTL, 2: Mode.LAND, 3: Mode.RTL, 4: Mode.BRAKE, 5: Mode.LAND}
"""Mode after a breach, by FENCE_ACTION."""


class Fence:
    """Fence of one vehicle; positions are relative to home: metres east, north, up.

    Args:
        parameters: GF_MAX_*, FENCE_ACTION.
    """

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        self._is_breached = False

    @property
    def limits_m(self) -> tuple[float, float]:
        """Maximum distance from home, horizontal and vertical."""
        return self._parameters["GF_MAX_HOR_DIST"], self._parameters["GF_MAX_VER_DIST"]

    def contains(self, place_m: Vector) -> bool:
        """Return True if the vehicle may fly to a position."""
        return is_within(place_m, self.limits_m)

    def nearest_inside(self, place_m: Vector) -> Vector:
        """Return the position itself, or the point where the line from home to it crosses the fence."""
        (east, north, up), (radius_m, height_m) = place_m, self.limits_m
        part = radius_m / max(math.hypot(east, north), radius_m)
        return part * east, part * north, min(up, height_m)

    def is_crossed(self, here_m: Vector, rest_m: Vector) -> bool:
        """Return True if a vehicle that brakes now comes to rest outside, and farther out than it is."""
        radius_m, height_m = self.limits_m
        out_m = math.hypot(*rest_m[:2])
        return out_m > max(radius_m, math.hypot(*here_m[:2])) or rest_m[2] > max(height_m, here_m[2])

    def reset(self) -> None:
        """Treat the vehicle as inside, after it was armed or carried to another place."""
        self._is_breached = False

    def advance(self, now: VehicleState, place_m: Vector) -> Reaction | None:
        """Return ArduCopter's reaction to a new breach in flight, or None."""
        (east, north, up), (radius_m, height_m) = place_m, self.limits_m
        fences = ["Max Alt"] * (up > height_m) + ["Circle"] * (math.hypot(east, north) > radius_m)
        is_new, self._is_breached = bool(fences) and not self._is_breached, bool(fences)
        if not is_new or not now.armed or now.landed:
            return None
        text = f"{' and '.join(fences)} fence{'s' * (len(fences) > 1)} breached"
        mode = None if now.mode in LANDING else _ACTIONS[int(self._parameters["FENCE_ACTION"])]
        return Reaction(text, dialect.MAV_SEVERITY_NOTICE, mode)


def is_within(place_m: Vector, limits_m: tuple[float, float]) -> bool:
    """Return True if a position relative to home is inside a cylinder, given by radius and height."""
    return math.hypot(*place_m[:2]) <= limits_m[0] and 0 <= place_m[2] <= limits_m[1]
