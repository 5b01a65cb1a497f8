"""Check that an autopilot can be armed for a flight; each fault is reported with a remedy."""

from __future__ import annotations

import json
import sys
import threading
import time
from contextlib import closing
from dataclasses import dataclass
from typing import Iterator

from fieldkit.agent.autopilots.autopilot import PREFLIGHT, AutopilotState
from fieldkit.agent.autopilots.dialect import PREARM_CHECKS
from fieldkit.agent.autopilots.mavlink_frames import HOME_POSITION, LOCAL_POSITION_NED, SYS_STATUS
from fieldkit.agent.flying.flight_plan import FlightNeeds
from fieldkit.agent.flying.session import AutopilotSession

_POLL_S = 0.1
_RETRY_S = 0.4
"""Retry interval of a request without an answer."""
_HEARTBEAT_TIMEOUT_S = 5.0
_TIMEOUT_S = 5.0
"""Timeout for reports that every autopilot sends."""
_OPTIONAL_TIMEOUT_S = 1.5
"""Timeout for reports that only some autopilots send."""
_ESTIMATE_TIMEOUT_S = 10.0
"""Timeout for a position estimate: the autopilot may have been switched on only recently."""
_NO_ESTIMATE = "Need Position Estimate"
"""Text of an ArduCopter whose position estimate is not ready."""
_RESULT_DELAY_S = 0.3
"""Delay after the arming checks until SYS_STATUS contains their result."""
_RATE_HZ = 5.0
"""Rate at which reports are requested."""

_PREARM = 0x10000000
"""MAV_SYS_STATUS_PREARM_CHECK."""
_SENSORS = {
    0x1: "gyroscope",
    0x2: "accelerometer",
    0x4: "magnetometer",
    0x8: "barometer",
    0x20: "GPS",
    0x40: "optical flow",
    0x80: "vision position",
    0x10000: "remote control",
    0x100000: "fence",
    0x200000: "AHRS",
    0x400000: "terrain",
    0x1000000: "logging",
    0x2000000: "battery",
}
"""Bits of MAV_SYS_STATUS_SENSOR for sensors and functions whose fault an operator can remove."""
_PREFIXES = ("PreArm: ", "Preflight Fail: ")
"""Prefixes of the texts in which ArduPilot and PX4 report why they cannot be armed."""

_ATTITUDE, _HORIZONTAL, _VERTICAL, _ASSUMED = 1, 8 | 16 | 256 | 512, 32 | 64, 128
"""ESTIMATOR_STATUS_FLAGS: attitude; horizontal position, relative or absolute, present or predicted; vertical
position; only the assumption that the vehicle does not move (CONST_POS_MODE)."""


@dataclass(frozen=True)
class ArmingFault:
    """A reason why an autopilot cannot be armed, or why the flight must not start.

    Attributes:
        what: The reason, one sentence without a full stop.
        remedy: The remedy.
        prevents_flight: True if the flight is refused; False if it is only a warning, because the autopilot checked
            its current mode, and the flight uses another mode.
    """

    what: str
    remedy: str
    prevents_flight: bool = True


