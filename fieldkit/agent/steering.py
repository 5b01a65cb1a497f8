"""Steering a ground robot along straight legs by its odometry: pure, and within limits whatever it is told.

`Driver` knows of no clock, no middleware and no file: it is told where the robot is, what the laptop wants and how
late it is, and says how fast to drive and to turn. It follows lines: the heading that it wants leads back to the leg
over `_LOOKAHEAD_M` (Coulter, Implementation of the Pure Pursuit Path Tracking Algorithm, CMU-RI-TR-92-01, with a
straight path), and its speed before an end is the one from which half of its acceleration stops it there.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from fieldkit.agent.drive_plan import (
    ARRIVED_M,
    BACK,
    END,
    FACES_RAD,
    GAP_S,
    OFF_PATH_M,
    OUT,
    START_M,
    START_RAD,
    TURNS_UP_S,
    DriveTask,
    turning_rad_s,
    wrapped,
)

_TURNS_RAD = 0.6
"""More off its heading than this a robot stands and turns; less than `FACES_RAD` it drives again."""
_LOOKAHEAD_M = 0.5
_CREEP_M_S = 0.03
"""As slow as a robot's motors still turn."""
_JUMP_M = 0.5
"""No odometry of a robot that drives is off by so much at once."""
_STILL_M, _STILL_RAD, _STILL_S = 0.05, 0.05, 0.4
"""A robot whose odometry changed by less than this in that time is stationary."""
_WAITS, _RETURNS = "waits", "returns"
_STUCK_M, _STUCK_S = 0.5, 2.0
"""A robot that was told to drive so far, and for so long at its speed, has come a quarter of that at least."""


class OdometryPose(NamedTuple):
    """Where a robot is in the frame of its odometry."""

    x_m: float
    y_m: float
    yaw_rad: float


class DriveVelocity(NamedTuple):
    """How fast to drive ahead, and to turn to the left."""

    forward_m_s: float = 0.0
    turn_rad_s: float = 0.0


STAND = DriveVelocity()


