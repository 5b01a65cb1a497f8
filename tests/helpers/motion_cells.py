"""Cells of the fault matrix of moving robots, and rules for their expected behaviour and time limits.

A cell is a kind of robot, one or more parties, a fault and a phase. The limit is the time within which the fault must
be detected, plus the time in which the robot then brakes or lands; all these times are constants in this module.
"""

from dataclasses import dataclass
from enum import StrEnum
from fnmatch import fnmatch
from itertools import combinations, product
from types import MappingProxyType
from typing import Final

from tests.helpers.motion_parties import Party


class Craft(StrEnum):
    """A kind of robot."""

    ROVER = "rover"
    PX4 = "px4"
    COPTER = "copter"

    @property
    def flies(self) -> bool:
        """True if the robot is a drone."""
        return self is not Craft.ROVER


class InjectedFault(StrEnum):
    """The fault that is applied to each party of a cell."""

    KILL = "kill"
    PAUSE = "pause"
    SUSPEND = "suspend"
    SLOW = "slow"
    CTRL_C = "ctrl-c"
    STOP = "stop"
    ABORT = "abort"


class Moment(StrEnum):
    """A phase of a drive or a flight."""

    WAITING = "waiting"
    OUT = "out"
    THERE = "there"
    BACK = "back"
    GROUND = "ground"
    CLIMBING = "climbing"
    FLYING = "flying"
    LANDING = "landing"


DRIVE_MOMENTS: Final = (Moment.WAITING, Moment.OUT, Moment.THERE, Moment.BACK)
FLIGHT_MOMENTS: Final = (
    Moment.GROUND,
    Moment.CLIMBING,
    Moment.FLYING,
    Moment.THERE,
    Moment.BACK,
    Moment.LANDING,
)

AT_REST: Final = (Moment.WAITING, Moment.GROUND)
"""Phases before the first motion."""

PAUSE_S: Final = 6.0
"""After this time, a paused process continues and a cut link is restored."""
DELAY_S: Final = 3.5
"""Additional delay of a slow link in each direction, longer than a lease."""

DRIVE_LEASE_S: Final = 2.0
FLIGHT_LEASE_S: Final = 3.0
BASE_S: Final = 0.5
"""Time after the last Twist at which the base of a ground robot stops the robot."""
PEER_S: Final = 1.0
"""Time within which the pilot and the guard of a drone detect that the other does not run."""
SERVER_S: Final = 0.5
"""Time within which a client detects that the link server does not run."""
OPERATOR_S: Final = 1.0
"""Time within which a robot obeys Ctrl-C or `fieldkit stop`."""

RESCUE_S: Final = 1.0
"""Time within which fieldkit detects that neither the pilot nor the guard of a drone runs."""
RESCUE_STARTS_S: Final = 2.0
"""Time from the detection to the first command: Python starts on the robot and receives a heartbeat, sent at 1 Hz."""

NO_HEARTBEAT_S: Final = 60.0
"""Time after which programs that land a drone exit if they receive nothing from the autopilot."""
ENDS_S: Final = 5.0
"""`fieldkit abort` reaches the robot and waits 2 s for its jobs; the link server exits 1 s after its last client."""

ALARM_S: Final = 15.0
"""Time within which fieldkit prints an alarm if a drone may be in the air and no program of fieldkit lands it."""

DRIVE_SPEED_M_S: Final = 0.6
DRIVE_ACCELERATION_M_S2: Final = 2.0
FLIGHT_HEIGHT_M: Final = 3.0
LAND_M_S: Final = 0.5
"""The lower landing speed of the two autopilots, LAND_SPEED of ArduCopter; MPC_LAND_SPEED of PX4 is 0.7 m/s."""

LOAD_S: Final = 0.5
"""Additional time for load, because the programs of the robot run on the same machine as the matrix."""
TURN_S: Final = 0.1
"""One loop iteration of a program on the robot, at 20 or 10 Hz, and one check of the stored commands."""
MODE_S: Final = 1.0
"""Time from the command to descend to a descent of 0.1 m/s: acknowledgement, mode change and braking."""
REST_S: Final = 4.0
"""Time from the last metre to a stationary drone: both autopilots descend more slowly near the ground."""

FENCE_M: Final = MappingProxyType({Craft.ROVER: 30.0, Craft.PX4: 40.0, Craft.COPTER: 40.0})