class ArmingCheck:
    """Requests reports from an autopilot on the ground, and evaluates them.

    Args:
        drone: The autopilot; its heartbeat was received.
        needs: Requirements of the flight.
    """

    def __init__(self, drone: AutopilotState, needs: FlightNeeds) -> None:
        self._drone = drone
        self._needs = needs
        self._start_s = time.monotonic()
        self._next_request_s = 0.0
        self._checks_done_s: float | None = None
        drone.status = drone.estimate = None
        drone.texts.clear()
        drone.command_results.pop(PREARM_CHECKS, None)

    def request_missing(self) -> None:
        """Request the missing reports; must be called repeatedly until `is_complete` is True."""
        drone, now_s = self._drone, time.monotonic()
        if self._checks_done_s is None and PREARM_CHECKS in drone.command_results:
            self._checks_done_s = now_s
        if now_s < self._next_request_s or drone.dialect is None:
            return
        self._next_request_s = now_s + _RETRY_S
        for kind, value in ((SYS_STATUS, drone.status), (LOCAL_POSITION_NED, drone.position_m)):
            if value is None:
                drone.commands.request_stream(kind, _RATE_HZ)
        if drone.estimate is None:
            drone.commands.request_stream(drone.dialect.estimate_message, _RATE_HZ)
        if self._checks_done_s is None:
            drone.commands.send(PREARM_CHECKS)
        if self._needs.returns and not drone.has_home:
            drone.commands.request_once(HOME_POSITION)
        for name in self._missing_parameters():
            drone.commands.request_parameter(name)

    def _missing_parameters(self) -> list[str]:
        """Return all alternative names of each needed parameter that the autopilot has not reported yet."""
        dialect = self._drone.dialect
        alternatives = [names.split("|") for names in dialect.limit_parameters] if dialect else []
        reported_names = self._drone.parameters.keys()
        return [name for names in alternatives if reported_names.isdisjoint(names) for name in names]

    @property
    def is_starting(self) -> bool:
        """Whether the position estimate or the required home position is not ready yet.

        With good reception of satellites, both are ready about 30 s after power-on.
        """
        reports_no_estimate = any(_NO_ESTIMATE in text for text in self._drone.texts.warnings)
        return self._drone.dialect is not None and (reports_no_estimate or any(self._position_faults()))

    @property
    def is_complete(self) -> bool:
        """Whether all reports were received, their timeout has expired, or the family of the autopilot is unknown."""
        drone, elapsed_s = self._drone, time.monotonic() - self._start_s
        if drone.dialect is None or elapsed_s > _TIMEOUT_S:
            return True
        if drone.status is None or drone.position_m is None:
            return False
        if elapsed_s > _OPTIONAL_TIMEOUT_S:
            return True
        has_required_home = drone.has_home or not self._needs.returns
        has_check_result = (
            self._checks_done_s is not None and drone.status.received_s > self._checks_done_s + _RESULT_DELAY_S
        )
        return (
            has_check_result and has_required_home and drone.estimate is not None and not self._missing_parameters()
        )

    def faults(self) -> Iterator[ArmingFault]:
        """Yield the faults that were detected."""
        drone = self._drone
        if drone.dialect is None:
            what = "its autopilot is neither PX4 nor ArduCopter (MAV_AUTOPILOT {}, MAV_TYPE {})".format(*drone.family)
            yield ArmingFault(what, "fly it by other means; a `mavlink` step records the flight")
            return
        if drone.armed:
            yield ArmingFault("its motors are running", "land it first")
        yield from self._position_faults()
        yield from self._battery_faults()
        yield from self._prearm_faults()
        yield from self._limit_faults()

    def _position_faults(self) -> Iterator[ArmingFault]:
        drone = self._drone
        if drone.position_m is None:
            remedy = "wait for its GPS, or check that its camera or flow sensor runs and faces the ground"
            yield ArmingFault("it does not report its position (LOCAL_POSITION_NED)", remedy)
        flags = drone.estimate
        if flags is not None and not (
            flags & _ATTITUDE and flags & _HORIZONTAL and flags & _VERTICAL and not flags & _ASSUMED
        ):
            what = f"its position estimate is not valid (flags {flags:#x})"
            yield ArmingFault(what, "wait for its GPS, camera or flow sensor; do not move the drone meanwhile")
        if self._needs.returns and not drone.has_home:
            what = "it has no home position, but it must return home if the trial is aborted"
            yield ArmingFault(what, "wait for its GPS, or write on_abort: land in the procedure")

    def _battery_faults(self) -> Iterator[ArmingFault]:
        status, minimum = self._drone.status, self._needs.least_charge
        if status is None:
            yield ArmingFault("it does not report its status (SYS_STATUS)", "check which messages its link forwards")
        elif status.charge is not None and status.charge < minimum:
            what = f"its battery charge is {status.charge:.0%}, but the minimum is {minimum:.0%}"
            yield ArmingFault(
                what, "charge or replace the battery; mavlink.least_charge in its profile sets the minimum"
            )

    def _prearm_faults(self) -> Iterator[ArmingFault]:
        drone = self._drone
        assert drone.dialect is not None
        reasons = [
            text[len(prefix) :] for text in drone.texts.warnings for prefix in _PREFIXES if text.startswith(prefix)
        ]
        unhealthy = drone.status.unhealthy if drone.status else 0
        if not reasons and not unhealthy & _PREARM:
            return
        reasons = (
            list(dict.fromkeys(reasons))
            or drone.texts.warnings
            or [name for bit, name in _SENSORS.items() if unhealthy & bit]
        )
        what = f"{drone.dialect.name} refuses to arm: {', '.join(reasons) or 'it reports no reason'}"
        remedy = "remove the cause; a ground station (QGroundControl, MAVProxy) shows the same messages"
        yield ArmingFault(what, remedy, prevents_flight=drone.guided or not drone.dialect.checks_current_mode)

    def _limit_faults(self) -> Iterator[ArmingFault]:
        drone, needs = self._drone, self._needs
        assert drone.dialect is not None
        limits = drone.dialect.limits(drone.parameters)
        *fence_parameters, return_parameter = drone.dialect.limit_parameters
        for limit_m, needed_m, direction in (
            (limits.height_m, needs.highest_m, "above home"),
            (limits.radius_m, needs.farthest_m, "from home"),
        ):
            if limit_m is not None and needed_m > limit_m:
                yield ArmingFault(
                    f"the fence of its autopilot ends {limit_m:g} m {direction}, but the flight needs {needed_m:g} m",
                    f"shorten the flight in the procedure, or enlarge the fence: {', '.join(fence_parameters)}",
                )
        if needs.returns and limits.return_m is not None and limits.return_m > needs.ceiling_m:
            what = f"it returns at a height of {limits.return_m:g} m, but only {needs.ceiling_m:g} m are allowed"
            remedy = f"write on_abort: land, or lower {return_parameter.replace('|', ' or ')}"
            yield ArmingFault(what, f"{remedy}; limits.max_height_m in its profile sets the allowed height")


