"""The journal of motions: the origin of each self-moving robot, each motion, and each permission after a fault.

The origin is the position and heading at the first start. The journal is stored next to the journal of the trial, or
of the campaign that the trial belongs to. It is append-only, and each line is synced to disk before the program
continues (`fieldkit.core.jsonl`).
"""

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Final

from fieldkit.config.json_records import Codec
from fieldkit.config.schema import Field
from fieldkit.core import jsonl, laptop_files
from fieldkit.core.errors import FieldkitError, MotionHeldError, shell_command
from fieldkit.core.model import Placement, Role, Topology
from fieldkit.core.text import shorten
from fieldkit.motion.origins import MotionOrigin, RobotMotion
from fieldkit.steps.motions import STOPPED

MOTION_FILE: Final = laptop_files.MOTION

_FIXED: Final = {Topology.MASTER: Role.RELAY, Topology.MASTERLESS: Role.RECEIVER}
"""The robot that stays at its place when the distance changes (`FieldTestbed.place`)."""


class MotionEvent(StrEnum):
    """Event of a robot that moves automatically."""

    ORIGIN = "origin"
    STARTED = "begun"
    ENDED = "ended"
    HELD = "held"
    CONFIRMED = "confirmed"
    ALLOWED = "allowed"


@dataclass(frozen=True)
class MotionEntry:
    """One line of the journal.

    Attributes:
        utc_ns: Time of the entry, in nanoseconds since 1970 UTC.
        event: `origin`: the origin in this entry is valid from now on. `begun`: the robot may move from now on.
            `ended`: its motion ended as planned. `held`: a fault stopped it, or it did not start. `confirmed`: a
            person confirmed that it is at its place. `allowed`: an option allowed it to move from its current
            position.
        robot: Name of the robot.
        place: Name of the place of the origin, from `place_of`; empty for other events.
        origin: The origin; for `ended` and `held`, the robot's position at the end, if it reported one; None for
            other events.
        reason: Reason why it is held, or how it was confirmed or allowed; empty for other events.
    """

    utc_ns: Annotated[int, Field(ge=0, lt=1 << 63)]
    event: MotionEvent
    robot: str
    place: str = ""
    origin: MotionOrigin | None = None
    reason: str = ""


@dataclass(frozen=True)
class MotionHold:
    """A robot that may not move, and the reason.

    Attributes:
        robot: Name of the robot.
        reason: Cause of the stop.
        utc_ns: Time of the stop, or of the start of a motion without an end, in nanoseconds since 1970 UTC.
    """

    robot: str
    reason: str
    utc_ns: int


_CODEC: Final = Codec(MotionEntry)


def journal_of(trial: Path) -> Path:
    """Return the path of the journal of motions: in the folder of the campaign if there is one, else of the trial."""
    campaign = trial.parent
    return (campaign if (campaign / laptop_files.CAMPAIGN).is_file() else trial) / MOTION_FILE


def place_of(role: Role, placement: Placement) -> str:
    """Return the name of a robot's place; it is the same in all trials in which the robot stays there."""
    if role == _FIXED[placement.topology]:
        return str(placement.topology)
    posts = "".join(f" {post}" for post in placement.posts if post.role == role)
    return f"{placement.topology} {placement.scenario} {placement.distance.metres:g} m{posts}"


def origins(entries: Sequence[MotionEntry]) -> Mapping[str, MotionEntry]:
    """Return the entry with the valid origin of each robot, by name. A confirmation by a person ends its validity."""
    by_robot: dict[str, MotionEntry] = {}
    for entry in entries:
        if entry.event is MotionEvent.ORIGIN:
            by_robot[entry.robot] = entry
        elif entry.event is MotionEvent.CONFIRMED:
            by_robot.pop(entry.robot, None)
    return by_robot


def last_places(entries: Sequence[MotionEntry]) -> Mapping[str, MotionOrigin]:
    """Return the position of each robot at the end of its last motion, by name.

    Positions are omitted if the robot did not report them, and after a new start or a confirmation by a person.
    """
    by_robot: dict[str, MotionOrigin] = {}
    for entry in entries:
        if entry.event in {MotionEvent.ENDED, MotionEvent.HELD} and entry.origin is not None:
            by_robot[entry.robot] = entry.origin
        elif entry.event in {MotionEvent.ORIGIN, MotionEvent.STARTED, MotionEvent.CONFIRMED}:
            by_robot.pop(entry.robot, None)
    return by_robot


def holds(entries: Sequence[MotionEntry]) -> Sequence[MotionHold]:
    """Return the robots that may not move; a motion without an end is in progress, or fieldkit was killed in it."""
    by_robot: dict[str, MotionHold] = {}
    for entry in entries:
        if entry.event is MotionEvent.STARTED:
            by_robot[entry.robot] = MotionHold(entry.robot, "fieldkit stopped while it moved", entry.utc_ns)
        elif entry.event is MotionEvent.HELD:
            by_robot[entry.robot] = MotionHold(entry.robot, entry.reason, entry.utc_ns)
        elif entry.event is not MotionEvent.ORIGIN:
            by_robot.pop(entry.robot, None)
    return tuple(by_robot.values())


