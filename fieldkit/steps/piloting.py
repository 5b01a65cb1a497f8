"""Drones on the laptop's side: the programs on the robot that fly one and guard one, and their leases.

The programs are the agent's (`fieldkit.agent.flight`, `fieldkit.agent.flying.guard`). Where this process is killed,
or the control link is cut for longer than the lease, they bring the drone down.
"""

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from typing import Any, Final

from typing_extensions import override

from fieldkit.agent.flight_plan import LEAVE, MISPLACED, STAY, FlightPlan
from fieldkit.backends.protocols import Robot
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Control, MotionOrigin, OnAbort, Role
from fieldkit.core.text import JSON_ERRORS, brief
from fieldkit.remote import jobs
from fieldkit.remote.jobs import Job
from fieldkit.remote.shell import Shell
from fieldkit.steps import lease, streams
from fieldkit.steps.lease import HeldLease, orders_file
from fieldkit.steps.motions import Mover
from fieldkit.steps.scene import BY_ITSELF, Planned, Scene

LEASE_S: Final = 15.0
"""For how long a drone goes on without the laptop, where nothing else is said."""

READY: Final = " ready"
_GUARD_S: Final = 86_400.0
_RESCUE_S: Final = 900.0
"""Longer than a landing may take; the lock of a flight lasts longer, so that the start does not write it."""
_RENEWALS: Final = 3
"""So many in a lease: one may be late."""
_LEAVES_S: Final = 10.0
"""A guard ends in this time after the order to leave."""
_LOOKS_S: Final = 5.0
"""An alarm is not delayed for longer by a robot that does not answer."""
_ENDS: Final = re.compile(r"(?:[0-9.]+ )?(?:error|land|return): (?P<why>.+)")
"""What the program reports when it brings its drone down too early, or sends nothing more."""
_SEPARATOR: Final = "\x1e"
_TAILS: Final = 'for name do tail -c 2000 "$name" 2>/dev/null | tr "\\036" " "; printf "\\036"; done'


def connection(robot: Robot) -> str:
    """Return how a drone's own computer reaches its autopilot.

    Raises:
        ConfigurationError: Its profile names none.
    """
    if robot.profile.mavlink is None:
        raise ConfigurationError(
            "its profile has no mavlink: nothing flies it", where=robot.name, remedy="a drone in this role"
        )
    return robot.profile.mavlink.own


def planned(scene: Scene, role: Role, name: str, plan: FlightPlan, limit_s: float) -> Planned:
    """Return the job of the program on a drone.

    Args:
        scene: The attempt.
        role: Whose drone.
        name: Of the job; its log is this with `.log`.
        plan: What it does; its orders are in the folder of the attempt.
        limit_s: For how long at most.
    """
    robot, whole = scene.robot(role), replace(plan, unhurried=jobs.unhurried_file(name))
    argv = streams.agent_command(robot, "fly", streams.compact(asdict(whole)))
    log = f"{name}.log"
    job = Job(folder=scene.folder, name=name, argv=argv, limit_s=limit_s, log=log, ready=f"log:{READY}")
    return Planned(role, job, program=robot.profile.tools.python, ends=BY_ITSELF)


def guard(scene: Scene, role: Role, name: str, *, lease_s: float = LEASE_S, flown: bool = False) -> Planned:
    """Return the job of the program that guards a drone, and brings it down where the attempt is cut short.

    Args:
        scene: The attempt.
        role: Whose drone.
        name: Of the job.
        lease_s: For how long an order holds.
        flown: Whether a pilot of ours flies the drone, which shares the file of liveness with its guard.
    """
    plan = FlightPlan(
        connection=connection(scene.robot(role)),
        orders=orders_file(name),
        abort=abort_of(scene, role).value,
        lease_s=lease_s,
        guards=True,
        liveness=liveness_file(name) if flown else "",
    )
    return planned(scene, role, name, plan, _GUARD_S)


def rescue(scene: Scene, role: Role, name: str, guard_name: str) -> Job:
    """Return the job that brings a drone down where neither its pilot nor its guard runs.

    Args:
        scene: The attempt.
        role: Whose drone.
        name: Of the job.
        guard_name: Name of the guard's job.
    """
    plan = FlightPlan(
        connection=connection(scene.robot(role)),
        orders="",
        abort=abort_of(scene, role).value,
        lease_s=0.0,
        rescues=True,
        liveness=liveness_file(guard_name),
    )
    return replace(planned(scene, role, name, plan, _RESCUE_S).job, ready=None)


def liveness_file(guard_name: str) -> str:
    """Return the file, in the folder of its attempt, that a pilot and its guard share."""
    return f".jobs/{guard_name}/liveness"


@contextmanager
def guarding(
    scene: Scene, shell: Shell, one: Planned, *, lease_s: float = LEASE_S, body_s: float
) -> Iterator["Leash"]:
    """Start the guard of a drone, yield its leash, and end it after the body; arguments and errors as `leashed`."""
    with leashed(scene, shell, one, lease_s=lease_s, body_s=body_s, ends_s=_LEAVES_S) as leash:
        yield leash
        leash.let_go()


