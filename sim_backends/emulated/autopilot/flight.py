"""Flight of the emulated drone among obstacles, and its guidance to a goal.

The drone is the quadrotor of the built-in physics. Time is in integer nanoseconds and advances in steps of equal
length, so a flight does not depend on how often its state is read.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

from fieldkit.core.model import Vector
from sim_backends.emulated.autopilot.firmware import Firmware
from sim_backends.emulated.autopilot.modes import LANDING, PILOTED, Mode
from sim_backends.emulated.autopilot.parameters import Parameters
from sim_backends.physics.body import Velocity
from sim_backends.physics.collisions import Footprint, gap_m, is_supported, move
from sim_backends.physics.quadrotor import FlightPose, Quadrotor
from sim_backends.physics.robot_limits import QuadrotorLimits

STEP_NS: Final = 10_000_000
"""Time step of the flight."""
_STEP_S: Final = STEP_NS / 1e9

_APPROACH: Final = 0.5
"""Near its goal, the speed of the drone is the remaining distance, times the gain of velocity control, times this
factor. If attitude control had no lag, the drone would overshoot by about 4 %. The ratio of PX4's gains is similar:
0.95 for MPC_XY_P, 1.8 for MPC_XY_VEL_P_ACC."""

_MIN_COURSE_M_S: Final = 0.3
"""A slower drone does not turn to its direction of flight."""
_SUPPORT_GAP_M: Final = 1e-3
"""A drone is supported if there is a surface within this distance below it."""
_MAX_REST_CLIMB_M_S: Final = 1e-3
"""A supported drone that climbs faster is not on the ground, because it is lifting off."""
_SEARCH_M: Final = 2.0
"""Distance within which obstacles are considered; the search is repeated when the drone has moved half of it."""


class Airframe:
    """The airframe of the drone, and its motion.

    Positions are in metres relative to home, velocities in m/s: east, north, up. Headings are in radians from east
    towards north.

    Args:
        limits: Limits of the airframe.
        place_m: Position of its lowest point in the world, which is also home.
        facing_rad: Initial heading.
        obstacles: Obstacles in the world, including the floor.
        now_ns: Time of the initial state.

    Attributes:
        home_m: Position of home in the world; `position_m` is relative to it.
        now_ns: Time of the current state.
        motors_on: True if its motors turn. If they do not, it rests or falls.
        on_ground: True if it is on the ground or on an obstacle.
        turn_rad_s: Turn rate to the left.
    """

    def __init__(
        self, limits: QuadrotorLimits, place_m: Vector, facing_rad: float, obstacles: Sequence[Footprint], now_ns: int
    ) -> None:
        self.now_ns = now_ns
        self.motors_on = False
        self.on_ground = True
        self.turn_rad_s = 0.0
        self._pose = FlightPose(place_m, heading_rad=facing_rad)
        self.home_m = place_m
        self._obstacles = obstacles
        # Obstacles near the position of the last search.
        self._obstacles_nearby: Sequence[Footprint] = ()
        self._searched_m: Vector = (math.inf, 0.0, 0.0)
        self._limits = limits
        self._quadrotor = Quadrotor(limits, place_m)
        self._unpowered = Quadrotor(replace(limits, thrust_n=(0.0, 0.0)), place_m)

    @property
    def position_m(self) -> Vector:
        """Position of its lowest point relative to home."""
        (east, north, up), home = self._pose.place_m, self.home_m
        return east - home[0], north - home[1], up - home[2]

    @property
    def place_m(self) -> Vector:
        """Position of its lowest point in the world."""
        return self._pose.place_m

    @property
    def velocity_m_s(self) -> Vector:
        """Velocity."""
        return self._pose.velocity_m_s

    @property
    def yaw_rad(self) -> float:
        """Heading."""
        return self._pose.heading_rad

    @property
    def tilt_rad(self) -> tuple[float, float]:
        """Roll (right side down) and pitch (nose up), with the signs of MAVLink."""
        return self._pose.roll_rad, -self._pose.pitch_rad

    def step(self, target_m_s: Vector, limits: QuadrotorLimits, yaw_rad: float | None = None) -> None:
        """Fly for one step and change the velocity towards a target; the ground and obstacles stop the drone.

        Args:
            target_m_s: The target velocity.
            limits: Current limits of the airframe.
            yaw_rad: Heading to turn to; None to keep the heading.
        """
        self.now_ns += STEP_NS
        if limits != self._limits:
            self._limits, self._quadrotor = limits, Quadrotor(limits, self._pose.place_m)
        body = self._quadrotor if self.motors_on else self._unpowered
        before_m = self._pose.place_m
        pose = body.course(self._pose, Velocity(target_m_s, yaw_rad), _STEP_S).at(1)  # after one step
        obstacles = self._nearby_obstacles(before_m)
        stop = move(body, before_m, pose.place_m, obstacles)
        if stop is not None:
            pose = body.after_contact(pose, stop, None)
        self.turn_rad_s = math.remainder(pose.heading_rad - self._pose.heading_rad, math.tau) / _STEP_S
        self._pose = pose
        self.on_ground = pose.velocity_m_s[2] <= _MAX_REST_CLIMB_M_S and is_supported(
            self._quadrotor, pose.place_m, obstacles, _SUPPORT_GAP_M
        )
        if self.on_ground and (not self.motors_on or target_m_s[2] <= 0):
            # At rest it neither slides nor tilts nor turns.
            self._pose, self.turn_rad_s = FlightPose(pose.place_m, heading_rad=pose.heading_rad), 0.0

    def rest(self, now_ns: int) -> None:
        """Stay on the ground without power until this time, in whole steps."""
        self.now_ns += (now_ns - self.now_ns) // STEP_NS * STEP_NS

    def _nearby_obstacles(self, place_m: Vector) -> Sequence[Footprint]:
        """Return the obstacles that the drone may hit in this step."""
        if not math.dist(place_m, self._searched_m) < _SEARCH_M / 2:
            self._searched_m = place_m
            self._obstacles_nearby = [
                obstacle for obstacle in self._obstacles if gap_m(obstacle, self._quadrotor, place_m) < _SEARCH_M
            ]
        return self._obstacles_nearby

    @property
    def course_rad(self) -> float | None:
        """Direction of flight over the ground; None while the drone is slow."""
        east, north, _ = self.velocity_m_s
        return math.atan2(north, east) if math.hypot(east, north) > _MIN_COURSE_M_S else None


MakeAirframe = Callable[[Vector, float, int], Airframe]
"""Creates the airframe of a drone; arguments: position of its lowest point in the world, heading, time."""


def limits_within(limits: QuadrotorLimits, parameters: Parameters) -> QuadrotorLimits:
    """Return the limits of an airframe within the parameters of its autopilot."""
    return replace(
        limits,
        speed_m_s=parameters["MPC_XY_VEL_MAX"],
        climb_m_s=(parameters["MPC_Z_VEL_MAX_DN"], parameters["MPC_Z_VEL_MAX_UP"]),
        acceleration_m_s2=parameters["MPC_ACC_HOR"],
        climb_m_s2=(parameters["MPC_ACC_DOWN_MAX"], parameters["MPC_ACC_UP_MAX"]),
    )


def velocity_to(goal_m: Vector, body: Airframe, limits: QuadrotorLimits) -> Vector:
    """Return the velocity towards a point relative to home; the drone can still brake to a stop at the point."""
    east, north, up = (goal - current for goal, current in zip(goal_m, body.position_m, strict=True))
    distance_m = math.hypot(east, north)
    along_per_s, climb_per_s = limits.gains_per_s
    speed_m_s = min(limits.speed_m_s, _approach(distance_m, limits.acceleration_m_s2, along_per_s))
    share = speed_m_s / distance_m if distance_m > 0 else 0.0
    down, rise = limits.climb_m_s2
    climb_m_s = math.copysign(_approach(abs(up), rise if up < 0 else down, climb_per_s), up)
    return east * share, north * share, climb_m_s


def stop_m(body: Airframe, limits: QuadrotorLimits) -> Vector:
    """Return the position, relative to home, at which the drone stops if it brakes now.

    The stopping distance is the distance during the lags of attitude and velocity control, plus v^2 / (2 a). The
    returned height is at least 0 or, if the drone is below home, at least the current height of the drone.
    """
    (x, y, z), (east, north, up) = body.position_m, body.velocity_m_s
    brake_s = limits.lag_s + 1 / limits.gains_per_s[0] + math.hypot(east, north) / 2 / limits.acceleration_m_s2
    climb_s = 1 / limits.gains_per_s[1] + abs(up) / 2 / limits.climb_m_s2[0 if up > 0 else 1]
    return x + east * brake_s, y + north * brake_s, max(z + up * climb_s, min(z, 0.0))


def _approach(remaining_m: float, acceleration_m_s2: float, gain_per_s: float) -> float:
    """Return the speed at a remaining distance s: proportional to s near the goal, sqrt(a s) farther away.

    From the speed sqrt(a s), braking with the acceleration a needs half of the distance s.
    """
    return min(remaining_m * _APPROACH * gain_per_s, math.sqrt(acceleration_m_s2 * remaining_m))


NEAR_M: Final = 0.1
"""Distance at which a drone has reached a point."""
_EXCEPT_RTL: Final = 2
"""WP_YAW_BEHAVIOR: turn to the next waypoint, except in RTL."""


class SetPoint(NamedTuple):
    """A set-point.

    Attributes:
        vector: Position relative to home in m, or velocity in m/s: east, north, up.
        is_position: True if it is a position.
        yaw_rad: Heading from east towards north; None if it has none.
    """

    vector: Vector
    is_position: bool
    yaw_rad: float | None = None


class Guidance:
    """Goal and set-points of the vehicle; positions are relative to home.

    Args:
        firmware: Family of the autopilot, PX4 or ArduCopter.
        parameters: Its parameters.

    Attributes:
        goal_m: Goal in modes without set-points; a goal below home means landing.
        set_point: The last set-point.
        set_point_ns: Time of the last set-point; None before the first one.
    """

    def __init__(self, firmware: Firmware, parameters: Parameters) -> None:
        self._firmware = firmware
        self._parameters = parameters
        self.set_point_ns: int | None = None
        self.hold((0.0, 0.0, 0.0))

    def hold(self, place_m: Vector) -> None:
        """Make a position both the goal and the set-point, so that the drone holds it in every mode."""
        self.goal_m = place_m
        self.set_point = SetPoint(place_m, is_position=True)

    def has_recent_set_point(self, now_ns: int) -> bool:
        """Return True if the last set-point is recent enough."""
        return self.set_point_ns is not None and now_ns - self.set_point_ns <= self._parameters["COM_OF_LOSS_T"] * 1e9

    def is_home(self, body: Airframe) -> bool:
        """Return True if the drone is near enough to home to descend."""
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
            vector, is_position, _ = self.set_point
            return velocity_to(vector, body, limits) if is_position else vector
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
