"""Control of drones from the laptop: jobs of the programs on the drone that fly or guard it, and their leases.

The programs are parts of fieldkit's agent (`fieldkit.agent.flying.flight`, `fieldkit.agent.flying.guard`). An
order to them is valid for a limited time, the lease, and the laptop renews it. If this process is killed, or the
control link is down for longer than the lease, the programs end the flight by the action of `on_abort`.
"""

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from typing import Any, Final

from typing_extensions import override

from fieldkit.agent.flying.flight_plan import CLIMBING, LEAVE, MISPLACED, STAY, FlightPlan
from fieldkit.backends.protocols import Robot
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Control, Role
from fieldkit.core.text import JSON_ERRORS, shorten
from fieldkit.motion.origins import MotionOrigin
from fieldkit.motion.profile_sections import mavlink_of
from fieldkit.motion.steps import lease
from fieldkit.motion.steps.lease import LeaseKeeper, orders_file
from fieldkit.motion.steps.robot_mover import RobotMover
from fieldkit.remote import jobs
from fieldkit.remote.jobs import Job
from fieldkit.remote.shell import Shell
from fieldkit.steps import agent_commands
from fieldkit.steps.scene import BY_EXIT, Planned, Scene

LEASE_S: Final = 15.0
"""Default time for which a drone continues without contact to the laptop."""

READY: Final = " ready"
"""End of the log line of a program that has received a heartbeat of the autopilot; its job is then ready."""
_GUARD_S: Final = 86_400.0
"""Time limit of the guard's job: a day, longer than any attempt."""
_RESCUE_S: Final = 900.0
"""Time limit of the rescue's job: longer than any landing, and shorter than the lifetime of the robot's lock, so that
the lock need not be extended when the rescue starts."""
_RENEWALS: Final = 3
"""Renewals per lease, so that one may be late."""
_GUARD_EXIT_S: Final = 10.0
"""Maximum time from the order `LEAVE` to the exit of a guard."""
_QUERY_S: Final = 5.0
"""Timeout of a query, so that a robot that does not answer delays an alarm for at most this time."""
_END_LINE: Final = re.compile(r"(?:[0-9.]+ )?(?:error|land|return): (?P<reason>.+)")
"""Log line with the reason why the program aborted the flight or exited with an error."""
_SEPARATOR: Final = "\x1e"
_TAILS: Final = 'for name do tail -c 2000 "$name" 2>/dev/null | tr "\\036" " "; printf "\\036"; done'
"""Shell script that prints the end of each file, followed by `_SEPARATOR` (octal 036)."""


def onboard_connection(robot: Robot) -> str:
    """Return the connection from a drone's onboard computer to its autopilot.

    Raises:
        ConfigurationError: Its profile has no `mavlink`.
    """
    if (mavlink := mavlink_of(robot.profile)) is None:
        raise ConfigurationError(
            "it cannot fly: its profile has no mavlink", where=robot.name, remedy="use a drone in this role"
        )
    return mavlink.onboard_connection


def flight_job(scene: Scene, role: Role, name: str, plan: FlightPlan, limit_s: float) -> Planned:
    """Return the job of a flight program on a drone.

    Args:
        scene: The attempt.
        role: Role of the drone.
        name: Name of the job; its log is `NAME.log`.
        plan: Argument of the program, without `landing_marker`, which is added; the file of its orders is in the
            folder of the attempt.
        limit_s: Time limit of the job.
    """
    robot, complete_plan = scene.robot(role), replace(plan, landing_marker=jobs.landing_marker_file(name))
    argv = agent_commands.agent_command(robot, "fly", agent_commands.compact(asdict(complete_plan)))
    log = f"{name}.log"
    job = Job(
        folder=scene.folder,
        name=name,
        argv=argv,
        limit_s=limit_s,
        log=log,
        ready=f"log:{READY}",
        ready_s=jobs.AGENT_READY_S,
    )
    return Planned(role, job, program=robot.profile.tools.python, permitted_causes=BY_EXIT)