class Driver:
    """Steers one robot along the legs of a task, and back.

    What stops it, stops it for good: `stopped` says why, and every velocity from then on is zero.

    Args:
        task: What it drives.
        now_s: When it begins, by a monotonic clock, as every time that it is told.

    Attributes:
        stopped: Why it stopped before its end; empty while it has not.
        phase: `waits` until it is stationary and ordered to start; `returns` while it drives to its origin first;
            then `out`, `there`, `back`, `home`.
        driven_m: How far it went since it was `out`.
        refused: Whether it stopped because it is not where it must be to start.
    """

    def __init__(self, task: DriveTask, now_s: float) -> None:
        self.stopped = ""
        self.phase = _WAITS
        self.driven_m = 0.0
        self.refused = False
        self._task = task
        self._made_s = now_s
        self._now_s = self._renewed_s = self._heard_s = self._began_s = now_s
        self._start = None if task.origin is None else OdometryPose(*task.origin)
        self._still: OdometryPose | None = None
        self._still_s = now_s
        self._here: OdometryPose | None = None
        self._order = ""
        self._corners = [(0.0, 0.0)]
        for ahead_m, left_m in task.legs:
            x_m, y_m = self._corners[-1]
            self._corners.append((x_m + ahead_m, y_m + left_m))
        # From one corner to another, while it has any left; then where it is to face.
        self._ways = [*zip(self._corners, self._corners[1:])]
        self._last: DriveVelocity = STAND
        self._turning = True
        # How far it was told to drive, and how far it came, since it was last seen to drive, and where that was.
        self._told_m = self._came_m = 0.0
        self._from = (0.0, 0.0)

    @property
    def here(self) -> OdometryPose | None:
        """Where it is, seen from its origin; None before the first odometry."""
        return None if self._start is None or self._here is None else _seen_from(self._start, self._here)

    @property
    def pose(self) -> OdometryPose | None:
        """Where it is in the frame of its odometry; None before the first odometry."""
        return self._here

    @property
    def ready(self) -> bool:
        """Whether it is stationary at a place where it may start."""
        return self._start is not None and self._here is not None and not self.over and self._is_still

    @property
    def _is_still(self) -> bool:
        return self._heard_s - self._still_s >= _STILL_S

    @property
    def lasted_s(self) -> float:
        """How long after it was made it was asked last for a velocity."""
        return self._now_s - self._made_s

    @property
    def over(self) -> bool:
        """Whether it is at its end: home, or stopped."""
        return bool(self.stopped) or self.phase == "home"

    @property
    def left_m(self) -> float:
        """How far it is from where this way leads."""
        here, goal = self.here, self._corners[0 if self.phase in ("back", "home") else -1]
        return math.inf if here is None else math.hypot(goal[0] - here.x_m, goal[1] - here.y_m)

    def odometry(self, now_s: float, pose: OdometryPose) -> None:
        """Take in where the robot is; what is no number is not heard."""
        if not all(map(math.isfinite, pose)):
            return
        if self._here is not None:
            gone_m = math.hypot(pose.x_m - self._here.x_m, pose.y_m - self._here.y_m)
            if gone_m > _JUMP_M + 2 * self._task.speed_m_s * max(now_s - self._heard_s, 0.0):
                self._stop(f"odometry jumped by {gone_m:.2f} m")
            self.driven_m += gone_m
        self._here, self._heard_s = pose, now_s
        if self.phase == _WAITS and not self.stopped:
            self._before_start(now_s, pose)

    def refuse(self, why: str) -> None:
        """Stop it for good because it is not where it must be to start."""
        self.refused = self.refused or not self.stopped
        self._stop(why)

    def _before_start(self, now_s: float, pose: OdometryPose) -> None:
        """See that it is stationary, and where it must be."""
        still = self._still
        if (
            still is None
            or math.dist(pose[:2], still[:2]) > _STILL_M
            or abs(wrapped(pose.yaw_rad - still.yaw_rad)) > _STILL_RAD
        ):
            self._still, self._still_s = pose, now_s
        if not self._is_still:
            return
        task = self._task
        if self._start is None:
            self._start = pose  # and it stays: the laptop records it
        here, last = self.here, task.last
        assert here is not None
        off_m, off_rad = math.hypot(here.x_m, here.y_m), abs(here.yaw_rad)
        if last is not None and (
            math.dist(pose[:2], last[:2]) > START_M or abs(wrapped(pose.yaw_rad - last[2])) > START_RAD
        ):
            self.refuse(
                f"its odometry is {math.dist(pose[:2], last[:2]):.2f} m and "
                f"{abs(wrapped(pose.yaw_rad - last[2])):.2f} rad from where its last motion ended"
            )
        elif off_m > task.fence_m:
            self.refuse(f"it is {off_m:.2f} m from its place, outside its fence of {task.fence_m:g} m")
        elif off_m > START_M or off_rad > START_RAD:
            if not task.may_return:
                self.refuse(f"it is {off_m:.2f} m and {off_rad:.2f} rad from its place")
            elif self._path_home(here) is None:
                self.refuse(f"it is {off_m:.2f} m from its place, and more than {OFF_PATH_M:g} m off its path")

    def _path_home(self, here: OdometryPose) -> list[tuple[float, float]] | None:
        """Return the corners of the way back from a place on its path; None off it."""
        nearest_m, before = min(
            (_off_leg_m(here[:2], begin, end), number)
            for number, (begin, end) in enumerate(zip(self._corners, self._corners[1:]))
        )
        return None if nearest_m > OFF_PATH_M else [here[:2], *reversed(self._corners[: before + 1])]

    def _set_off(self, now_s: float) -> None:
        """Start: out, or first back to its origin."""
        here = self.here
        assert here is not None
        path = self._path_home(here)
        if path is not None and (math.hypot(here.x_m, here.y_m) > START_M or abs(here.yaw_rad) > START_RAD):
            self._ways = [(begin, end) for begin, end in zip(path, path[1:]) if math.dist(begin, end) > ARRIVED_M]
            self.phase, self._began_s = _RETURNS, now_s
        else:
            self._go_out(now_s)
        self._from = (here.x_m, here.y_m)

    def _go_out(self, now_s: float) -> None:
        self._ways = [*zip(self._corners, self._corners[1:])]
        self.phase, self._began_s, self.driven_m, self._turning = OUT, now_s, 0.0, True

    def renewed(self, now_s: float, order: str) -> None:
        """Take in that the laptop is there, and what it wants."""
        self._renewed_s = now_s
        if order == END and not self.over:
            self._stop("ordered to stop")
        elif order == BACK and self._order != BACK and not self.stopped:
            self._order = BACK
            self._turn_back(now_s)
        elif order == OUT and not self._order and self.ready:
            self._order = OUT
            self._set_off(now_s)

    def tick(self, now_s: float) -> DriveVelocity:
        """Return how fast to drive and to turn from now on."""
        for_s, self._now_s = max(now_s - self._now_s, 0.0), now_s
        self._watch(now_s, for_s)
        here = self.here
        wanted = STAND if self.stopped or here is None or not self._order else self._wanted(here)
        stands = wanted == STAND  # at once: nothing that stops a robot waits for a ramp
        self._last = STAND if stands else self._ramped(wanted, for_s)
        return self._last

    def _watch(self, now_s: float, for_s: float) -> None:
        """Stop it where something does not hold that must."""
        task, here = self._task, self.here
        if self.over:
            return
        if for_s > GAP_S:
            self._stop(f"its program was suspended for {for_s:.1f} s")
        elif now_s - self._renewed_s > task.lease_s:
            self._stop(f"the laptop was silent for {task.lease_s:g} s")
        elif self._here is not None and now_s - self._heard_s > task.odometry_s:
            self._stop(f"odometry was silent for {task.odometry_s:g} s")
        elif here is not None and self.phase != _WAITS and math.hypot(here.x_m, here.y_m) > task.fence_m:
            self._stop(f"beyond the fence, {task.fence_m:g} m from its place")
        elif self._order and self.phase in (_RETURNS, OUT, BACK) and now_s - self._began_s > task.limit_s:
            self._stop(f"not there after {task.limit_s:g} s")
        elif here is not None and not self._drives(here, for_s):
            self._stop(f"told to drive {self._told_m:.1f} m, it came {self._came_m:.1f} m, as its odometry says")

    def _drives(self, here: OdometryPose, for_s: float) -> bool:
        """Return whether it comes on as it is told.

        Odometry that says the same for ever is not silent, and within the fence.
        """
        self._told_m += self._last.forward_m_s * for_s
        self._came_m = max(self._came_m, math.dist(self._from, (here.x_m, here.y_m)))
        if self._told_m < _STUCK_M + _STUCK_S * self._task.speed_m_s:
            return True
        if self._came_m < self._told_m / 4:
            return False
        self._told_m, self._came_m, self._from = 0.0, 0.0, (here.x_m, here.y_m)
        return True

    def _stop(self, why: str) -> None:
        self.stopped = self.stopped or why

    def _turn_back(self, now_s: float) -> None:
        """Go back by the corners that it has passed."""
        here = self.here
        passed = self._corners[: len(self._corners) - len(self._ways)]
        if here is None or self.phase == _WAITS:  # it has not moved
            self.phase = "home"
            return
        if self.phase == _RETURNS:  # its way leads there already
            self.phase, self._began_s = BACK, now_s
            return
        path = [(here.x_m, here.y_m), *reversed(passed)]
        self._ways = [(begin, end) for begin, end in zip(path, path[1:]) if math.dist(begin, end) > ARRIVED_M]
        self.phase, self._began_s, self._turning = BACK, now_s, True

    def _wanted(self, here: OdometryPose) -> DriveVelocity:
        """Return the velocity that leads on, before it is limited; go over to the next way where this one ends."""
        if self.phase in (_WAITS, "there", "home"):
            return STAND
        while self._ways:
            begin, end = self._ways[0]
            long_m = math.dist(begin, end)
            along = (end[0] - begin[0]) / long_m, (end[1] - begin[1]) / long_m
            off = here.x_m - begin[0], here.y_m - begin[1]
            left_m = long_m - (off[0] * along[0] + off[1] * along[1])
            if left_m > ARRIVED_M:
                across_m = along[0] * off[1] - along[1] * off[0]
                heading_rad = math.atan2(along[1], along[0]) - math.atan2(across_m, _LOOKAHEAD_M)
                return self._along(left_m, wrapped(heading_rad - here.yaw_rad))
            del self._ways[0]
            self._turning = True
        if self.phase in (_RETURNS, BACK) and abs(wrapped(here.yaw_rad)) > FACES_RAD:
            return DriveVelocity(0.0, self._turn_rad_s(wrapped(-here.yaw_rad)))
        if self.phase == _RETURNS:
            self._go_out(self._now_s)
            return STAND
        self.phase = "there" if self.phase == OUT else "home"
        return STAND

    def _along(self, left_m: float, off_rad: float) -> DriveVelocity:
        """Return the velocity with so much of a leg left, and so much off the heading."""
        self._turning = abs(off_rad) > (FACES_RAD if self._turning else _TURNS_RAD)
        turn_rad_s = self._turn_rad_s(off_rad)
        if self._turning:
            return DriveVelocity(0.0, turn_rad_s)
        speed_m_s = min(self._task.speed_m_s, math.sqrt(self._task.acceleration_m_s2 * left_m))
        return DriveVelocity(max(speed_m_s * math.cos(off_rad), _CREEP_M_S), turn_rad_s)

    def _turn_rad_s(self, off_rad: float) -> float:
        return math.copysign(turning_rad_s(abs(off_rad), self._task.turn_rad_s), off_rad)

    def _ramped(self, wanted: DriveVelocity, for_s: float) -> DriveVelocity:
        """Return a velocity within the limits that the robot can have after so many seconds."""
        task = self._task
        most, turn_most = task.acceleration_m_s2 * for_s, task.turn_rad_s / TURNS_UP_S * for_s
        forward = _near(self._last.forward_m_s, wanted.forward_m_s, most)
        turn = _near(self._last.turn_rad_s, wanted.turn_rad_s, turn_most)
        return DriveVelocity(_within(forward, task.speed_m_s), _within(turn, task.turn_rad_s))


def _off_leg_m(place: tuple[float, float], begin: tuple[float, float], end: tuple[float, float]) -> float:
    """Return the distance of a place from a straight piece of a path, in metres."""
    along = end[0] - begin[0], end[1] - begin[1]
    off = place[0] - begin[0], place[1] - begin[1]
    square = along[0] ** 2 + along[1] ** 2
    share = min(max((off[0] * along[0] + off[1] * along[1]) / square, 0.0), 1.0) if square else 0.0
    return math.hypot(off[0] - share * along[0], off[1] - share * along[1])


def _near(now: float, wanted: float, most: float) -> float:
    return now + _within(wanted - now, most)


def _within(value: float, limit: float) -> float:
    return max(-limit, min(value, limit))


def _seen_from(start: OdometryPose, pose: OdometryPose) -> OdometryPose:
    """Return a pose as seen from another, ahead of which is x."""
    cos, sin = math.cos(start.yaw_rad), math.sin(start.yaw_rad)
    x_m, y_m = pose.x_m - start.x_m, pose.y_m - start.y_m
    return OdometryPose(cos * x_m + sin * y_m, cos * y_m - sin * x_m, wrapped(pose.yaw_rad - start.yaw_rad))
