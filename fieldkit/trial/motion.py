"""The journal of motions: origin of each robot that moves by itself, each motion, and who allowed the next one.

It lies beside the journal of the trial, or of the campaign that the trial is of. It only grows, and each line is on
disk before anything goes on (`fieldkit.core.jsonl`).
"""

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Final

from fieldkit.config.schema import Codec, Field
from fieldkit.core import jsonl, laptop_files
from fieldkit.core.errors import FieldkitError, MotionHeldError, typed
from fieldkit.core.model import MotionOrigin, Placement, Role, Topology
from fieldkit.core.text import brief
from fieldkit.steps.motions import STOPPED
from fieldkit.steps.origins import RobotMotion

MOTION_FILE: Final = laptop_files.MOTION

_FIXED: Final = {Topology.MASTER: Role.RELAY, Topology.MASTERLESS: Role.RECEIVER}
"""The robot that keeps its place when the distance changes (`FieldTestbed.place`)."""


class MotionEvent(StrEnum):
    """What happened to a robot that moves by itself."""

    ORIGIN = "origin"
    BEGUN = "begun"
    ENDED = "ended"
    HELD = "held"
    CONFIRMED = "confirmed"
    ALLOWED = "allowed"


@dataclass(frozen=True)
class MotionEntry:
    """One line of the journal.

    Attributes:
        utc_ns: When, in nanoseconds since 1970 UTC.
        event: `origin`: `origin` holds from now on. `begun`: the robot may move from now on. `ended`: its motion
            ended as it was to end. `held`: a fault stopped it, or it did not start. `confirmed`: a person confirmed
            that it is at its place. `allowed`: the option allowed it to move from where it is.
        robot: Name of the robot.
        place: The place that the origin is of, as `place_of` names it.
        origin: The origin; with `ended`, where the robot was then, if it reported that.
        reason: Why it is held, or how it was confirmed.
    """

    utc_ns: Annotated[int, Field(ge=0, lt=1 << 63)]
    event: MotionEvent
    robot: str
    place: str = ""
    origin: MotionOrigin | None = None
    reason: str = ""


@dataclass(frozen=True)
class MotionHold:
    """Why a robot may not move.

    Attributes:
        robot: Its name.
        reason: What stopped it.
        utc_ns: When, in nanoseconds since 1970 UTC.
    """

    robot: str
    reason: str
    utc_ns: int


_CODEC: Final = Codec(MotionEntry)


def journal_of(trial: Path) -> Path:
    """Return the journal of motions of the trial in a folder: that of its campaign, if it is of one."""
    campaign = trial.parent
    return (campaign if (campaign / laptop_files.CAMPAIGN).is_file() else trial) / MOTION_FILE


def place_of(role: Role, placement: Placement) -> str:
    """Return a name of the place of a robot that is the same in all trials in which people leave it there."""
    if role == _FIXED[placement.topology]:
        return str(placement.topology)
    posts = "".join(f" {post}" for post in placement.posts if post.role == role)
    return f"{placement.topology} {placement.scenario} {placement.distance.metres:g} m{posts}"


def origins(entries: Sequence[MotionEntry]) -> Mapping[str, MotionEntry]:
    """Return the entry of the origin that holds for each robot, by its name; none after a person put it back."""
    known: dict[str, MotionEntry] = {}
    for entry in entries:
        if entry.event is MotionEvent.ORIGIN:
            known[entry.robot] = entry
        elif entry.event is MotionEvent.CONFIRMED:
            known.pop(entry.robot, None)
    return known


def last_places(entries: Sequence[MotionEntry]) -> Mapping[str, MotionOrigin]:
    """Return where each robot was at the end of its last motion, by its name; unknown places are left out."""
    known: dict[str, MotionOrigin] = {}
    for entry in entries:
        if entry.event in {MotionEvent.ENDED, MotionEvent.HELD} and entry.origin is not None:
            known[entry.robot] = entry.origin
        elif entry.event in {MotionEvent.ORIGIN, MotionEvent.BEGUN, MotionEvent.CONFIRMED}:
            known.pop(entry.robot, None)
    return known


def holds(entries: Sequence[MotionEntry]) -> Sequence[MotionHold]:
    """Return why robots may not move; empty if they may. In a motion without an end fieldkit was killed."""
    held: dict[str, MotionHold] = {}
    for entry in entries:
        if entry.event is MotionEvent.BEGUN:
            held[entry.robot] = MotionHold(entry.robot, "fieldkit ended while it moved", entry.utc_ns)
        elif entry.event is MotionEvent.HELD:
            held[entry.robot] = MotionHold(entry.robot, entry.reason, entry.utc_ns)
        elif entry.event is not MotionEvent.ORIGIN:
            held.pop(entry.robot, None)
    return tuple(held.values())


