"""Detect from its odometry that a ground robot is stationary."""

from __future__ import annotations

import math
from collections import deque

from fieldkit.agent.driving.drive_plan import wrap_angle
from fieldkit.agent.driving.steering import OdometryPose

WINDOW_S = 0.2
"""Length of the time window of the compared poses."""
_MOVED_M, _TURNED_RAD = 0.005, 0.02
"""A larger change of the pose in `WINDOW_S` is motion, a smaller one is noise: 0.025 m/s and 0.1 rad/s."""


class Standstill:
    """Compares the newest pose with the poses of the last `WINDOW_S`, and with the last pose before this window."""

    def __init__(self) -> None:
        self._poses: deque[tuple[float, OdometryPose]] = deque()

    def add_pose(self, at_s: float, pose: OdometryPose) -> None:
        """Add a pose with its time of arrival by a monotonic clock."""
        self._poses.append((at_s, pose))
        while len(self._poses) > 1 and at_s - self._poses[1][0] >= WINDOW_S:
            self._poses.popleft()

    @property
    def stationary(self) -> bool:
        """Whether the poses cover `WINDOW_S` and show no motion."""
        if not self._poses or self._poses[-1][0] - self._poses[0][0] < WINDOW_S:
            return False
        newest = self._poses[-1][1]
        return all(
            math.hypot(pose.x_m - newest.x_m, pose.y_m - newest.y_m) <= _MOVED_M
            and abs(wrap_angle(pose.yaw_rad - newest.yaw_rad)) <= _TURNED_RAD
            for _, pose in self._poses
        )
