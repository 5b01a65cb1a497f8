"""Cells of the fault matrix of moving robots, and the behaviour and bounds that follow for each from stated rules.

A cell is a kind of robot, one party or two, a fault and a phase. Its bound is the time within which the fault must be
detected, plus the time in which the robot brakes or comes down then; all of them are constants here.
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
        """Whether it is a drone."""
        return self is not Craft.ROVER


class Blow(StrEnum):
    """What is done to each party of a cell."""

    KILL = "kill"
    PAUSE = "pause"
    SUSPEND = "suspend"
    SLOW = "slow"
    CTRL_C = "ctrl-c"
    STOP = "stop"
    ABORT = "abort"


class Moment(StrEnum):
    """A phase of a drive or of a flight."""

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
"""A paused process continues after this time, and a link carries again."""
DELAY_S: Final = 3.5
"""A slow link delivers each byte this much later, either way: more than a lease."""

DRIVE_LEASE_S: Final = 2.0
FLIGHT_LEASE_S: Final = 3.0
BASE_S: Final = 0.5
"""The base of a ground robot stops this long after the last Twist."""
PEER_S: Final = 1.0
"""Within this time the pilot and the guard of a drone detect that the other does not run."""
SERVER_S: Final = 0.5
"""Within this time a client detects that the link server does not run."""
OPERATOR_S: Final = 1.0
"""Within this time a robot obeys Ctrl-C or `fieldkit stop`."""

RESCUE_S: Final = 1.0
"""Within this time fieldkit detects that neither the pilot nor the guard of a drone runs."""
RESCUE_STARTS_S: Final = 2.0
"""From there to the first command: Python starts on the robot, and the next heartbeat comes, one a second."""

UNHEARD_S: Final = 60.0
"""Programs that bring a drone down end this long after they began, where the autopilot is not heard."""
ENDS_S: Final = 5.0
"""`fieldkit abort` reaches the robot and waits 2 s for its jobs; the link server ends 1 s after its last client."""

ALARM_S: Final = 15.0
"""Within this time fieldkit prints an alarm where a drone may be in the air and nothing of ours brings it down."""

DRIVE_SPEED_M_S: Final = 0.6
DRIVE_ACCELERATION_M_S2: Final = 2.0
FLIGHT_HEIGHT_M: Final = 3.0
LAND_M_S: Final = 0.5
"""The slowest of the land speeds of both autopilots: ArduCopter's LAND_SPEED; PX4's MPC_LAND_SPEED is 0.7 m/s."""

LOAD_S: Final = 0.5
"""Allowed for a busy machine: the programs on the robot are processes of the machine that the matrix runs on."""
TURN_S: Final = 0.1
"""One turn of the loop of a program on the robot, 20 or 10 times a second, and one look at the orders."""
MODE_S: Final = 1.0
"""From the command to descend to a descent of 0.1 m/s: the answer, the mode, braking."""
REST_S: Final = 4.0
"""From the last metre to a drone that is stationary: both autopilots descend more slowly near the ground."""

FENCE_M: Final = MappingProxyType({Craft.ROVER: 30.0, Craft.PX4: 40.0, Craft.COPTER: 40.0})


@dataclass(frozen=True)
class Expectation:
    """What must be seen of a cell in the lab.

    Attributes:
        detected_by: Who detects the fault.
        does: What the robot does.
        begins_s: A ground robot is stationary, or a drone descends, at most this long after the fault; None where it
            may go on.
        ends_s: A drone is on the ground at most this long after the fault; None where it may go on.
        alarm: Whether fieldkit prints an alarm in capitals, unless the drone has landed.
        alarm_s: Within this time fieldkit prints an alarm in any case; None for no such time.
        programs_s: Within this time all programs of fieldkit on the robot have ended; None for no such time.
        judged: Whether the bounds must hold; otherwise nothing on the robot is left that could act, and the cell
            shows what the base or the autopilot does by itself.
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
        parties: Who is hit; the operator acts, and another party may be hit a second before.
        blow: What is done to each.
        moment: In which phase.
    """

    craft: Craft
    parties: tuple[Party, ...]
    blow: Blow
    moment: Moment

    @property
    def name(self) -> str:
        """Name for the command line: robot/parties/fault/phase."""
        return f"{self.craft}/{'+'.join(self.parties)}/{self.blow}/{self.moment}"

    @property
    def routed(self) -> bool:
        """Whether the drone's programs reach their autopilot through a router."""
        return Party.ROUTER in self.parties

    @property
    def cuts_link(self) -> bool:
        """Whether the link of the drone's programs to its autopilot must be lost, and the flight log can show it."""
        struck = {*self.parties} & {Party.ROUTER, Party.SERVER}
        shows = Party.SERVER in struck or Party.PILOT not in self.parties
        return bool(struck) and shows and self.blow is not Blow.SLOW and self.moment not in AT_REST


