"""Drones on the laptop's side: the program on the robot that flies one, or watches one, and the leash that it is on.

The program is the agent's (`fieldkit.agent.flight`). Who kills this process, or cuts the control link for longer than
the lease, brings the drone down.
"""

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from typing import Final

from fieldkit.agent.flight_plan import LEAVE, STAY, FlightPlan
from fieldkit.backends.protocols import Robot
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Control, OnAbort, Role
from fieldkit.core.text import brief
from fieldkit.remote import jobs
from fieldkit.remote.jobs import Job
from fieldkit.remote.shell import Shell
from fieldkit.steps import lease, streams
from fieldkit.steps.lease import HeldLease, orders_file
from fieldkit.steps.scene import BY_ITSELF, Planned, Scene

LEASE_S: Final = 15.0
"""For how long a drone goes on without the laptop, where nothing else is said."""

READY: Final = " ready"
_GUARD_S: Final = 86_400.0
_RENEWALS: Final = 3
"""So many in a lease: one may be late."""
_ENDS: Final = re.compile(r"(?:[0-9.]+ )?(?:error|land|return): (?P<why>.+)")
"""What the program says when it brings its drone down too early, or lets go of it."""


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


def guard(scene: Scene, role: Role) -> Planned:
    """Return the job of the program that watches a drone, whoever flies it, and brings it down."""
    name = f"{role}-guard"
    plan = FlightPlan(connection(scene.robot(role)), orders_file(name), abort_of(scene, role).value, lease_s=LEASE_S)
    return planned(scene, role, name, plan, _GUARD_S)


class Leash(HeldLease):
    """Holds the program on a drone.

    Args:
        shell: The robot.
        one: The job, which runs.
        lease_s: For how long each order holds.
        unheard_s: For how long an order holds where nothing may be sent meanwhile; None where the control connection
            does not cross the radio under test.
    """

    def __init__(self, shell: Shell, one: Planned, lease_s: float, unheard_s: float | None) -> None:
        job = one.job
        super().__init__(
            shell, job, says=job.log, order=STAY, lease_s=lease_s, renewals=_RENEWALS, unheard_s=unheard_s
        )

    @property
    def over(self) -> str:
        """See `HeldLease.over`."""
        return f"its flight ended early: {self._why}" if self._why else super().over

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
            if why := self._why or self.over:
                raise self.failure(why)
            if deadline.expired:
                last = brief(self._lines[-1].partition(" ")[2]) if self._lines else "nothing"
                raise self.failure(f"it is not {mark} after {within_s:.0f} s; it said last: {last}")
            self.pause()


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
    lease.start(shell, one.job)
    unheard_s = lease_s + 2 * body_s if scene.robot(one.role).control is Control.RADIO else None
    with Leash(shell, one, lease_s, unheard_s) as leash:
        yield leash
        code = jobs.begin_wait(shell, one.job, ends_s).end(ends_s + jobs.REPLY_S)
        if code != 0:
            leash.look()
            raise leash.failure(leash.over or f"{one.job.name} ended with exit code {code}")


def abort_of(scene: Scene, role: Role) -> OnAbort:
    """Return what becomes of a drone where the attempt is cut short."""
    return scene.on_abort.get(role, OnAbort.LAND)