class MotionJournal:
    """The journal of motions in a file; empty if the file does not exist.

    Args:
        path: The file. An incomplete last line that a crash left is removed.

    Raises:
        EvidenceError: Another line of the file is damaged.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        jsonl.repair_last_line(path, _CODEC.parse)
        self._entries = read(path)

    @property
    def holds(self) -> Sequence[MotionHold]:
        """The robots that may not move; see the function `holds`."""
        return holds(self._entries)

    @property
    def entries(self) -> Sequence[MotionEntry]:
        """The entries in order."""
        return tuple(self._entries)

    def add(
        self, event: MotionEvent, robot: str, *, place: str = "", origin: MotionOrigin | None = None, reason: str = ""
    ) -> None:
        """Add an entry. Raises the same errors as `jsonl.append`."""
        entry = MotionEntry(time.time_ns(), event, robot, place, origin, shorten(reason))
        jsonl.append(self._path, _CODEC.dump(entry))
        self._entries.append(entry)

    def confirm(self, confirmation: str, *, at_place: bool) -> None:
        """Allow the held robots to move again.

        Args:
            confirmation: Description of the confirmation.
            at_place: Whether a person confirmed that the robots are at their places; new origins are then recorded.
        """
        event = MotionEvent.CONFIRMED if at_place else MotionEvent.ALLOWED
        for hold in self.holds:
            self.add(event, hold.robot, reason=confirmation)


def read(path: Path) -> list[MotionEntry]:
    """Return the entries of a journal of motions; empty if there is no file.

    Raises the same errors as `jsonl.read`.
    """
    return jsonl.read(path, _CODEC.parse, remedy="restore it from a copy") if path.is_file() else []


class JournaledOrigins:
    """Implements `Origins` with a journal on disk, for robots that stay where a motion ended.

    Args:
        journal: The journal of motions.
        folder: Folder of the trial, for messages.
        robots: Name of the robot in each role.
        placement: The placement of the trial.
        may_return: Whether a robot may drive back to its origin; see `Origins`.
    """

    robots_stay = True

    def __init__(
        self,
        journal: MotionJournal,
        folder: Path,
        robots: Mapping[Role, str],
        placement: Placement,
        *,
        may_return: bool = False,
    ) -> None:
        self.may_return = may_return
        self._in_motion: set[str] = set()
        self._journal = journal
        self._folder = folder
        self._robots = robots
        self._places = {role: place_of(role, placement) for role in robots}

    def get(self, role: Role) -> MotionOrigin | None:
        """Return the recorded origin of a robot at its current place, or None if no origin is valid there."""
        entry = origins(self._journal.entries).get(self._robots[role])
        return entry.origin if entry is not None and entry.place == self._places[role] else None

    def is_new_place(self, role: Role) -> bool:
        """Return True if the last recorded origin is at another place than the robot's place in this trial.

        False if no origin of the robot is recorded.
        """
        places = [
            entry.place
            for entry in self._journal.entries
            if entry.event is MotionEvent.ORIGIN and entry.robot == self._robots[role]
        ]
        return bool(places) and places[-1] != self._places[role]

    def last(self, role: Role) -> MotionOrigin | None:
        """Return the position of a robot at the end of its last motion, or None if it is unknown."""
        return last_places(self._journal.entries).get(self._robots[role])

    def record(self, role: Role, origin: MotionOrigin) -> None:
        """Record the origin of a robot."""
        self._journal.add(MotionEvent.ORIGIN, self._robots[role], place=self._places[role], origin=origin)

    def refuse(self, role: Role, reason: str) -> None:
        """Record that a motion did not start, so that the robot is held."""
        self._journal.add(MotionEvent.HELD, self._robots[role], reason=f"it did not start: {reason}")

    def require(self) -> None:
        """Check that no robot is held, except robots in motion, whose motion has no end yet.

        Raises:
            MotionHeldError: A robot is held.
        """
        if holds_of_others := [hold for hold in self._journal.holds if hold.robot not in self._in_motion]:
            raise hold_error(holds_of_others, self._folder)

    @contextmanager
    def moving(self, role: Role) -> Iterator[RobotMotion]:
        """Record start and end of a motion. If the motion is not over when the body ends, the robot is held."""
        self.require()
        name, motion, reason = self._robots[role], RobotMotion(), "it stopped on its path"
        self._journal.add(MotionEvent.STARTED, name)
        self._in_motion.add(name)
        try:
            yield motion
        except BaseException as error:
            reason = error.what if isinstance(error, FieldkitError) else type(error).__name__
            if isinstance(error, KeyboardInterrupt):
                reason = STOPPED
            raise
        finally:
            self._in_motion.discard(name)
            event = MotionEvent.ENDED if motion.is_over else MotionEvent.HELD
            self._journal.add(event, name, origin=motion.at, reason="" if motion.is_over else reason)


def hold_error(robot_holds: Sequence[MotionHold], folder: Path) -> MotionHeldError:
    """Return the error for robots that must not move until a person confirms."""
    robots = "; ".join(f"{hold.robot}: {hold.reason}" for hold in robot_holds)
    campaign = folder.parent / laptop_files.CAMPAIGN
    command = (
        "the same fieldkit campaign command" if campaign.is_file() else shell_command("fieldkit", "resume", folder)
    )
    return MotionHeldError(
        f"a fault stopped a robot, and no robot moves until a person confirms: {robots}",
        remedy=f"put the robot at its place, check that its path is free, then run without --yes: {command}; or add "
        "--allow-motion-after-fault, if robots may move from their current positions",
    )
