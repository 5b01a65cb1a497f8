"""Ask an autopilot whether it may be armed for a flight; say what speaks against that, and what to do about it."""

from __future__ import annotations

import json
import sys
import threading
import time
from contextlib import closing
from dataclasses import asdict, dataclass
from typing import Iterator

from fieldkit.agent.autopilot import PREFLIGHT, AutopilotState
from fieldkit.agent.dialect import PREARM_CHECKS
from fieldkit.agent.flight_plan import FlightNeeds
from fieldkit.agent.flying.talk import AutopilotTalk
from fieldkit.agent.mavlink_frames import HOME_POSITION, LOCAL_POSITION_NED, SYS_STATUS

_TURN_S = 0.1
_AGAIN_S = 0.4
"""After so long without an answer a question is asked again."""
_HEARTBEAT_S = 5.0
_PATIENCE_S = 5.0
"""So long it waits for what every autopilot says."""
_SPARE_S = 1.5
"""And so long for what only some do."""
_STARTS_S = 10.0
"""A preflight check waits this long for an estimate of position: the autopilot may have been switched on just now."""
_NO_ESTIMATE = "Need Position Estimate"
"""Text of an ArduCopter whose estimate is not ready."""
_SETTLED_S = 0.3
"""So long after its checks ran its status is that of these."""
_RATE_HZ = 5.0

_PREARM = 0x10000000
"""MAV_SYS_STATUS_PREARM_CHECK."""
_SENSORS = {
    0x1: "gyroscope",
    0x2: "accelerometer",
    0x4: "magnetometer",
    0x8: "barometer",
    0x20: "GPS",
    0x40: "optical flow",
    0x80: "position by vision",
    0x10000: "remote control",
    0x100000: "fence",
    0x200000: "AHRS",
    0x400000: "terrain",
    0x1000000: "logging",
    0x2000000: "battery",
}
"""Bits of MAV_SYS_STATUS_SENSOR, of those that a person can do something about."""
_PREFIXES = ("PreArm: ", "Preflight Fail: ")
"""What texts that say why it may not be armed begin with: ArduPilot's, PX4's."""

_ATTITUDE, _ACROSS, _UPWARDS, _BLIND = 1, 8 | 16 | 256 | 512, 32 | 64, 128
"""ESTIMATOR_STATUS_FLAGS: attitude; position across, relative or absolute, of now or foreseen; position upwards; none
but a guess that it does not move (CONST_POS_MODE)."""


@dataclass(frozen=True)
class ArmingFault:
    """What speaks against a flight.

    Attributes:
        what: In one sentence without a full stop.
        remedy: What to do about it.
        grave: Whether it is known to; else it may be otherwise in the mode in which it is flown.
    """

    what: str
    remedy: str
    grave: bool = True


