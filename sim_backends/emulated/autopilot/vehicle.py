"""The emulated drone as a vehicle: arming, flight mode, and the motion that follows from them.

It has neither clock nor socket: `advance` receives the time.
"""

import math
from contextlib import suppress
from dataclasses import replace
from typing import Final

from fieldkit.core.model import Vector
from sim_backends.emulated.autopilot.failsafes import Reaction
from sim_backends.emulated.autopilot.firmware import ModeConditions
from sim_backends.emulated.autopilot.flight import NEAR_M, STEP_NS, SetPoint, stop_m
from sim_backends.emulated.autopilot.mavlink_frames import dialect
from sim_backends.emulated.autopilot.mission_plan import Item
from sim_backends.emulated.autopilot.modes import LANDING, PILOTED, Mode, reported_mode
from sim_backends.emulated.autopilot.vehicle_base import VehicleBase

_INFO: Final = dialect.MAV_SEVERITY_INFO
_CRITICAL: Final = dialect.MAV_SEVERITY_CRITICAL

_PREARM_NS: Final = 30_000_000_000
"""ArduPilot repeats the reasons why it cannot be armed at this interval (AP_Arming)."""
_MIN_LIFT_OFF_M_S: Final = 0.02
"""Minimum vertical target velocity at which a landed vehicle lifts off; small position errors cause lower values."""
_OFFBOARD_LOST: Final = {3: Mode.RTL, 4: Mode.LAND}
"""Mode when set-points are missing, by COM_OBL_RC_ACT; with other values the vehicle holds its position (LOITER).

The values 0 to 2 are modes that need a remote control, which is not emulated. The value 5 is Hold. The values 6
(terminate) and 7 (disarm) are not emulated.
"""


class Refused(Exception):  # noqa: N818 (an answer of the autopilot, not an error)
    """The vehicle refuses a command; the message is the text that the firmware sends, which may be empty."""