def guard_job(
    scene: Scene, role: Role, name: str, *, abort: str, lease_s: float = LEASE_S, has_pilot: bool = False
) -> Planned:
    """Return the job of the program that guards a drone, and ends its flight if the attempt is aborted.

    Args:
        scene: The attempt.
        role: Role of the drone.
        name: Name of the job.
        abort: Action if the attempt is aborted, a value of `OnAbort`.
        lease_s: Timeout for the first order, in seconds; each order contains its lease.
        has_pilot: Whether a pilot program flies the drone. It then shares the liveness file with the guard.
    """
    plan = FlightPlan(
        connection=onboard_connection(scene.robot(role)),
        orders=orders_file(name),
        abort=abort,
        lease_s=lease_s,
        guards=True,
        liveness=liveness_file(name) if has_pilot else "",
    )
    return flight_job(scene, role, name, plan, _GUARD_S)


def rescue_job(scene: Scene, role: Role, name: str, guard_name: str, *, abort: str) -> Job:
    """Return the job of the rescue program, which kills the pilot and the guard of a drone and ends its flight.

    It must be started only if neither of them runs.

    Args:
        scene: The attempt.
        role: Role of the drone.
        name: Name of the job.
        guard_name: Name of the guard's job.
        abort: Action that ends the flight, a value of `OnAbort`.
    """
    plan = FlightPlan(
        connection=onboard_connection(scene.robot(role)),
        orders="",
        abort=abort,
        lease_s=0.0,
        rescues=True,
        liveness=liveness_file(guard_name),
    )
    return replace(flight_job(scene, role, name, plan, _RESCUE_S).job, ready=None)


def liveness_file(guard_name: str) -> str:
    """Return the path, relative to the attempt's folder, of the liveness file of a pilot and its guard."""
    return f".jobs/{guard_name}/liveness"


@contextmanager
def guarding(
    scene: Scene, shell: Shell, program: Planned, *, lease_s: float = LEASE_S, body_s: float
) -> Iterator["FlightLease"]:
    """Start the guard of a drone, yield its lease, and order the guard to exit after a successful body.

    After an error in the body, the guard continues; see `leased_program`. Raises the same errors.
    """
    with leased_program(scene, shell, program, lease_s=lease_s, body_s=body_s, exit_s=_GUARD_EXIT_S) as flight:
        yield flight
        flight.release()


class FlightLease(LeaseKeeper):
    """Renews the lease of a flight program on a drone.

    Args:
        shell: Connection to the robot.
        program: The running job.
        lease_s: Time in seconds until an order expires.
        silent_lease_s: Time until an order expires if nothing may be sent meanwhile; None if the control connection
            does not cross the radio under test.

    Attributes:
        lost_reason: Why the program has not written the reason of its end to its log, set if it was killed or
            suspended; otherwise empty.
    """

    def __init__(self, shell: Shell, program: Planned, lease_s: float, silent_lease_s: float | None) -> None:
        job = program.job
        self.lost_reason = ""
        super().__init__(
            shell,
            job,
            output_file=job.log,
            order=STAY,
            lease_s=lease_s,
            renewals=_RENEWALS,
            silent_lease_s=silent_lease_s,
        )

    @property
    @override
    def end_reason(self) -> str:
        reason = self._reported_reason or self.lost_reason
        return f"its flight ended early: {reason}" if reason else super().end_reason

    @property
    def _lines(self) -> Sequence[str]:
        return self.output.decode("utf-8", "replace").splitlines()

    @property
    def _reported_reason(self) -> str:
        """The reason why the program ended the flight, from its log; empty if it did not end the flight."""
        match = next(filter(None, map(_END_LINE.match, self._lines)), None)
        return shorten(match["reason"]) if match else ""

    def release(self) -> None:
        """Order the program to exit without a command to the drone. Raises the same errors as `give_order`."""
        self.give_order(LEAVE)

    @property
    def robot(self) -> str:
        """Name of the robot."""
        return self._shell.robot

    @property
    def is_aloft(self) -> bool:
        """Whether the drone was armed for the take-off and has not landed, according to the log of the program."""
        marks = [line.rpartition(" ")[2] for line in self._lines]
        return CLIMBING in marks and "landed" not in marks

    @property
    def last_lines(self) -> Sequence[str]:
        """The last two lines of the log without their times."""
        return [shorten(line.partition(" ")[2]) for line in self._lines[-2:]]

    def origin(self) -> MotionOrigin:
        """Return the origin that the program has reported, which it does before it moves the drone.

        Raises:
            RobotError: The report is missing or invalid.
        """
        for line in self._lines:
            _, _, text = line.partition(" origin ")
            if text:
                try:
                    return _motion_origin(json.loads(text))
                except JSON_ERRORS as error:
                    raise self.failure(f"its origin is unreadable: {shorten(text)}") from error
        raise self.failure("it has not reported its origin")

    @property
    def is_misplaced(self) -> bool:
        """Whether the program refuses to fly because the drone is not at its origin."""
        return any(line.endswith(f" {MISPLACED}") for line in self._lines)

    def read_tails(self, names: Sequence[str]) -> list[list[str]]:
        """Return the lines in the last 2,000 bytes of files in the attempt's folder; a missing file has no lines.

        Raises the same errors as `give_order`.
        """
        files = [f"{self._job.folder}/{name}" for name in names]
        result = self._shell.run(("sh", "-c", _TAILS, "sh", *files), deadline=Deadline.after(_QUERY_S))
        tails = result.stdout.decode("utf-8", "replace").split(_SEPARATOR)[: len(names)]
        return [[shorten(line, 1000) for line in tail.splitlines()] for tail in tails]

    def refresh(self) -> None:
        """Renew the order with a short timeout. Raises the same errors as `give_order`."""
        self._send(_QUERY_S)

    def wait_for(self, mark: str, within_s: float) -> None:
        """Wait until the program reports that it has reached a state.

        Args:
            mark: The state, which is the end of a line of the log.
            within_s: Timeout in seconds.

        Raises:
            LinkError: The robot did not answer.
            RobotError: The program ended, or did not reach the state in time.
        """
        deadline = Deadline.after(within_s)
        while True:
            self.renew()
            if any(line.endswith(f" {mark}") for line in self._lines):
                return
            if reason := self._reported_reason or self.lost_reason or self.end_reason:
                raise self.failure(reason)
            if deadline.expired:
                last_line = shorten(self._lines[-1].partition(" ")[2]) if self._lines else "nothing"
                raise self.failure(f"it did not report {mark!r} in {within_s:.0f} s; its last line: {last_line}")
            self.wait_for_next_poll()


