"""Steer a ground robot along straight legs by its odometry, and stop it if a limit is exceeded.

`Driver` has no side effects and uses no clock, middleware or file. Its inputs are poses, orders of the laptop and
times; its output is a velocity. The desired heading leads the robot back to the leg within `_LOOKAHEAD_M` (Coulter,
Implementation of the Pure Pursuit Path Tracking Algorithm, CMU-RI-TR-92-01, for a straight path). Near the end of a
leg, the speed is limited so that half of the maximum acceleration suffices to stop there.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from fieldkit.agent.driving.drive_plan import (
    ARRIVAL_TOLERANCE_M,
    BACK,
    END,
    GAP_S,
    HEADING_TOLERANCE_RAD,
    OFF_PATH_M,
    OUT,
    START_M,
    START_RAD,
    TURN_RAMP_S,
    DriveTask,
    turn_rate_rad_s,
    wrap_angle,
)

_TURN_IN_PLACE_RAD = 0.6
"""Heading error above which a robot stops and turns in place; it drives again below `HEADING_TOLERANCE_RAD`."""
_LOOKAHEAD_M = 0.5
"""Look-ahead distance of pure pursuit: the robot steers to the point of the leg at this distance ahead of it."""
_MIN_SPEED_M_S = 0.03
"""Minimum speed at which the motors of a robot turn."""
_MAX_JUMP_M = 0.5
"""A distance between two poses that exceeds the possible motion by more than this is an error of the odometry."""
_STILL_M, _STILL_RAD, _STILL_S = 0.05, 0.05, 0.4
"""A robot whose odometry changes by less than this distance and angle during this time is stationary."""
_WAITS, _RETURNS = "waits", "returns"
_STUCK_M, _STUCK_S = 0.5, 2.0
"""The progress of a robot is checked whenever it should have driven `_STUCK_M` plus the distance of `_STUCK_S` at
full speed. It must have driven at least a quarter of this distance."""


class OdometryPose(NamedTuple):
    """Pose of a robot in the frame of its odometry."""

    x_m: float
    y_m: float
    yaw_rad: float


class DriveVelocity(NamedTuple):
    """Forward speed, and turn rate to the left."""

    forward_m_s: float = 0.0
    turn_rad_s: float = 0.0


ZERO_VELOCITY = DriveVelocity()


class Driver:
    """Steers one robot along the legs of a task, and back.

    A stop is final: `stop_reason` contains the reason, and every later velocity is zero.

    Args:
        task: The path and its limits.
        now_s: Start time by a monotonic clock; all times that are passed to its methods are by the same clock.

    Attributes:
        stop_reason: The reason for an early stop; empty before a stop.
        phase: `waits` until the robot is stationary and ordered to start; `returns` while it first drives to its
            origin; then `out` on its path, `there` at its end, `back` on the path back, and `home` at its
            origin.
        driven_m: Distance driven since the start of `out`; before `out`, since the first pose.
        refused: Whether the robot did not start because it is not at the required place.
    """

    def __init__(self, task: DriveTask, now_s: float) -> None:
        self.stop_reason = ""
        self.phase = _WAITS
        self.driven_m = 0.0
        self.refused = False
        self._task = task
        self._created_s = now_s
        self._now_s = self._order_s = self._odometry_s = self._phase_s = now_s
        self._origin = None if task.origin is None else OdometryPose(*task.origin)
        # The pose from which the robot has not moved since `_reference_s`, as long as it waits.
        self._reference: OdometryPose | None = None
        self._reference_s = now_s
        self._pose: OdometryPose | None = None
        self._order = ""
        self._corners = [(0.0, 0.0)]
        for ahead_m, left_m in task.legs:
            x_m, y_m = self._corners[-1]
            self._corners.append((x_m + ahead_m, y_m + left_m))
        # The remaining legs, each from corner to corner. After the last one the robot turns to its final heading.
        self._legs = [*zip(self._corners, self._corners[1:])]
        self._velocity: DriveVelocity = ZERO_VELOCITY
        self._turning = True  # the robot turns in place
        # The commanded and the driven distance since the last progress check, and the position at that check.
        self._commanded_m = self._moved_m = 0.0
        self._progress_position = (0.0, 0.0)

    @property
    def relative_pose(self) -> OdometryPose | None:
        """The robot's pose relative to its origin; None before the first odometry, or before the origin is known."""
        return None if self._origin is None or self._pose is None else _relative_pose(self._origin, self._pose)

    @property
    def pose(self) -> OdometryPose | None:
        """The robot's pose in the frame of its odometry; None before the first odometry."""
        return self._pose

    @property
    def ready(self) -> bool:
        """Whether the robot is stationary at a place where it may start; valid only before it starts."""
        return self._origin is not None and self._pose is not None and not self.is_finished and self._is_still

    @property
    def _is_still(self) -> bool:
        return self._odometry_s - self._reference_s >= _STILL_S

    @property
    def elapsed_s(self) -> float:
        """Time from the creation of this object to the last call of `tick`."""
        return self._now_s - self._created_s

    @property
    def is_finished(self) -> bool:
        """Whether the drive has ended: at its origin, or by an early stop."""
        return bool(self.stop_reason) or self.phase == "home"

    @property
    def remaining_m(self) -> float:
        """Distance to the origin in the phases `back` and `home`, otherwise to the last corner of the path.

        It is infinite while `relative_pose` is None.
        """
        relative_pose, goal = self.relative_pose, self._corners[0 if self.phase in ("back", "home") else -1]
        return (
            math.inf
            if relative_pose is None
            else math.hypot(goal[0] - relative_pose.x_m, goal[1] - relative_pose.y_m)
        )

    def on_odometry(self, now_s: float, pose: OdometryPose) -> None:
        """Process a pose; a pose with a value that is not finite is ignored. A jump of the pose stops the robot."""
        if not all(map(math.isfinite, pose)):
            return
        if self._pose is not None:
            moved_m = math.hypot(pose.x_m - self._pose.x_m, pose.y_m - self._pose.y_m)
            if moved_m > _MAX_JUMP_M + 2 * self._task.speed_m_s * max(now_s - self._odometry_s, 0.0):
                self._stop(f"odometry jumped by {moved_m:.2f} m")
            self.driven_m += moved_m
        self._pose, self._odometry_s = pose, now_s
        if self.phase == _WAITS and not self.stop_reason:
            self._check_start(now_s, pose)

    def refuse(self, reason: str) -> None:
        """Stop because the robot is not at the required place for a start."""
        self.refused = self.refused or not self.stop_reason
        self._stop(reason)

    def _check_start(self, now_s: float, pose: OdometryPose) -> None:
        """Check that the robot is stationary and at the required place.

        If the task has no origin, the pose of the stationary robot becomes the origin.
        """
        reference = self._reference
        if (
            reference is None
            or math.dist(pose[:2], reference[:2]) > _STILL_M
            or abs(wrap_angle(pose.yaw_rad - reference.yaw_rad)) > _STILL_RAD
        ):
            self._reference, self._reference_s = pose, now_s
        if not self._is_still:
            return
        task = self._task
        if self._origin is None:
            self._origin = pose  # the laptop records it
        relative_pose, last_pose = self.relative_pose, task.last
        assert relative_pose is not None
        distance_m, angle_rad = math.hypot(relative_pose.x_m, relative_pose.y_m), abs(relative_pose.yaw_rad)
        if last_pose is not None and (
            math.dist(pose[:2], last_pose[:2]) > START_M or abs(wrap_angle(pose.yaw_rad - last_pose[2])) > START_RAD
        ):
            self.refuse(
                f"its odometry is {math.dist(pose[:2], last_pose[:2]):.2f} m and "
                f"{abs(wrap_angle(pose.yaw_rad - last_pose[2])):.2f} rad from the end of its last motion"
            )
        elif distance_m > task.fence_m:
            self.refuse(f"it is {distance_m:.2f} m from its origin, outside its fence of {task.fence_m:g} m")
        elif distance_m > START_M or angle_rad > START_RAD:
            if not task.may_return:
                self.refuse(f"it is {distance_m:.2f} m and {angle_rad:.2f} rad from its origin")
            elif self._path_home(relative_pose) is None:
                self.refuse(f"it is {distance_m:.2f} m from its origin, and more than {OFF_PATH_M:g} m off its path")

    def _path_home(self, relative_pose: OdometryPose) -> list[tuple[float, float]] | None:
        """Return the corners of the path back to the origin, or None if the robot is off its path."""
        nearest_m, leg_number = min(
            (_distance_to_leg_m(relative_pose[:2], leg_start, end), number)
            for number, (leg_start, end) in enumerate(zip(self._corners, self._corners[1:]))
        )
        return None if nearest_m > OFF_PATH_M else [relative_pose[:2], *reversed(self._corners[: leg_number + 1])]

    def _start_driving(self, now_s: float) -> None:
        """Start to drive out. If the robot is not at its origin, start to drive back to it first."""
        relative_pose = self.relative_pose
        assert relative_pose is not None
        path = self._path_home(relative_pose)
        if path is not None and (
            math.hypot(relative_pose.x_m, relative_pose.y_m) > START_M or abs(relative_pose.yaw_rad) > START_RAD
        ):
            self._legs = [
                (leg_start, end)
                for leg_start, end in zip(path, path[1:])
                if math.dist(leg_start, end) > ARRIVAL_TOLERANCE_M
            ]
            self.phase, self._phase_s = _RETURNS, now_s
        else:
            self._drive_out(now_s)
        self._progress_position = (relative_pose.x_m, relative_pose.y_m)

    def _drive_out(self, now_s: float) -> None:
        self._legs = [*zip(self._corners, self._corners[1:])]
        self.phase, self._phase_s, self.driven_m, self._turning = OUT, now_s, 0.0, True

    def on_order(self, now_s: float, order: str) -> None:
        """Process an order of the laptop, which also renews the lease."""
        self._order_s = now_s
        if order == END and not self.is_finished:
            self._stop("ordered to stop")
        elif order == BACK and self._order != BACK and not self.stop_reason:
            self._order = BACK
            self._turn_back(now_s)
        elif order == OUT and not self._order and self.ready:
            self._order = OUT
            self._start_driving(now_s)

    def tick(self, now_s: float) -> DriveVelocity:
        """Return the velocity to command from now on; must be called periodically."""
        elapsed_s, self._now_s = max(now_s - self._now_s, 0.0), now_s
        self._check_limits(now_s, elapsed_s)
        relative_pose = self.relative_pose
        desired = (
            ZERO_VELOCITY
            if self.stop_reason or relative_pose is None or not self._order
            else self._desired_velocity(relative_pose)
        )
        must_stop = desired == ZERO_VELOCITY  # a stop is immediate, without a ramp
        self._velocity = ZERO_VELOCITY if must_stop else self._ramp(desired, elapsed_s)
        return self._velocity

    def _check_limits(self, now_s: float, elapsed_s: float) -> None:
        """Stop the robot if a limit is exceeded."""
        task, relative_pose = self._task, self.relative_pose
        if self.is_finished:
            return
        if elapsed_s > GAP_S:
            self._stop(f"its program was suspended for {elapsed_s:.1f} s")
        elif now_s - self._order_s > task.lease_s:
            self._stop(f"no order from the laptop for {task.lease_s:g} s")
        elif self._pose is not None and now_s - self._odometry_s > task.odometry_s:
            self._stop(f"no odometry for {task.odometry_s:g} s")
        elif (
            relative_pose is not None
            and self.phase != _WAITS
            and math.hypot(relative_pose.x_m, relative_pose.y_m) > task.fence_m
        ):
            self._stop(f"beyond the fence, {task.fence_m:g} m from its origin")
        elif self._order and self.phase in (_RETURNS, OUT, BACK) and now_s - self._phase_s > task.limit_s:
            self._stop(f"the path was not finished in {task.limit_s:g} s")
        elif relative_pose is not None and not self._makes_progress(relative_pose, elapsed_s):
            self._stop(
                f"{self._commanded_m:.1f} m were commanded, but by its odometry the robot drove {self._moved_m:.1f} m"
            )

    def _makes_progress(self, relative_pose: OdometryPose, elapsed_s: float) -> bool:
        """Return True if the robot moves as commanded.

        This detects odometry that repeats one pose, which the timeout and the fence do not detect.
        """
        self._commanded_m += self._velocity.forward_m_s * elapsed_s
        self._moved_m = max(self._moved_m, math.dist(self._progress_position, (relative_pose.x_m, relative_pose.y_m)))
        if self._commanded_m < _STUCK_M + _STUCK_S * self._task.speed_m_s:
            return True
        if self._moved_m < self._commanded_m / 4:
            return False
        self._commanded_m, self._moved_m, self._progress_position = 0.0, 0.0, (relative_pose.x_m, relative_pose.y_m)
        return True

    def _stop(self, reason: str) -> None:
        self.stop_reason = self.stop_reason or reason

    def _turn_back(self, now_s: float) -> None:
        """Start to drive back along the corners that the robot has passed."""
        relative_pose = self.relative_pose
        passed_corners = self._corners[: len(self._corners) - len(self._legs)]
        if relative_pose is None or self.phase == _WAITS:  # the robot has not moved
            self.phase = "home"
            return
        if self.phase == _RETURNS:  # its path already leads to the origin
            self.phase, self._phase_s = BACK, now_s
            return
        path = [(relative_pose.x_m, relative_pose.y_m), *reversed(passed_corners)]
        self._legs = [
            (leg_start, end)
            for leg_start, end in zip(path, path[1:])
            if math.dist(leg_start, end) > ARRIVAL_TOLERANCE_M
        ]
        self.phase, self._phase_s, self._turning = BACK, now_s, True

    def _desired_velocity(self, relative_pose: OdometryPose) -> DriveVelocity:
        """Return the desired velocity before limits are applied.

        At the end of a leg, select the next one; at the end of the last leg, start the next phase.
        """
        if self.phase in (_WAITS, "there", "home"):
            return ZERO_VELOCITY
        while self._legs:
            leg_start, end = self._legs[0]
            length_m = math.dist(leg_start, end)
            direction = (end[0] - leg_start[0]) / length_m, (end[1] - leg_start[1]) / length_m
            offset = relative_pose.x_m - leg_start[0], relative_pose.y_m - leg_start[1]
            remaining_m = length_m - (offset[0] * direction[0] + offset[1] * direction[1])
            if remaining_m > ARRIVAL_TOLERANCE_M:
                cross_track_m = direction[0] * offset[1] - direction[1] * offset[0]
                heading_rad = math.atan2(direction[1], direction[0]) - math.atan2(cross_track_m, _LOOKAHEAD_M)
                return self._leg_velocity(remaining_m, wrap_angle(heading_rad - relative_pose.yaw_rad))
            del self._legs[0]
            self._turning = True
        if self.phase in (_RETURNS, BACK) and abs(wrap_angle(relative_pose.yaw_rad)) > HEADING_TOLERANCE_RAD:
            return DriveVelocity(0.0, self._turn_rad_s(wrap_angle(-relative_pose.yaw_rad)))
        if self.phase == _RETURNS:
            self._drive_out(self._now_s)
            return ZERO_VELOCITY
        self.phase = "there" if self.phase == OUT else "home"
        return ZERO_VELOCITY

    def _leg_velocity(self, remaining_m: float, error_rad: float) -> DriveVelocity:
        """Return the desired velocity for a remaining length of a leg and an error of the heading."""
        self._turning = abs(error_rad) > (HEADING_TOLERANCE_RAD if self._turning else _TURN_IN_PLACE_RAD)
        turn_rad_s = self._turn_rad_s(error_rad)
        if self._turning:
            return DriveVelocity(0.0, turn_rad_s)
        speed_m_s = min(self._task.speed_m_s, math.sqrt(self._task.acceleration_m_s2 * remaining_m))
        return DriveVelocity(max(speed_m_s * math.cos(error_rad), _MIN_SPEED_M_S), turn_rad_s)

    def _turn_rad_s(self, error_rad: float) -> float:
        return math.copysign(turn_rate_rad_s(abs(error_rad), self._task.turn_rad_s), error_rad)

    def _ramp(self, desired: DriveVelocity, elapsed_s: float) -> DriveVelocity:
        """Return the velocity nearest to the desired one that the limits allow after this time."""
        task = self._task
        max_change, max_turn_change = task.acceleration_m_s2 * elapsed_s, task.turn_rad_s / TURN_RAMP_S * elapsed_s
        forward = _approach(self._velocity.forward_m_s, desired.forward_m_s, max_change)
        turn = _approach(self._velocity.turn_rad_s, desired.turn_rad_s, max_turn_change)
        return DriveVelocity(_clamp(forward, task.speed_m_s), _clamp(turn, task.turn_rad_s))


