"""Differences between the emulated firmware families: modes, parameters, messages, refusals."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from sim_backends.emulated.autopilot.failsafes import Failsafes
from sim_backends.emulated.autopilot.mavlink_frames import dialect
from sim_backends.emulated.autopilot.modes import Mode
from sim_backends.emulated.autopilot.onboard_estimates import Battery
from sim_backends.emulated.autopilot.parameters import FlightLimits, Parameter, Parameters


@dataclass(frozen=True)
class StreamGroup:
    """A group of messages whose rate one parameter sets (SRn_* of ArduPilot).

    Attributes:
        number: MAV_DATA_STREAM of REQUEST_DATA_STREAM.
        parameter: Name of the parameter, Hz.
        messages: Ids of the messages.
    """

    number: int
    parameter: str
    messages: tuple[int, ...]


@dataclass(frozen=True)
class ModeConditions:
    """The state of a vehicle that determines whether a firmware accepts a change of mode.

    Attributes:
        is_armed: True if its motors turn.
        has_landed: True if it has detected that it is on the ground.
        on_ground: True if it is on the ground.
        mission_commands: MAV_CMD of each item of its mission.
        has_recent_set_point: True if its last set-point is recent enough.
    """

    is_armed: bool
    has_landed: bool
    on_ground: bool
    mission_commands: Sequence[int]
    has_recent_set_point: bool


class ModeRefusal(NamedTuple):
    """A refused change of mode.

    Attributes:
        text: Text of the refusal.
        reason: Text with the reason, which is sent before `text`; empty if the firmware sends only `text`.
    """

    text: str
    reason: str = ""


@dataclass(frozen=True)
class Firmware:
    """A family of autopilots.

    Attributes:
        autopilot: Its constant of MAV_AUTOPILOT.
        version: AUTOPILOT_VERSION.flight_sw_version: major, minor, patch, type.
        capabilities: The bits of MAV_PROTOCOL_CAPABILITY that it reports.
        base_mode: Constant MAV_MODE_FLAG bits of its heartbeat.
        modes: Number of each mode, as in `custom_mode` of HEARTBEAT.
        names: Name of each mode in AVAILABLE_MODES.
        starting_flags: Flags of its position estimate before the estimate has an origin.
        boot_mode: Mode after power-on.
        modes_without_arming: Modes in which it cannot be armed.
        refusal_result: MAV_RESULT of a command that it refuses in its current state.
        unknown_mode: MAV_RESULT of a change to a mode that it does not have.
        unknown_rate: MAV_RESULT of MAV_CMD_SET_MESSAGE_INTERVAL for a message that it does not send.
        unknown_message: MAV_RESULT of MAV_CMD_REQUEST_MESSAGE for a message that it does not send.
        mode_refusal: Returns the refusal of a change of mode; None if it is accepted.
        prearm_prefixes: Prefixes of texts with reasons against arming: in answers to MAV_CMD_RUN_PREARM_CHECKS, and
            after a refused command to arm.
        arming_errors: Returns the reasons against arming.
        parameters: Returns its parameters, within the limits of a profile.
        failsafes: Creates its failsafes.
        streams_hz: Default rates of messages on a telemetry port.
        groups: Groups of messages whose rates are set by parameters and REQUEST_DATA_STREAM; empty if the firmware
            has no such groups.
        spool_s: Time from arming to the earliest lift-off.
        landed_s: Time on the ground after which it detects its landing.
        fix_type: GPS_FIX_TYPE with a good receiver.
        holds_without_set_points: True if the vehicle holds its position when it is in mode OFFBOARD and set-points
            are missing.
        set_points_lift_off: True if the vehicle lifts off when it receives set-points.
        first_item: Number of the first item of a mission that the vehicle executes; ArduPilot's item 0 is home.
    """

    autopilot: int
    version: int
    capabilities: int
    base_mode: int
    modes: Mapping[Mode, int]
    names: Mapping[Mode, str]
    starting_flags: int
    boot_mode: Mode
    modes_without_arming: frozenset[Mode]
    refusal_result: int
    unknown_mode: int
    unknown_rate: int
    unknown_message: int
    mode_refusal: Callable[[Mode, ModeConditions], ModeRefusal | None]
    prearm_prefixes: tuple[str, str]
    arming_errors: Callable[[Parameters, Battery], list[str]]
    parameters: Callable[[FlightLimits], tuple[Parameter, ...]]
    failsafes: Callable[[Parameters], Failsafes]
    streams_hz: Mapping[int, float]
    groups: tuple[StreamGroup, ...]
    spool_s: float
    landed_s: float
    fix_type: int
    holds_without_set_points: bool
    set_points_lift_off: bool
    first_item: int

    @property
    def is_ardupilot(self) -> bool:
        """True if it is ArduPilot."""
        return bool(self.autopilot == dialect.MAV_AUTOPILOT_ARDUPILOTMEGA)

    def mode_of(self, custom_mode: int) -> Mode | None:
        """Return the first of `modes` with a custom mode number, or None if the firmware has no such mode."""
        return next((mode for mode, number in self.modes.items() if number == custom_mode), None)