_CONTROL: Final = {Party.LAPTOP, Party.FIELDKIT, Party.LINK}
_BLOWS: Final = {
    Party.LAPTOP: (Blow.KILL, Blow.PAUSE, Blow.SUSPEND),
    Party.LINK: (Blow.KILL, Blow.PAUSE, Blow.SLOW),  # cut, cut for `PAUSE_S`, delayed
    Party.OPERATOR: (Blow.CTRL_C, Blow.STOP),
}
_ALL_BLOWS: Final = (Blow.KILL, Blow.PAUSE, Blow.SUSPEND, Blow.SLOW)
_PAIR_BLOWS: Final = (Blow.KILL, Blow.PAUSE, Blow.SLOW)


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


def _makes_sense(pair: tuple[Party, Party]) -> bool:
    """Return whether a pair is one: a laptop that is off takes its fieldkit and its end of the link with it."""
    return not (Party.LAPTOP in pair and _CONTROL & {*pair} - {Party.LAPTOP}) and Party.OPERATOR not in pair


def _all_cells() -> tuple[MotionCell, ...]:
    found = []
    lost = (Party.PILOT, Party.GUARD)
    for craft in Craft:
        moments = FLIGHT_MOMENTS if craft.flies else DRIVE_MOMENTS
        parties = _parties(craft)
        for party in parties:
            blows = _BLOWS.get(party, _ALL_BLOWS)
            found += [MotionCell(craft, (party,), blow, moment) for blow, moment in product(blows, moments)]
        # `fieldkit stop` where the fieldkit of the trial is suspended.
        found += [MotionCell(craft, (Party.FIELDKIT, Party.OPERATOR), Blow.STOP, moment) for moment in moments]
        pairs = list(filter(_makes_sense, combinations(parties, 2)))
        if craft is Craft.PX4:  # others act on our programs, which are the same for both autopilots
            pairs = [(Party.PILOT, Party.GUARD)]
        for pair in pairs:
            for blow, moment in product(_PAIR_BLOWS, moments):
                if all(blow in _BLOWS.get(party, _ALL_BLOWS) for party in pair):
                    found.append(MotionCell(craft, pair, blow, moment))
        if craft.flies:  # what fieldkit alone can detect
            found += [MotionCell(craft, lost, Blow.SUSPEND, moment) for moment in moments]
            three = (*lost, Party.SERVER)
            found += [MotionCell(craft, three, *of) for of in product((Blow.KILL, Blow.SUSPEND), moments)]
            # The router is killed, then a person runs `fieldkit abort`.
            dead = (Party.ROUTER, Party.OPERATOR)
            found += [MotionCell(craft, dead, Blow.ABORT, moment) for moment in (Moment.FLYING, Moment.THERE)]
    return tuple(found)


CELLS: Final = _all_cells()