def check_arming(connection: str, needs: FlightNeeds, stop_event: threading.Event) -> int:
    """Check an autopilot, print the result as JSON, and return the exit code: 1 without a heartbeat, else 0.

    Each line is a JSON object: one per fault, then the summary with the family of the autopilot and the charge of its
    battery.

    Raises:
        OSError: The connection cannot be opened.
        ValueError: The name of the connection is invalid.
    """
    with closing(AutopilotSession(connection, component=PREFLIGHT)) as session:
        heartbeat_deadline_s = time.monotonic() + _HEARTBEAT_TIMEOUT_S
        while not session.drone.alive and not stop_event.is_set():
            if time.monotonic() > heartbeat_deadline_s:
                sys.stderr.write(
                    f"error: no heartbeat from an autopilot at {connection} in {_HEARTBEAT_TIMEOUT_S:g} s\n"
                )
                return 1
            session.exchange(_POLL_S)
        check, estimate_deadline_s = ArmingCheck(session.drone, needs), time.monotonic() + _ESTIMATE_TIMEOUT_S
        while not stop_event.is_set():
            check.request_missing()
            session.exchange(_POLL_S)
            if check.is_complete:
                if not check.is_starting or time.monotonic() > estimate_deadline_s:
                    break
                check = ArmingCheck(session.drone, needs)
    dialect, status = session.drone.dialect, session.drone.status
    lines = [
        json.dumps({"what": fault.what, "remedy": fault.remedy, "grave": fault.prevents_flight})
        for fault in check.faults()
    ]
    summary = {"autopilot": dialect.name if dialect else "", "charge": status.charge if status else None}
    sys.stdout.write("\n".join([*lines, json.dumps(summary), ""]))
    return 0
