"""A flight that ends before its steps do: by the agent itself, with an emulated autopilot, on this machine."""

import math
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import pytest

from fieldkit.backends.protocols import Robot
from fieldkit.config import schema
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import LinkError, RobotError
from fieldkit.core.model import OnAbort, Protocol, Role
from fieldkit.remote import evidence, jobs
from fieldkit.remote.shell import Completed
from fieldkit.steps.kinds.fly import FlyStep
from fieldkit.steps.scene import Scene
from sim_backends.emulated.autopilot.arducopter import ARDUCOPTER
from sim_backends.emulated.autopilot.firmware import Mode
from tests.helpers import drones
from tests.helpers.casts import DUCKIEDRONE
from tests.helpers.host import descendants
from tests.helpers.idle_testbed import IdleTestbed
from tests.helpers.sshd import wait_until
from tests.helpers.userlands import LocalShell

pytestmark = pytest.mark.emulated

FOLDER = jobs.work_folder("trial", "tcp-01-1")
FLIGHT = "robot: receiver, height: 60cm, path: [{away: 2m}], speed: 3m/s, lease: 3s"
NEAR_M = 0.6
"""To home; it flew three times as far."""


class Shell(LocalShell):
    """A robot whose link may be cut."""

    is_cut = False

    def run(self, argv: Sequence[str], *, deadline: Deadline, stdin: bytes = b"", check: bool = True) -> Completed:
        if self.is_cut:
            raise LinkError("is out of range", where=self.robot, remedy="wait")
        return super().run(argv, deadline=deadline, stdin=stdin, check=check)


@pytest.fixture
def shell(tmp_path: Path) -> Iterator[Shell]:
    made = Shell(tmp_path)
    jobs.install(made, Deadline.after(30))
    evidence.begin(made, FOLDER, "receiver", "lo")
    yield made
    wait_until(lambda: jobs.left(made, Deadline.after(30)) == (), Deadline.after(60))


def fly(shell: Shell, port: int, waits: str, begun: Callable[[], object], abort: OnAbort = OnAbort.LAND) -> None:
    """Fly a drone that is at a port, and call something when the step inside begins."""
    assert DUCKIEDRONE.mavlink is not None
    update = {
        "ros": None,
        "tools": DUCKIEDRONE.tools.model_copy(update={"python": sys.executable}),
        "mavlink": DUCKIEDRONE.mavlink.model_copy(update={"connection": f"udpout:127.0.0.1:{port}"}),
    }
    robot = Robot(name="drone", address="127.0.0.1", profile=DUCKIEDRONE.model_copy(update=update), flies=True)
    scene = Scene(Protocol.TCP, {Role.RECEIVER: robot}, FOLDER, on_abort={Role.RECEIVER: abort})
    step = f"{{{FLIGHT}, during: [{{wait: {{duration: {waits}}}}}, {{wait: {{duration: {waits}}}}}]}}"

    def announce(name: str, _: float | None) -> None:
        if name == "wait":
            begun()

    schema.validate(schema.parse(step, source="x.yaml"), FlyStep).run(
        scene, IdleTestbed({Role.RECEIVER: shell}), announce
    )


def log(shell: Shell) -> str:
    return (shell.home / FOLDER / "fly.log").read_text(encoding="utf-8")


def test_who_takes_a_drone_over_ends_the_steps_inside(shell: Shell) -> None:
    with drones.autopilot_at_udp() as (port, autopilot):
        with pytest.raises(RobotError, match="here: its flight ended early: somebody else flies it") as caught:
            fly(shell, port, "60min", lambda: autopilot.vehicle.change_mode(Mode.LAND))
        assert "the wait was cut short" in str(caught.value.__cause__)
        assert "landed" not in log(shell), "it let go of it"


def test_a_program_that_is_killed_ends_the_steps_inside(shell: Shell) -> None:
    def kill() -> None:
        leader = int((shell.home / FOLDER / ".jobs/fly/pid").read_text(encoding="ascii").split()[0])
        for pid in descendants(leader):
            if b"/agent-" in Path(f"/proc/{pid}/cmdline").read_bytes():
                os.kill(pid, signal.SIGKILL)

    with drones.autopilot_at_udp() as (port, _), pytest.raises(RobotError, match="ended with exit code 137"):
        fly(shell, port, "60min", kill)


def test_an_arducopter_returns_whose_laptop_is_not_heard_for_longer_than_its_lease(shell: Shell) -> None:
    with drones.autopilot_at_udp(firmware=ARDUCOPTER) as (port, autopilot):
        for name, centimetres in (("RTL_ALT", 100.0), ("WPNAV_RADIUS", 10.0)):
            autopilot._parameters.set(name, centimetres)
        vehicle = autopilot.vehicle

        def cut() -> None:
            wait_until(lambda: math.hypot(*vehicle.body.position_m[:2]) > 1.5, Deadline.after(60))
            shell.is_cut = True

        with pytest.raises(LinkError, match="out of range"):
            fly(shell, port, "1ms", cut, OnAbort.RETURN)
        wait_until(lambda: not vehicle.armed, Deadline.after(60))
        assert math.hypot(*vehicle.body.position_m[:2]) < NEAR_M, "where it rose"
        shell.is_cut = False
        wait_until(lambda: "landed" in log(shell), Deadline.after(60))
        assert "return: nobody has renewed the order in time" in log(shell)


def test_who_ends_all_jobs_leaves_a_pilot_the_time_that_it_needs(shell: Shell) -> None:
    """Its autopilot lands, as it was told, for longer than others may take to end."""
    with drones.autopilot_at_udp() as (port, autopilot):
        autopilot._parameters.set("MPC_LAND_SPEED", 0.1)
        with suppress(RobotError):
            fly(shell, port, "60min", lambda: evidence.end_jobs(shell, FOLDER))
        wait_until(lambda: "landed" in log(shell), Deadline.after(60))
        assert "land: the job was told to end" in log(shell)
        assert not autopilot.vehicle.armed