class ArmingCheck:
    """Questions to an autopilot that stands, and what it answers.

    Args:
        drone: The autopilot, whose heart was heard.
        needs: What is to be flown.
    """

    def __init__(self, drone: AutopilotState, needs: FlightNeeds) -> None:
        self._drone = drone
        self._needs = needs
        self._began_s = time.monotonic()
        self._asked_s = 0.0
        self._checked_s: float | None = None
        drone.status = drone.estimate = None
        drone.texts.forget()
        drone.answers.pop(PREARM_CHECKS, None)

    def ask(self) -> None:
        """Request what it has not reported yet; to be called with each turn."""
        drone, now_s = self._drone, time.monotonic()
        if self._checked_s is None and PREARM_CHECKS in drone.answers:
            self._checked_s = now_s
        if now_s < self._asked_s or drone.dialect is None:
            return
        self._asked_s = now_s + _AGAIN_S
        for kind, value in ((SYS_STATUS, drone.status), (LOCAL_POSITION_NED, drone.place_m)):
            if value is None:
                drone.request_stream(kind, _RATE_HZ)
        if drone.estimate is None:
            drone.request_stream(drone.dialect.estimate, _RATE_HZ)
        if self._checked_s is None:
            drone.command(PREARM_CHECKS)
        if self._needs.returns and not drone.has_home:
            drone.ask_once(HOME_POSITION)
        for name in self._missing():
            drone.ask_parameter(name)

    def _missing(self) -> list[str]:
        """Return the parameters that it has not told."""
        dialect = self._drone.dialect
        either = [names.split("|") for names in dialect.bounds_from] if dialect else []
        told = self._drone.parameters.keys()
        return [name for names in either if told.isdisjoint(names) for name in names]

    @property
    def is_starting(self) -> bool:
        """Whether its estimate of position is not ready, as within about 30 s after it was switched on."""
        warned = any(_NO_ESTIMATE in text for text in self._drone.texts.warnings)
        return self._drone.dialect is not None and (warned or any(True for _ in self._position()))

    @property
    def done(self) -> bool:
        """Whether it has said all, or had the time to."""
        drone, lasted_s = self._drone, time.monotonic() - self._began_s
        if drone.dialect is None or lasted_s > _PATIENCE_S:
            return True
        if drone.status is None or drone.place_m is None:
            return False
        if lasted_s > _SPARE_S:
            return True
        home = drone.has_home or not self._needs.returns
        checked = self._checked_s is not None and drone.status.heard_s > self._checked_s + _SETTLED_S
        return checked and home and drone.estimate is not None and not self._missing()

    def faults(self) -> Iterator[ArmingFault]:
        """Yield what speaks against the flight."""
        drone = self._drone
        if drone.dialect is None:
            what = "its autopilot is neither PX4 nor ArduCopter ({}, {})".format(*drone.family)
            yield ArmingFault(f"{what}: MAV_AUTOPILOT, MAV_TYPE", "fly it otherwise; a step mavlink records it")
            return
        if drone.armed:
            yield ArmingFault("its motors turn", "land it first")
        yield from self._position()
        yield from self._power()
        yield from self._own_checks()
        yield from self._bounds()

    def _position(self) -> Iterator[ArmingFault]:
        drone = self._drone
        if drone.place_m is None:
            remedy = "wait for its GPS, or see that its camera or flow sensor sees the ground, and that it runs"
            yield ArmingFault("it does not say where it is (LOCAL_POSITION_NED)", remedy)
        flags = drone.estimate
        if flags is not None and not (
            flags & _ATTITUDE and flags & _ACROSS and flags & _UPWARDS and not flags & _BLIND
        ):
            what = f"its estimate of where it is does not hold (flags {flags:#x})"
            yield ArmingFault(what, "wait for its GPS, camera or flow sensor; do not move it meanwhile")
        if self._needs.returns and not drone.has_home:
            what = "it knows no home, and is to return there where the trial is cut short"
            yield ArmingFault(what, "wait for its GPS, or write on_abort: land in the procedure")

    def _power(self) -> Iterator[ArmingFault]:
        status, least = self._drone.status, self._needs.least_charge
        if status is None:
            yield ArmingFault("it does not say how it is (SYS_STATUS)", "see which messages its link lets through")
        elif status.charge is not None and status.charge < least:
            what = f"its battery has {status.charge:.0%}, and {least:.0%} is the least"
            yield ArmingFault(what, "charge it, or put in another; mavlink.least_charge in its profile says how much")

    def _own_checks(self) -> Iterator[ArmingFault]:
        drone = self._drone
        assert drone.dialect is not None
        why = [
            text[len(prefix) :] for text in drone.texts.warnings for prefix in _PREFIXES if text.startswith(prefix)
        ]
        ill = drone.status.ill if drone.status else 0
        if not why and not ill & _PREARM:
            return
        why = (
            list(dict.fromkeys(why)) or drone.texts.warnings or [name for bit, name in _SENSORS.items() if ill & bit]
        )
        what = f"{drone.dialect.name} does not let itself be armed: {', '.join(why) or 'it does not say why'}"
        remedy = "see to that; a ground station (QGroundControl, MAVProxy) shows the same"
        yield ArmingFault(what, remedy, grave=drone.guided or not drone.dialect.says_now)

    def _bounds(self) -> Iterator[ArmingFault]:
        drone, needs = self._drone, self._needs
        assert drone.dialect is not None
        own = drone.dialect.bounds(drone.parameters)
        for most_m, flown_m, what in (
            (own.height_m, needs.highest_m, "high"),
            (own.radius_m, needs.farthest_m, "far from home"),
        ):
            if most_m is not None and flown_m > most_m:
                yield ArmingFault(
                    f"its own fence ends {most_m:g} m {what}, and it is to fly {flown_m:g} m",
                    f"less in the procedure, or a wider fence: {', '.join(drone.dialect.bounds_from)}",
                )
        if needs.returns and own.return_m is not None and own.return_m > needs.ceiling_m:
            what = f"it returns {own.return_m:g} m high, and may fly {needs.ceiling_m:g} m"
            remedy = f"on_abort: land, or a lower {drone.dialect.bounds_from[-1].replace('|', ' or ')}"
            yield ArmingFault(what, f"{remedy}; limits.max_height_m in its profile says how high")


def look(connection: str, needs: FlightNeeds, over: threading.Event) -> int:
    """Ask an autopilot, and print a line of JSON for each fault, and one with its family; return the exit code.

    Raises:
        OSError: The connection cannot be opened.
        ValueError: It is not the name of a connection.
    """
    with closing(AutopilotTalk(connection, component=PREFLIGHT)) as talk:
        end_s = time.monotonic() + _HEARTBEAT_S
        while not talk.drone.alive and not over.is_set():
            if time.monotonic() > end_s:
                sys.stderr.write(f"error: no heartbeat of an autopilot at {connection} in {_HEARTBEAT_S:g} s\n")
                return 1
            talk.turn(_TURN_S)
        check, starts_s = ArmingCheck(talk.drone, needs), time.monotonic() + _STARTS_S
        while not over.is_set():
            check.ask()
            talk.turn(_TURN_S)
            if check.done:
                if not check.is_starting or time.monotonic() > starts_s:
                    break
                check = ArmingCheck(talk.drone, needs)
    dialect, status = talk.drone.dialect, talk.drone.status
    lines = [json.dumps(asdict(fault)) for fault in check.faults()]
    told = {"autopilot": dialect.name if dialect else "", "charge": status.charge if status else None}
    sys.stdout.write("\n".join([*lines, json.dumps(told), ""]))
    return 0
