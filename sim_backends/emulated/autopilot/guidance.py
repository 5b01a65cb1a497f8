"""Guidance: velocity and heading with which the vehicle flies to its goal or follows set-points."""

import math
from typing import Final, NamedTuple

from fieldkit.core.model import Vector
from sim_backends.emulated.autopilot.firmware import Firmware
from sim_backends.emulated.autopilot.flight import Airframe, velocity_to
from sim_backends.emulated.autopilot.modes import LANDING, PILOTED, Mode
from sim_backends.emulated.autopilot.parameters import Parameters
from sim_backends.physics.quadrotor import QuadrotorLimits

NEAR_M: Final = 0.1
"""Distance at which a drone has reached a point."""
_EXCEPT_RTL: Final = 2
"""WP_YAW_BEHAVIOR: turn to the next waypoint, except in RTL."""


class SetPoint(NamedTuple):
    """A set-point.

    Attributes:
        vector: Position relative to home in m, or velocity in m/s: east, north, up.
        is_place: True if it is a position.
        yaw_rad: Heading from east towards north; None if it has none.
    """

    vector: Vector
    is_place: bool
    yaw_rad: float | None = None


class Guidance:
    """Goal and set-points of the vehicle; positions are relative to home.

    Args:
        firmware: Family of the autopilot.
        parameters: Its parameters.

    Attributes:
        goal_m: Goal in modes that follow no set-points; a goal below home is a landing.
        set_point: The last set-point.
        set_point_ns: Time of the last set-point; None before the first one.
    """

    def __init__(self, firmware: Firmware, parameters: Parameters) -> None:
        self._firmware = firmware
        self._parameters = parameters
        self.set_point_ns: int | None = None
        self.hold((0.0, 0.0, 0.0))

    def hold(self, place_m: Vector) -> None:
        """Hold a position, in all modes."""
        self.goal_m = place_m
        self.set_point = SetPoint(place_m, is_place=True)

    def has_recent_set_point(self, now_ns: int) -> bool:
        """Return True if the last set-point is recent enough."""
        return self.set_point_ns is not None and now_ns - self.set_point_ns <= self._parameters["COM_OF_LOSS_T"] * 1e9

    def is_home(self, body: Airframe) -> bool:
        """Return True if it is near enough to home to descend."""
        return math.hypot(*body.position_m[:2]) < self._parameters["NAV_ACC_RAD"]

    def velocity_m_s(self, mode: Mode, body: Airframe, limits: QuadrotorLimits, ceiling_m: float) -> Vector:
        """Return the target velocity in the air.

        Args:
            mode: The mode.
            body: State of motion.
            limits: Current limits of the airframe.
            ceiling_m: Height of the fence.
        """
        if mode is Mode.OFFBOARD:
            vector, is_place, _ = self.set_point
            return velocity_to(vector, body, limits) if is_place else vector
        if mode is Mode.RTL:
            return self._return_m_s(body, limits, ceiling_m)
        if mode in LANDING or (mode is Mode.MISSION and self.goal_m[2] < 0):
            return self._descent_m_s(body, limits)
        return velocity_to(self.goal_m, body, limits)

    def _return_m_s(self, body: Airframe, limits: QuadrotorLimits, ceiling_m: float) -> Vector:
        """Climb, then fly home (PX4's return mode)."""
        height_m = min(max(self.goal_m[2], self._parameters["RTL_RETURN_ALT"]), ceiling_m)
        climbs = body.position_m[2] < height_m - NEAR_M and not self.is_home(body)
        return velocity_to((*self.goal_m[:2], height_m) if climbs else (0.0, 0.0, height_m), body, limits)

    def _descent_m_s(self, body: Airframe, limits: QuadrotorLimits) -> Vector:
        is_fast = body.position_m[2] > self._parameters["MPC_LAND_ALT2"]
        speed_m_s = self._parameters["MPC_Z_VEL_MAX_DN" if is_fast else "MPC_LAND_SPEED"]
        east, north, _ = velocity_to(self.goal_m, body, limits)
        return east, north, -speed_m_s

    def yaw_rad(self, mode: Mode, body: Airframe) -> float | None:
        """Return the heading to turn to (WP_YAW_BEHAVIOR of ArduCopter); None to keep the heading."""
        behavior = self._parameters["WP_YAW_BEHAVIOR"]
        if mode is Mode.OFFBOARD and self.set_point.yaw_rad is not None:
            return self.set_point.yaw_rad
        keeps_heading = mode in LANDING or mode in PILOTED or mode is Mode.TAKEOFF
        if mode is Mode.OFFBOARD and not self._firmware.is_ardupilot:
            keeps_heading = True
        if keeps_heading or not behavior or (mode is Mode.RTL and behavior == _EXCEPT_RTL):
            return None
        return body.course_rad
