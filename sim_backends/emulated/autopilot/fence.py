"""The fence of the emulated autopilots: a cylinder around home.

ArduCopter reacts after a vehicle has crossed the fence, PX4 before a vehicle that follows set-points crosses it.
Sources: https://ardupilot.org/copter/docs/common-ac2_simple_geofence.html and
https://docs.px4.io/main/en/config/safety.html.
"""

import math
from typing import Final

from fieldkit.core.model import Vector
from sim_backends.emulated.autopilot.failsafes import Reaction, VehicleState
from sim_backends.emulated.autopilot.mavlink_frames import dialect
from sim_backends.emulated.autopilot.modes import LANDING, Mode
from sim_backends.emulated.autopilot.parameters import Parameters

_FENCE_ACTIONS: Final = {0: None, 1: Mode.RTL, 2: Mode.LAND, 3: Mode.RTL, 4: Mode.BRAKE, 5: Mode.LAND}
"""Mode after a breach, by FENCE_ACTION of ArduCopter; None if the breach is only reported. Modes that are not
emulated are replaced as in `failsafes`."""
_GEOFENCE_ACTIONS: Final = {
    1: ("warning", None),
    2: ("hold", Mode.LOITER),
    3: ("return", Mode.RTL),
    4: ("hold", Mode.LOITER),
    5: ("land", Mode.LAND),
}
"""Text and mode of the reaction, by GF_ACTION of PX4; 0 disables the reaction.

Action 4 (terminate) is not emulated: the vehicle holds its position instead.
"""


class Fence:
    """Fence of one vehicle; positions are relative to home: metres east, north, up.

    Args:
        parameters: The vehicle's parameters; the fence reads GF_MAX_*, FENCE_ACTION and GF_ACTION.
    """

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        self._is_breached = False

    @property
    def limits_m(self) -> tuple[float, float]:
        """Maximum distance from home, horizontal and vertical."""
        return self._parameters["GF_MAX_HOR_DIST"], self._parameters["GF_MAX_VER_DIST"]

    def contains(self, position_m: Vector) -> bool:
        """Return True if the vehicle may fly to a position."""
        return is_within(position_m, self.limits_m)

    def nearest_inside(self, position_m: Vector) -> Vector:
        """Return the position itself, or the nearest point inside the fence if the position is outside.

        The horizontal distance from home and the height are limited separately. A height below home is not changed.
        """
        (east, north, up), (radius_m, height_m) = position_m, self.limits_m
        share = radius_m / max(math.hypot(east, north), radius_m)
        return share * east, share * north, min(up, height_m)

    def is_crossed(self, here_m: Vector, stop_m: Vector) -> bool:
        """Return True if a vehicle that brakes now stops outside the fence, and farther outside than it is now.

        This applies to the horizontal distance from home or to the height.

        Args:
            here_m: Position of the vehicle.
            stop_m: Position at which it stops if it brakes now.
        """
        radius_m, height_m = self.limits_m
        stop_distance_m = math.hypot(*stop_m[:2])
        return stop_distance_m > max(radius_m, math.hypot(*here_m[:2])) or stop_m[2] > max(height_m, here_m[2])

    def reset(self) -> None:
        """Treat the vehicle as inside the fence, after it was armed or carried to another position."""
        self._is_breached = False

    def advance(self, state: VehicleState, position_m: Vector) -> Reaction | None:
        """Return ArduCopter's reaction to a new breach in flight, or None."""
        (east, north, up), (radius_m, height_m) = position_m, self.limits_m
        fences = ["Max Alt"] * (up > height_m) + ["Circle"] * (math.hypot(east, north) > radius_m)
        is_new, self._is_breached = bool(fences) and not self._is_breached, bool(fences)
        if not is_new or not state.is_armed or state.has_landed:
            return None
        text = f"{' and '.join(fences)} fence{'s' * (len(fences) > 1)} breached"
        mode = None if state.mode in LANDING else _FENCE_ACTIONS[int(self._parameters["FENCE_ACTION"])]
        return Reaction(text, dialect.MAV_SEVERITY_NOTICE, mode)

    def before_crossing(self, here_m: Vector, stop_m: Vector) -> Reaction | None:
        """Return the reaction of PX4 if `is_crossed` is True for these arguments, or None.

        A reaction without a change of mode (a warning) is returned only if `is_crossed` was False in the previous
        call.
        """
        was_crossed, self._is_breached = self._is_breached, self.is_crossed(here_m, stop_m)
        text, mode = _GEOFENCE_ACTIONS.get(int(self._parameters["GF_ACTION"]), ("", None))
        if not text or not self._is_breached or (mode is None and was_crossed):
            return None
        return Reaction(f"Geofence: {text}", dialect.MAV_SEVERITY_CRITICAL, mode)


def is_within(position_m: Vector, limits_m: tuple[float, float]) -> bool:
    """Return True if a position relative to home is in a cylinder, given by radius and height, or on its surface."""
    return math.hypot(*position_m[:2]) <= limits_m[0] and 0 <= position_m[2] <= limits_m[1]