class MotionJournal:
    """The journal of motions in a file; empty if there is none yet.

    Args:
        path: The file.

    Raises:
        EvidenceError: It is damaged.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        jsonl.mend(path, _CODEC.parse)
        self._entries = read(path)

    @property
    def holds(self) -> Sequence[MotionHold]:
        """See the function `holds`."""
        return holds(self._entries)

    @property
    def entries(self) -> Sequence[MotionEntry]:
        """The entries, in the order in which they came."""
        return tuple(self._entries)

    def add(
        self, event: MotionEvent, robot: str, *, place: str = "", origin: MotionOrigin | None = None, reason: str = ""
    ) -> None:
        """Add an entry; raises as `jsonl.append`."""
        entry = MotionEntry(time.time_ns(), event, robot, place, origin, brief(reason))
        jsonl.append(self._path, _CODEC.dump(entry))
        self._entries.append(entry)

    def confirm(self, how: str, *, at_place: bool) -> None:
        """Let robots move again.

        Args:
            how: In words, how it was confirmed.
            at_place: Whether a person confirmed that they are at their places. Their origins are recorded anew then.
        """
        event = MotionEvent.CONFIRMED if at_place else MotionEvent.ALLOWED
        for hold in self.holds:
            self.add(event, hold.robot, reason=how)


def read(path: Path) -> list[MotionEntry]:
    """Return the entries of a journal of motions; none if there is no such file. Raises as `jsonl.read`."""
    return jsonl.read(path, _CODEC.parse, remedy="restore it from a copy") if path.is_file() else []


class KeptOrigins:
    """Origins of the robots of one trial that stay where a motion left them, on disk: see `Origins`.

    Args:
        journal: Where they are recorded.
        folder: The trial, for messages.
        robots: Name of the robot in each role.
        placement: Where they were placed.
        may_return: See `Origins`.
    """

    kept = True

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
        """See `Origins.get`."""
        entry = origins(self._journal.entries).get(self._robots[role])
        return entry.origin if entry is not None and entry.place == self._places[role] else None

    def is_new_place(self, role: Role) -> bool:
        """Return whether the robot's last recorded origin is of another place than the one where it must be now."""
        places = [
            entry.place
            for entry in self._journal.entries
            if entry.event is MotionEvent.ORIGIN and entry.robot == self._robots[role]
        ]
        return bool(places) and places[-1] != self._places[role]

    def last(self, role: Role) -> MotionOrigin | None:
        """See `Origins.last`."""
        return last_places(self._journal.entries).get(self._robots[role])

    def record(self, role: Role, origin: MotionOrigin) -> None:
        """See `Origins.record`."""
        self._journal.add(MotionEvent.ORIGIN, self._robots[role], place=self._places[role], origin=origin)

    def refuse(self, role: Role, why: str) -> None:
        """See `Origins.refuse`."""
        self._journal.add(MotionEvent.HELD, self._robots[role], reason=f"it did not start: {why}")

    def demand(self) -> None:
        """Return if robots may move.

        Raises:
            MotionHeldError: One is held.
        """
        if held := [hold for hold in self._journal.holds if hold.robot not in self._in_motion]:
            raise held_error(held, self._folder)

    @contextmanager
    def moving(self, role: Role) -> Iterator[RobotMotion]:
        """See `Origins.moving`."""
        self.demand()
        name, motion, why = self._robots[role], RobotMotion(), "it stopped on its way"
        self._journal.add(MotionEvent.BEGUN, name)
        self._in_motion.add(name)
        try:
            yield motion
        except BaseException as error:
            why = error.what if isinstance(error, FieldkitError) else type(error).__name__
            if isinstance(error, KeyboardInterrupt):
                why = STOPPED
            raise
        finally:
            self._in_motion.discard(name)
            event = MotionEvent.ENDED if motion.is_over else MotionEvent.HELD
            self._journal.add(event, name, origin=motion.at, reason="" if motion.is_over else why)


def held_error(held: Sequence[MotionHold], folder: Path) -> MotionHeldError:
    """Return the error of robots that may not move before a person has confirmed."""
    robots = "; ".join(f"{hold.robot}: {hold.reason}" for hold in held)
    campaign = folder.parent / laptop_files.CAMPAIGN
    command = "fieldkit campaign, as before" if campaign.is_file() else typed("fieldkit", "resume", folder)
    return MotionHeldError(
        f"a fault stopped a robot, and nothing moves again before a person has confirmed it: {robots}",
        remedy=f"put the robot at its place, see that its way is free, then without --yes: {command}; or, if robots "
        "may move from where they are, --allow-motion-after-fault",
    )