def _distance_to_leg_m(
    position: tuple[float, float], leg_start: tuple[float, float], end: tuple[float, float]
) -> float:
    """Return the distance of a position from a leg, in metres."""
    direction = end[0] - leg_start[0], end[1] - leg_start[1]
    offset = position[0] - leg_start[0], position[1] - leg_start[1]
    squared_length = direction[0] ** 2 + direction[1] ** 2
    fraction = (
        min(max((offset[0] * direction[0] + offset[1] * direction[1]) / squared_length, 0.0), 1.0)
        if squared_length
        else 0.0
    )
    return math.hypot(offset[0] - fraction * direction[0], offset[1] - fraction * direction[1])


def _approach(current: float, desired: float, max_change: float) -> float:
    return current + _clamp(desired - current, max_change)


def _clamp(value: float, limit: float) -> float:
    return max(-limit, min(value, limit))


def _relative_pose(origin: OdometryPose, pose: OdometryPose) -> OdometryPose:
    """Return a pose relative to an origin, whose heading is the x axis."""
    cos, sin = math.cos(origin.yaw_rad), math.sin(origin.yaw_rad)
    x_m, y_m = pose.x_m - origin.x_m, pose.y_m - origin.y_m
    return OdometryPose(cos * x_m + sin * y_m, cos * y_m - sin * x_m, wrap_angle(pose.yaw_rad - origin.yaw_rad))