class Vehicle(VehicleBase):
    """One drone; its arguments and attributes are those of `VehicleBase`."""

    def check(self) -> None:
        """Report the reasons why it cannot be armed.

        Raises:
            Refused: The vehicle is armed.
        """
        if self.is_armed:
            raise self._refusal("Prearm checks denied: armed")
        for reason in self.arming_errors:
            self.report(_CRITICAL, self.firmware.prearm_prefixes[0] + reason)

    def arm(self) -> None:
        """Start the motors; does nothing if they are already running.

        Raises:
            Refused: The vehicle is falling, or cannot be armed now.
        """
        if self.is_armed:
            return
        if not self.body.on_ground:
            raise self._refusal("Arming denied: vehicle is falling")
        reasons = self.arming_errors
        if self.mode in self.firmware.modes_without_arming:
            reasons.append(f"{self.firmware.names[reported_mode(self.mode)]} mode not armable")
        for reason in reasons:
            self.report(_CRITICAL, self.firmware.prearm_prefixes[1] + reason)
        if reasons:
            raise self._refusal("Arming denied: Resolve system health failures first")
        self.home_m = self.body.home_m = self.body.place_m
        self.is_armed = True
        self.fence.reset()
        self.land_detector.arm(self.body.now_ns)
        self.guidance.hold(self.body.position_m)
        self.report(_INFO, "Arming motors" if self.firmware.is_ardupilot else "Armed by external command")

    def disarm(self, *, force: bool = False) -> None:
        """Stop the motors.

        Args:
            force: True to stop them even in the air, which makes the vehicle fall.

        Raises:
            Refused: The vehicle is in the air, and `force` is False.
        """
        if self.is_armed and not self.body.on_ground and not force:
            raise self._refusal("Disarming denied: not landed")
        if self.is_armed and self.firmware.is_ardupilot:
            self.report(_INFO, "Disarming motors")
        self.is_armed = False
        self.failsafes.on_mode_change(self.body.now_ns)
        if not self.firmware.is_ardupilot:  # ArduCopter keeps its mode
            self.mode = Mode.LOITER

    def take_off(self, height_m: float | None = None) -> None:
        """Take off. A repeated command has no effect before the vehicle lifts off; with PX4, until the take-off ends.

        Args:
            height_m: Height above home; None for the parameter MIS_TAKEOFF_ALT.

        Raises:
            Refused: The motors are off, it is flying, the height is not allowed, or ArduCopter is not in mode
                OFFBOARD.
        """
        if self.mode is Mode.TAKEOFF and (self.land_detector.has_landed or not self.firmware.is_ardupilot):
            return
        height_m = self._parameters["MIS_TAKEOFF_ALT"] if height_m is None else height_m
        if not self.is_armed:
            raise self._refusal("Takeoff denied: not armed")
        if not self.body.on_ground:
            raise self._refusal("Takeoff denied: already in the air")
        if self.firmware.is_ardupilot and (self.mode is not Mode.OFFBOARD or height_m <= self.body.position_m[2]):
            raise self._refusal("Takeoff denied: not in GUIDED, or not upwards")
        self._fly_to(Mode.TAKEOFF, (*self.body.position_m[:2], height_m))

    def go_to(self, goal_m: Vector) -> None:
        """Fly to a point relative to home, and stay there.

        Raises:
            Refused: The vehicle is not flying, or the point is outside PX4's fence. ArduCopter ignores a point
                outside its fence.
        """
        if self.body.on_ground:
            raise self._refusal("Reposition denied: not in the air")
        if self.firmware.is_ardupilot:
            self.change_mode(Mode.OFFBOARD)
            self.accept_set_point(SetPoint(goal_m, is_position=True))
        else:
            self._fly_to(Mode.LOITER, goal_m)
            self.failsafes.on_mode_change(self.body.now_ns)

    def accept_set_point(self, set_point: SetPoint) -> None:
        """Accept a set-point for mode OFFBOARD.

        ArduCopter ignores set-points in other modes and on the ground, and positions outside its fence. With
        ArduCopter, an accepted set-point ends a take-off.
        """
        if self.firmware.is_ardupilot:
            if self.mode not in {Mode.OFFBOARD, Mode.TAKEOFF} or self.body.on_ground:
                return
            if set_point.is_position and not self.fence.contains(set_point.vector):
                return
            self.mode = Mode.OFFBOARD
        self.guidance.set_point, self.guidance.set_point_ns = set_point, self.body.now_ns

    def change_mode(self, mode: Mode) -> None:
        """Change the mode at the request of a client; the current mode is kept if it is requested again.

        Raises:
            Refused: A condition of the mode is not met. A mode may require a mission, recent set-points, a flying
                vehicle, or the conditions of `take_off`.
        """
        self._switch(mode)
        self.failsafes.on_mode_change(self.body.now_ns)

    def load(self, items: tuple[Item, ...]) -> None:
        """Load a new mission; a mission in flight is aborted, and the vehicle holds its position."""
        if self.mode is Mode.MISSION and self.is_armed:
            self._switch(Mode.LOITER)
        self.mission.load(items)

    def advance(self, now_ns: int) -> None:
        """Fly until this time, in whole steps."""
        parameters, battery = self._parameters, self.battery
        battery.full_v, battery.flight_s = parameters["SIM_BATT_VOLTAGE"], parameters["SIM_BAT_DRAIN"]
        battery.min_charge = parameters["SIM_BAT_MIN_PCT"] / 100
        battery.advance(now_ns, motors_on=self.is_armed)
        while self.body.now_ns + STEP_NS <= now_ns:
            if not self.is_armed and self.body.on_ground:
                self.body.rest(now_ns)
                self.land_detector.has_landed = True
                break
            self._check_flight_state()
            self.body.motors_on = self.is_armed
            target_m_s = self._target_m_s()  # this call may change the mode
            self.body.step(target_m_s, self.limits, self.guidance.yaw_rad(self.mode, self.body))
        self._update_boot_state()
        self._run_failsafes()

    def _update_boot_state(self) -> None:
        """Set the origin once the position estimate is good. ArduPilot also reports why it cannot be armed."""
        now_ns, estimate = self.body.now_ns, self.estimate
        if self.firmware.is_ardupilot and not self.is_armed and now_ns >= self._next_prearm_ns:
            self._next_prearm_ns = now_ns + _PREARM_NS
            if estimate.is_starting(now_ns) or estimate.origin_m is not None:
                self.check()
        if not estimate.advance(now_ns, self.body.place_m):
            return
        if not self.is_armed:
            self.home_m = self.body.home_m = self.body.place_m
            self.guidance.hold(self.body.position_m)
        if self.firmware.is_ardupilot and not estimate.is_instant:
            self.report(_INFO, "EKF3 IMU0 origin set")
            self.report(_INFO, "EKF3 IMU0 is using GPS")

    def _run_failsafes(self) -> None:
        for reaction in self.failsafes.advance(self._state):
            self._react(reaction)

    def _react(self, reaction: Reaction) -> None:
        if reaction.text:
            self.report(reaction.severity, reaction.text)
        if reaction.disarm:
            self.disarm(force=True)
        if reaction.mode is not None:
            self._switch_automatically(reaction.mode)

    def _switch_automatically(self, mode: Mode) -> None:
        """Change the mode without a client's request; if the change is refused, the mode is kept."""
        with suppress(Refused):
            self._switch(mode)

    def _switch(self, mode: Mode) -> None:
        """Change the mode, without a report to the failsafes; raises the errors of `change_mode`."""
        if mode is self.mode:
            return
        if mode is Mode.TAKEOFF:
            self.take_off()
            return
        self._check_mode(mode)
        if mode is Mode.MISSION:
            self.mission.start()
        self.guidance.goal_m = self._stop_m()
        if mode is Mode.OFFBOARD and self.firmware.holds_without_set_points:
            self.guidance.hold(self.guidance.goal_m)
        self.mode = mode

    def _check_mode(self, mode: Mode) -> None:
        """Raise `Refused` if the firmware refuses a mode now."""
        conditions = ModeConditions(
            is_armed=self.is_armed,
            has_landed=self.land_detector.has_landed,
            on_ground=self.body.on_ground,
            mission_commands=[item.command for item in self.mission.items],
            has_recent_set_point=self.guidance.has_recent_set_point(self.body.now_ns),
        )
        if (refusal := self.firmware.mode_refusal(mode, conditions)) is None:
            return
        if refusal.reason:
            self.report(_CRITICAL, refusal.reason)
        raise Refused(refusal.text)

    def _fly_to(self, mode: Mode, goal_m: Vector) -> None:
        if not all(map(math.isfinite, goal_m)) or not self.fence.contains(goal_m):
            raise self._refusal(f"{mode.name} denied: beyond the fence")
        self.mode, self.guidance.goal_m = mode, goal_m

    def _refusal(self, reason: str) -> Refused:
        """Return the exception for a refused command; ArduCopter answers without a text."""
        return Refused("" if self.firmware.is_ardupilot else reason)

    def _check_flight_state(self) -> None:
        """Detect take-off and landing; stop idle motors; react to missing set-points and to the fence."""
        now_ns, is_ardupilot = self.body.now_ns, self.firmware.is_ardupilot
        self.land_detector.advance(now_ns, on_ground=self.body.on_ground)
        if self.is_armed and now_ns - self.land_detector.grounded_ns > self._idle_s() * 1e9:
            if not is_ardupilot:
                reason = "landing" if self.land_detector.has_flown else "auto preflight disarming"
                self.report(_INFO, f"Disarmed by {reason}")
            self.disarm()
        if is_ardupilot and (breach := self.fence.advance(self._state, self.body.position_m)):
            self._react(breach)
        if self.mode is Mode.OFFBOARD:
            self._check_set_points()

    def _idle_s(self) -> float:
        """Return the time on the ground after which the motors stop.

        The time is shorter after a landing. With ArduCopter, this applies only in MISSION and in the landing modes.
        """
        stops_after_landing = self.mode is Mode.MISSION or not self.firmware.is_ardupilot
        has_landed = (self.land_detector.has_flown and stops_after_landing) or self.mode in LANDING
        return self._parameters["COM_DISARM_LAND" if has_landed else "COM_DISARM_PRFLT"]

    def _check_set_points(self) -> None:
        """React to missing set-points, and to set-points that lead outside PX4's fence."""
        has_recent_set_point = self.guidance.has_recent_set_point(self.body.now_ns)
        if self.firmware.is_ardupilot:
            if not self.guidance.set_point.is_position and not has_recent_set_point:
                self.guidance.set_point = SetPoint(self._stop_m(), is_position=True)
        elif not has_recent_set_point:
            self.report(_CRITICAL, "Failsafe activated")
            self._switch_automatically(_OFFBOARD_LOST.get(int(self._parameters["COM_OBL_RC_ACT"]), Mode.LOITER))
            self.failsafes.on_lost_set_points()
        elif breach := self.fence.before_crossing(self.body.position_m, stop_m(self.body, self.limits)):
            self._react(breach)

    def _must_stay_on_ground(self) -> bool:
        """Return True if it is on the ground and cannot lift off now.

        Its motors are still spooling up, or it cannot take off in its current mode.
        """
        spools_up = self.body.now_ns - self.land_detector.armed_ns < self.firmware.spool_s * 1e9
        follows_set_points = self.mode is Mode.OFFBOARD and not self.firmware.set_points_lift_off
        return self.body.on_ground and (spools_up or follows_set_points or self.mode in PILOTED)

    def _target_m_s(self) -> Vector:
        """Make the changes of mode that are due, and return the target velocity."""
        if not self._must_stay_on_ground():
            self._advance_mode()
        if self._must_stay_on_ground():
            return 0.0, 0.0, 0.0
        limits = self.limits
        if self.mode is Mode.MISSION:
            limits = replace(limits, speed_m_s=min(limits.speed_m_s, self.mission.speed_m_s or limits.speed_m_s))
        target_m_s = self.guidance.velocity_m_s(self.mode, self.body, limits, self.fence.limits_m[1])
        stays_landed = self.land_detector.has_landed and target_m_s[2] < _MIN_LIFT_OFF_M_S
        return (0.0, 0.0, 0.0) if stays_landed else target_m_s

    def _advance_mode(self) -> None:
        """Proceed to the next item of a mission, and to the mode after a take-off, a mission or a return."""
        if self.mode is Mode.MISSION:
            action = self.mission.next_goal_or_mode(
                self.body,
                self.home_m,
                self._parameters["NAV_ACC_RAD"],
                has_landed=self.land_detector.has_landed,
            )
            if isinstance(action, str):
                self._switch_automatically(Mode[action])
            else:
                self.guidance.goal_m = action
        if self.mode is Mode.RTL and self.guidance.is_home(self.body):
            self.mode, self.guidance.goal_m = Mode.HOMECOMING, (0.0, 0.0, 0.0)
        if self.mode is Mode.TAKEOFF and math.dist(self.body.position_m, self.guidance.goal_m) < NEAR_M:
            self.mode = Mode.OFFBOARD if self.firmware.is_ardupilot else Mode.LOITER
            self.guidance.hold(self.guidance.goal_m)