@dataclass(frozen=True)
class Expectation:
    """The expected observations of a cell in the lab.

    Attributes:
        detected_by: The program that detects the fault.
        does: The behaviour of the robot.
        begins_s: Time limit after the fault for a ground robot to be stationary or for a drone to descend; None if it
            may continue.
        ends_s: Time limit after the fault for a drone to be on the ground; None if it may continue.
        alarm: True if fieldkit prints an alarm in capitals, unless the drone has landed.
        alarm_s: Time limit for the alarm, even if the drone lands; None for no limit.
        programs_s: Time limit for all programs of fieldkit on the robot to exit; None for no limit.
        judged: True if the limits must be met; False if no program on the robot can act, and the cell only shows the
            behaviour of the base or the autopilot.
    """

    detected_by: str
    does: str
    begins_s: float | None
    ends_s: float | None = None
    alarm: bool = False
    judged: bool = True
    alarm_s: float | None = None
    programs_s: float | None = None


@dataclass(frozen=True)
class MotionCell:
    """A cell of the matrix.

    Attributes:
        craft: The kind of robot.
        parties: The affected parties; the operator acts, and another party may be affected one second earlier.
        fault: The fault of each party.
        moment: The phase.
    """

    craft: Craft
    parties: tuple[Party, ...]
    fault: InjectedFault
    moment: Moment

    @property
    def name(self) -> str:
        """Name on the command line: robot/parties/fault/phase."""
        return f"{self.craft}/{'+'.join(self.parties)}/{self.fault}/{self.moment}"

    @property
    def routed(self) -> bool:
        """True if the drone's programs reach the autopilot through a router."""
        return Party.ROUTER in self.parties

    @property
    def cuts_link(self) -> bool:
        """True if the programs must lose their link to the autopilot and the flight log can show the loss."""
        link_parties = {*self.parties} & {Party.ROUTER, Party.SERVER}
        is_logged = Party.SERVER in link_parties or Party.PILOT not in self.parties
        return (
            bool(link_parties) and is_logged and self.fault is not InjectedFault.SLOW and self.moment not in AT_REST
        )


_CONTROL: Final = {Party.LAPTOP, Party.FIELDKIT, Party.LINK}
_PARTY_FAULTS: Final = {
    Party.LAPTOP: (InjectedFault.KILL, InjectedFault.PAUSE, InjectedFault.SUSPEND),
    Party.LINK: (InjectedFault.KILL, InjectedFault.PAUSE, InjectedFault.SLOW),  # cut, cut for `PAUSE_S`, delayed
    Party.OPERATOR: (InjectedFault.CTRL_C, InjectedFault.STOP),
}
_ALL_FAULTS: Final = (InjectedFault.KILL, InjectedFault.PAUSE, InjectedFault.SUSPEND, InjectedFault.SLOW)
_PAIR_FAULTS: Final = (InjectedFault.KILL, InjectedFault.PAUSE, InjectedFault.SLOW)


def _parties(craft: Craft) -> tuple[Party, ...]:
    if craft.flies:
        return (
            Party.LAPTOP,
            Party.FIELDKIT,
            Party.LINK,
            Party.PILOT,
            Party.GUARD,
            Party.SERVER,
            Party.ROUTER,
            Party.OPERATOR,
        )
    return (Party.LAPTOP, Party.FIELDKIT, Party.LINK, Party.AGENT, Party.OPERATOR)


def _is_valid_pair(pair: tuple[Party, Party]) -> bool:
    """Return True if the pair can occur. A laptop that is off also stops its fieldkit and its end of the link."""
    return not (Party.LAPTOP in pair and _CONTROL & {*pair} - {Party.LAPTOP}) and Party.OPERATOR not in pair


def _all_cells() -> tuple[MotionCell, ...]:
    cells = []
    flight_programs = (Party.PILOT, Party.GUARD)
    for craft in Craft:
        moments = FLIGHT_MOMENTS if craft.flies else DRIVE_MOMENTS
        parties = _parties(craft)
        for party in parties:
            faults = _PARTY_FAULTS.get(party, _ALL_FAULTS)
            cells += [MotionCell(craft, (party,), fault, moment) for fault, moment in product(faults, moments)]
        # `fieldkit stop` while the fieldkit process of the trial is suspended.
        cells += [
            MotionCell(craft, (Party.FIELDKIT, Party.OPERATOR), InjectedFault.STOP, moment) for moment in moments
        ]
        pairs = list(filter(_is_valid_pair, combinations(parties, 2)))
        if craft is Craft.PX4:  # other faults affect only programs that are the same for both autopilots
            pairs = [(Party.PILOT, Party.GUARD)]
        for pair in pairs:
            for fault, moment in product(_PAIR_FAULTS, moments):
                if all(fault in _PARTY_FAULTS.get(party, _ALL_FAULTS) for party in pair):
                    cells.append(MotionCell(craft, pair, fault, moment))
        if craft.flies:  # only fieldkit can detect these faults
            cells += [MotionCell(craft, flight_programs, InjectedFault.SUSPEND, moment) for moment in moments]
            drone_programs = (*flight_programs, Party.SERVER)
            cells += [
                MotionCell(craft, drone_programs, *fault_and_moment)
                for fault_and_moment in product((InjectedFault.KILL, InjectedFault.SUSPEND), moments)
            ]
            # The router is killed, and then a person runs `fieldkit abort`.
            router_and_operator = (Party.ROUTER, Party.OPERATOR)
            cells += [
                MotionCell(craft, router_and_operator, InjectedFault.ABORT, moment)
                for moment in (Moment.FLYING, Moment.THERE)
            ]
    return tuple(cells)


