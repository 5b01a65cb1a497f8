"""The autopilot's own fence: a cylinder around home, and what a breach makes the vehicle do.

ArduCopter: https://ardupilot.org/copter/docs/common-ac2_simple_geofence.html. PX4 refuses what leads out of it.
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
    """The fence of one vehicle; places are relative to home: metres east, north, up.

    Args:
        parameters: GF_MAX_*, FENCE_ACTION.
    """

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        self._is_breached = False

    @property
    def limits_m(self) -> tuple[float, float]:
        """Largest distance from home, over the ground and up."""
        return self._parameters["GF_MAX_HOR_DIST"], self._parameters["GF_MAX_VER_DIST"]

    def contains(self, place_m: Vector) -> bool:
        """Return whether the vehicle may fly to a place."""
        return is_within(place_m, self.limits_m)

    def nearest_inside(self, place_m: Vector) -> Vector:
        """Return the place itself, or the place on the fence between home and it."""
        (east, north, up), (far_m, high_m) = place_m, self.limits_m
        part = far_m / max(math.hypot(east, north), far_m)
        return part * east, part * north, min(up, high_m)

    def is_crossed(self, here_m: Vector, rest_m: Vector) -> bool:
        """Return whether a vehicle that brakes now comes to rest outside, farther out than it is."""
        far_m, high_m = self.limits_m
        out_m = math.hypot(*rest_m[:2])
        return out_m > max(far_m, math.hypot(*here_m[:2])) or rest_m[2] > max(high_m, here_m[2])

    def reset(self) -> None:
        """Regard the vehicle as inside, as when it is armed or carried to another place."""
        self._is_breached = False

    def advance(self, now: VehicleState, place_m: Vector) -> Reaction | None:
        """Return ArduCopter's reaction to a new breach in flight; None if there is none."""
        (east, north, up), (far_m, high_m) = place_m, self.limits_m
        fences = ["Max Alt"] * (up > high_m) + ["Circle"] * (math.hypot(east, north) > far_m)
        is_new, self._is_breached = bool(fences) and not self._is_breached, bool(fences)
        if not is_new or not now.armed or now.landed:
            return None
        text = f"{' and '.join(fences)} fence{'s' * (len(fences) > 1)} breached"
        mode = None if now.mode in LANDING else _ACTIONS[int(self._parameters["FENCE_ACTION"])]
        return Reaction(text, dialect.MAV_SEVERITY_NOTICE, mode)


def is_within(place_m: Vector, limits_m: tuple[float, float]) -> bool:
    """Return whether a place relative to home is inside of a cylinder, over the ground and up."""
    return math.hypot(*place_m[:2]) <= limits_m[0] and 0 <= place_m[2] <= limits_m[1]