def _motion_origin(values: Mapping[str, Any]) -> MotionOrigin:
    """Return the origin in the report of a program (untrusted); raises an error of `JSON_ERRORS` if it is invalid."""
    numbers = [float(values[name]) for name in ("x_m", "y_m", "heading_rad")]
    degrees = [None if values[name] is None else float(values[name]) for name in ("latitude_deg", "longitude_deg")]
    if not all(map(math.isfinite, (*numbers, *(value or 0.0 for value in degrees)))):
        raise ValueError(values)
    return MotionOrigin(shorten(str(values["frame"])), shorten(str(values["frame_id"])), *numbers, *degrees)


@contextmanager
def leased_program(
    scene: Scene, shell: Shell, program: Planned, *, lease_s: float = LEASE_S, body_s: float, exit_s: float
) -> Iterator[FlightLease]:
    """Start a flight program on a drone, yield its lease, and wait until the program exits after the body.

    The body must give the order after which the program exits.

    If the body fails, the program continues until its lease expires or the clean-up of the attempt stops its job.

    Args:
        scene: The attempt.
        shell: Connection to the robot.
        program: The job, from `flight_job`.
        lease_s: Time in seconds until an order expires.
        body_s: Approximate duration of the body, needed if the control connection must be silent meanwhile.
        exit_s: Maximum time for the exit of the program.

    Raises:
        LinkError: The robot did not answer.
        RobotError: The program did not start, or failed.
    """
    robot = scene.robot(program.role)
    # The body may take up to twice its approximate duration.
    silent_lease_s = lease_s + 2 * body_s if robot.control is Control.RADIO else None
    fallback = f"if it flies, it starts to come down automatically within {silent_lease_s or lease_s:g} s"
    mover = RobotMover(robot.name, shell, scene.folder, fallback)
    with (
        scene.motions.moving(mover),
        lease.start_program(shell, program.job),
        FlightLease(shell, program, lease_s, silent_lease_s) as flight,
    ):
        yield flight
        code = jobs.begin_wait(shell, program.job, exit_s).end(exit_s + jobs.REPLY_S)
        if code != 0:
            flight.renew()
            raise flight.failure(flight.end_reason or f"{program.job.name} ended with exit code {code}")