class Leash(HeldLease):
    """Holds the program on a drone.

    Args:
        shell: The robot.
        one: The job, which runs.
        lease_s: For how long each order holds.
        unheard_s: For how long an order holds where nothing may be sent meanwhile; None where the control connection
            does not cross the radio under test.

    Attributes:
        lost: Why the program cannot report its end; empty where it can.
    """

    def __init__(self, shell: Shell, one: Planned, lease_s: float, unheard_s: float | None) -> None:
        job = one.job
        self.lost = ""
        super().__init__(
            shell, job, says=job.log, order=STAY, lease_s=lease_s, renewals=_RENEWALS, unheard_s=unheard_s
        )

    @property
    @override
    def over(self) -> str:
        why = self._why or self.lost
        return f"its flight ended early: {why}" if why else super().over

    @property
    def _lines(self) -> Sequence[str]:
        return self.said.decode("utf-8", "replace").splitlines()

    @property
    def _why(self) -> str:
        """Why the program does not go on, in its own words."""
        found = next(filter(None, map(_ENDS.match, self._lines)), None)
        return brief(found["why"]) if found else ""

    def let_go(self) -> None:
        """End the program, and leave the drone as it is; errors as `order`."""
        self.order(LEAVE)

    @property
    def robot(self) -> str:
        """The name of the robot."""
        return self._shell.robot

    @property
    def is_aloft(self) -> bool:
        """Whether the drone has taken off, as far as is known, and has not landed."""
        marks = [line.rpartition(" ")[2] for line in self._lines]
        return "climbing" in marks and "landed" not in marks

    @property
    def last_lines(self) -> Sequence[str]:
        """The last lines of the program without their times, at most two."""
        return [brief(line.partition(" ")[2]) for line in self._lines[-2:]]

    def origin(self) -> MotionOrigin:
        """Return the origin that the program has reported; it is not moved before that.

        Raises:
            RobotError: It has reported none, or not one.
        """
        for line in self._lines:
            _, _, text = line.partition(" origin ")
            if text:
                try:
                    return _motion_origin(json.loads(text))
                except JSON_ERRORS as error:
                    raise self.failure(f"its origin is unreadable: {brief(text)}") from error
        raise self.failure("it has not reported its origin")

    @property
    def is_misplaced(self) -> bool:
        """Whether the program refuses to fly because the drone is not at its origin."""
        return any(line.endswith(f" {MISPLACED}") for line in self._lines)

    def tails(self, names: Sequence[str]) -> list[list[str]]:
        """Return the last lines of each of these files in the attempt's folder, of 2,000 bytes; errors as `order`.

        A file that is empty or missing has no lines.
        """
        files = [f"{self._job.folder}/{name}" for name in names]
        done = self._shell.run(("sh", "-c", _TAILS, "sh", *files), deadline=Deadline.after(_LOOKS_S))
        tails = done.stdout.decode("utf-8", "replace").split(_SEPARATOR)[: len(names)]
        return [[brief(line, 1000) for line in tail.splitlines()] for tail in tails]

    def refresh(self) -> None:
        """Look at the program, without a long wait for a robot that does not answer; errors as `order`."""
        self._send(_LOOKS_S)

    def until(self, mark: str, within_s: float) -> None:
        """Wait until the program says that it has come so far.

        Raises:
            LinkError: The robot did not answer.
            RobotError: The program ended, or did not come so far in time.
        """
        deadline = Deadline.after(within_s)
        while True:
            self.look()
            if any(line.endswith(f" {mark}") for line in self._lines):
                return
            if why := self._why or self.lost or self.over:
                raise self.failure(why)
            if deadline.expired:
                last = brief(self._lines[-1].partition(" ")[2]) if self._lines else "nothing"
                raise self.failure(f"it is not {mark} after {within_s:.0f} s; it said last: {last}")
            self.pause()


def _motion_origin(values: Mapping[str, Any]) -> MotionOrigin:
    """Return the origin in the report of a program, which is untrusted; raises what `JSON_ERRORS` has."""
    numbers = [float(values[name]) for name in ("x_m", "y_m", "heading_rad")]
    degrees = [None if values[name] is None else float(values[name]) for name in ("latitude_deg", "longitude_deg")]
    if not all(map(math.isfinite, (*numbers, *(value or 0.0 for value in degrees)))):
        raise ValueError(values)
    return MotionOrigin(brief(str(values["frame"])), brief(str(values["frame_id"])), *numbers, *degrees)


@contextmanager
def leashed(
    scene: Scene, shell: Shell, one: Planned, *, lease_s: float = LEASE_S, body_s: float, ends_s: float
) -> Iterator[Leash]:
    """Start the program on a drone, yield its leash, and wait for its end after the body, which has told it to end.

    Where the body fails, the program goes on, on its own lease: who cleans up ends its jobs, and so does the robot.

    Args:
        scene: The attempt.
        shell: The robot.
        one: The job, from `planned`.
        lease_s: For how long an order holds.
        body_s: About how long the body takes, for a control connection that is to be silent meanwhile.
        ends_s: How long the program may take to end.

    Raises:
        LinkError: The robot did not answer.
        RobotError: The program did not come up, or did not end well.
    """
    robot = scene.robot(one.role)
    unheard_s = lease_s + 2 * body_s if robot.control is Control.RADIO else None
    alone = f"if it flies, it comes down by itself within {unheard_s or lease_s:g} s"
    mover = Mover(robot.name, shell, scene.folder, alone)
    with scene.motions.moving(mover), lease.started(shell, one.job), Leash(shell, one, lease_s, unheard_s) as leash:
        yield leash
        code = jobs.begin_wait(shell, one.job, ends_s).end(ends_s + jobs.REPLY_S)
        if code != 0:
            leash.look()
            raise leash.failure(leash.over or f"{one.job.name} ended with exit code {code}")


def abort_of(scene: Scene, role: Role) -> OnAbort:
    """Return what becomes of a drone where the attempt is cut short."""
    return scene.on_abort.get(role, OnAbort.LAND)