def chosen(patterns: str) -> list[MotionCell]:
    """Return the cells whose names match one of some patterns, with commas between them, as in a shell.

    Raises:
        ValueError: A pattern matches no cell.
    """
    found: dict[MotionCell, None] = {}
    for pattern in patterns.split(","):
        matches = [cell for cell in CELLS if fnmatch(cell.name, pattern)]
        if not matches:
            raise ValueError(f"no cell matches {pattern}")
        found |= dict.fromkeys(matches)
    return list(found)


def expected(cell: MotionCell) -> Expectation:
    """Return what must be seen of a cell."""
    if cell.moment in AT_REST and not _CONTROL & {*cell.parties} and Party.OPERATOR not in cell.parties:
        # Nothing has moved yet, so that no fault has stopped a motion: fieldkit may begin another attempt.
        return Expectation("fieldkit", "does not start, or anew", None)
    return _of_flight(cell) if cell.craft.flies else _of_drive(cell)


def _of_drive(cell: MotionCell) -> Expectation:
    brakes_s = DRIVE_SPEED_M_S / DRIVE_ACCELERATION_M_S2 + TURN_S + LOAD_S
    lease_s = DRIVE_LEASE_S + brakes_s
    if Party.OPERATOR in cell.parties:
        return Expectation("operator", "stops, stays", OPERATOR_S + brakes_s)
    if cell.blow is Blow.SLOW and Party.LINK not in cell.parties:
        return Expectation("", "may go on, or stops", None)
    if Party.AGENT in cell.parties and cell.blow is not Blow.SLOW:
        return Expectation("base: no Twists", "stops, stays", BASE_S + brakes_s)
    return Expectation("agent: lease", "stops, stays", lease_s)


def _of_flight(cell: MotionCell) -> Expectation:
    parties = {*cell.parties}
    paused_s = PAUSE_S if cell.blow is Blow.PAUSE else 0.0
    heard = not parties & _CONTROL  # fieldkit runs, and reaches the drone
    later_s = (SERVER_S if Party.SERVER in parties else 0.0) + (paused_s if Party.ROUTER in parties else 0.0)
    if cell.blow is Blow.ABORT:
        does, ends_s = "what the autopilot does", UNHEARD_S + ENDS_S + LOAD_S
        wants = Expectation("pilot, guard", does, None, alarm=True, judged=False, programs_s=ends_s)
    elif Party.OPERATOR in parties:
        wants = _lands("operator", OPERATOR_S)
    elif (cell.blow is Blow.SLOW and Party.LINK not in parties) or parties == {Party.SERVER}:
        wants = Expectation("clients: a new server" if Party.SERVER in parties else "", "may go on, or lands", None)
    elif parties >= {Party.PILOT, Party.GUARD}:
        wants = _lands("fieldkit", RESCUE_S + RESCUE_STARTS_S + later_s, alarm_s=RESCUE_S + LOAD_S)
    elif Party.ROUTER in parties and cell.blow is not Blow.PAUSE:
        # Nothing of ours on the drone reaches the autopilot any more.
        by = "fieldkit: no log" if heard else "autopilot"
        wants = Expectation(by, "what the autopilot does", None, None, alarm=heard, judged=False)
    elif parties & {Party.PILOT, Party.GUARD}:
        wants = _lands("guard" if Party.PILOT in parties else "pilot", PEER_S + later_s, alarm=heard)
    elif parties & _CONTROL:
        wants = _lands("pilot: lease", FLIGHT_LEASE_S + later_s)
    else:
        wants = _lands("pilot: autopilot silent", FLIGHT_LEASE_S + later_s)
    return wants


def _lands(by: str, within_s: float, *, alarm: bool = False, alarm_s: float | None = None) -> Expectation:
    """Return the expectation of a drone that comes down where somebody has detected the fault within a time."""
    begins_s = within_s + MODE_S + TURN_S + LOAD_S
    ends_s = begins_s + FLIGHT_HEIGHT_M / LAND_M_S + REST_S
    return Expectation(by, "descends, lands", begins_s, ends_s, alarm, alarm_s=alarm_s)