CELLS: Final = _all_cells()


def select_cells(patterns: str) -> list[MotionCell]:
    """The cells whose names match at least one of the comma-separated shell patterns.

    Raises:
        ValueError: A pattern matches no cell.
    """
    selected: dict[MotionCell, None] = {}
    for pattern in patterns.split(","):
        matches = [cell for cell in CELLS if fnmatch(cell.name, pattern)]
        if not matches:
            raise ValueError(f"no cell matches {pattern}")
        selected |= dict.fromkeys(matches)
    return list(selected)


def expected(cell: MotionCell) -> Expectation:
    """The expected observations of a cell."""
    if cell.moment in AT_REST and not _CONTROL & {*cell.parties} and Party.OPERATOR not in cell.parties:
        # The robot has not moved, so the fault stops no motion, and fieldkit may start another attempt.
        return Expectation("fieldkit", "does not start, or restarts", None)
    return _flight_expectation(cell) if cell.craft.flies else _drive_expectation(cell)


def _drive_expectation(cell: MotionCell) -> Expectation:
    brakes_s = DRIVE_SPEED_M_S / DRIVE_ACCELERATION_M_S2 + TURN_S + LOAD_S
    lease_s = DRIVE_LEASE_S + brakes_s
    if Party.OPERATOR in cell.parties:
        return Expectation("operator", "stops, stays", OPERATOR_S + brakes_s)
    if cell.fault is InjectedFault.SLOW and Party.LINK not in cell.parties:
        return Expectation("", "may continue, or stops", None)
    if Party.AGENT in cell.parties and cell.fault is not InjectedFault.SLOW:
        return Expectation("base: no Twists", "stops, stays", BASE_S + brakes_s)
    return Expectation("agent: lease", "stops, stays", lease_s)


def _flight_expectation(cell: MotionCell) -> Expectation:
    parties = {*cell.parties}
    paused_s = PAUSE_S if cell.fault is InjectedFault.PAUSE else 0.0
    has_control_link = not parties & _CONTROL  # fieldkit runs and reaches the drone
    delay_s = (SERVER_S if Party.SERVER in parties else 0.0) + (paused_s if Party.ROUTER in parties else 0.0)
    if cell.fault is InjectedFault.ABORT:
        does, ends_s = "behaviour of the autopilot", NO_HEARTBEAT_S + ENDS_S + LOAD_S
        expectation = Expectation("pilot, guard", does, None, alarm=True, judged=False, programs_s=ends_s)
    elif Party.OPERATOR in parties:
        expectation = _lands("operator", OPERATOR_S)
    elif (cell.fault is InjectedFault.SLOW and Party.LINK not in parties) or parties == {Party.SERVER}:
        expectation = Expectation(
            "clients: a new server" if Party.SERVER in parties else "", "may continue, or lands", None
        )
    elif parties >= {Party.PILOT, Party.GUARD}:
        expectation = _lands("fieldkit", RESCUE_S + RESCUE_STARTS_S + delay_s, alarm_s=RESCUE_S + LOAD_S)
    elif Party.ROUTER in parties and cell.fault is not InjectedFault.PAUSE:
        # No program on the drone reaches the autopilot any more.
        detected_by = "fieldkit: no log" if has_control_link else "autopilot"
        expectation = Expectation(
            detected_by, "behaviour of the autopilot", None, None, alarm=has_control_link, judged=False
        )
    elif parties & {Party.PILOT, Party.GUARD}:
        expectation = _lands("guard" if Party.PILOT in parties else "pilot", PEER_S + delay_s, alarm=has_control_link)
    elif parties & _CONTROL:
        expectation = _lands("pilot: lease", FLIGHT_LEASE_S + delay_s)
    else:
        expectation = _lands("pilot: autopilot silent", FLIGHT_LEASE_S + delay_s)
    return expectation


def _lands(detected_by: str, within_s: float, *, alarm: bool = False, alarm_s: float | None = None) -> Expectation:
    """The expectation of a drone that lands; the fault is detected within `within_s`."""
    begins_s = within_s + MODE_S + TURN_S + LOAD_S
    ends_s = begins_s + FLIGHT_HEIGHT_M / LAND_M_S + REST_S
    return Expectation(detected_by, "descends, lands", begins_s, ends_s, alarm, alarm_s=alarm_s)
