"""An emulated lab with a rover that drives and two drones that fly; fieldkit uses them like real robots."""

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Self

import pytest

from fieldkit.config.locations import SITE_FILE
from fieldkit.core.deadline import Deadline
from fieldkit.core.model import Role, Topology, Vector
from sim_backends.emulated.nodes import EmulatedRobot
from tests.helpers import motion_router
from tests.helpers.field_robots import FieldRobots, start_field_robots
from tests.helpers.host import descendants
from tests.helpers.labs import BOX, replace_text, write_procedure
from tests.helpers.motion_cells import (
    DRIVE_ACCELERATION_M_S2,
    DRIVE_LEASE_S,
    DRIVE_SPEED_M_S,
    FENCE_M,
    FLIGHT_HEIGHT_M,
    FLIGHT_LEASE_S,
    Craft,
    Moment,
    MotionCell,
)
from tests.helpers.motion_parties import agents_on, command_line, send
from tests.helpers.paths import ROOT
from tests.helpers.rovers import rover_profile
from tests.helpers.runs import fieldkit
from tests.helpers.sshd import wait_until
from tests.helpers.texts import site

ROUTER_PORT: Final = 5760
AUTOPILOT_PORT: Final = 14550
LONG_S: Final = 60.0

_ROLES: Final = {Craft.ROVER: Role.SENDER, Craft.PX4: Role.RECEIVER, Craft.COPTER: Role.RELAY}
_SITE: Final = site({"rover-1": "rover", "px4-1": "px4", "copter-1": "copter"}, emulated="ros: auto")

_DRIVE: Final = """\
name: matrix
summary: A robot drives away
scenario: los
topology: masterless
protocols: [udp]
repeats: 1
attempts: 3
steps:
  - move:
      robot: receiver
      path: [{{away: {path_m}m}}]
      speed: {speed_m_s}m/s
      during: [{{wait: {{duration: {inner_s}s}}}}]
"""
_FLY: Final = """\
name: matrix
summary: A drone flies away
scenario: los
topology: masterless
protocols: [udp]
repeats: 1
attempts: 3
on_abort: {{receiver: land}}
steps:
  - fly:
      robot: receiver
      height: {height_m}m
      path: [{{away: {path_m}m}}]
      speed: 2m/s
      climb: 1m/s
      then: return
      lease: {lease_s}s
      during: [{{wait: {{duration: {inner_s}s}}}}]
"""
_PATHS: Final = {
    Moment.WAITING: (4, 9),
    Moment.OUT: (18, 20),
    Moment.GROUND: (6, 8),
    Moment.CLIMBING: (6, 8),
    Moment.FLYING: (30, 20),
    Moment.LANDING: (2, 2),
}
"""Length of the path in metres, and duration of the inner step in seconds."""
_DRIVEN_PATHS: Final = {Moment.THERE: (1, 14), Moment.BACK: (6, 11)}
_FLOWN_PATHS: Final = {Moment.THERE: (2, 14), Moment.BACK: (12, 8)}


def write_profiles(folder: Path) -> None:
    """Write the robot profiles to a lab's folder: a fast rover, and two drones, each with and without a router."""
    (folder / "robots").mkdir()
    rover = rover_profile(
        fence_m=FENCE_M[Craft.ROVER], ros="ros2", lease_s=DRIVE_LEASE_S, acceleration_m_s2=DRIVE_ACCELERATION_M_S2
    )
    (folder / "robots/rover.yaml").write_text(rover, encoding="utf-8")
    for craft, autopilot in ((Craft.PX4, "px4"), (Craft.COPTER, "ardupilot")):
        for name, connection in ((craft, ""), (f"{craft}_routed", f", connection: tcp:127.0.0.1:{ROUTER_PORT}")):
            text = replace_text(BOX, "name: box", f"name: {name}", "kind: ugv", "kind: uav")
            limits = f"limits: {{max_speed_m_s: 3, max_height_m: 30, fence_m: {FENCE_M[craft]:g}}}"
            mavlink = f"mavlink: {{port: {AUTOPILOT_PORT}, autopilot: {autopilot}{connection}}}"
            text = replace_text(text, "limits: {max_speed_m_s: 1}", f"{limits}\n{mavlink}")
            (folder / "robots" / f"{name}.yaml").write_text(text, encoding="utf-8")


@dataclass
class MotionLab:
    """The lab.

    Attributes:
        field_robots: Its robots.
    """

    field_robots: FieldRobots
    _routers: dict[Craft, "subprocess.Popen[str]"] = field(default_factory=dict)

    def role(self, craft: Craft) -> Role:
        """The role of a robot in the lab, which is the key of its shell and its link."""
        return _ROLES[craft]

    def robot(self, craft: Craft) -> EmulatedRobot:
        """The robot of a kind."""
        return self.field_robots.testbed.robots[_ROLES[craft]]

    def place_m(self, craft: Craft) -> Vector:
        """Position of a stationary robot."""
        role = _ROLES[craft]
        positions = [
            position.position_m for position in self.field_robots.testbed.oracle.track(0) if position.role is role
        ]
        assert positions[-1] is not None
        return positions[-1]

    def home(self, craft: Craft) -> Path:
        """The folder of fieldkit on a robot, as a path of this machine."""
        outermost = self.robot(craft).pid
        children = Path(f"/proc/{outermost}/task/{outermost}/children").read_text(encoding="ascii").split()
        return Path(f"/proc/{children[0]}/root/root/.fieldkit")

    def logs(self, craft: Craft) -> set[Path]:
        """The motion logs of all attempts on a robot."""
        name = "fly.jsonl" if craft.flies else "drive.jsonl"
        return set(self.home(craft).glob(f"*/*/{name}"))

    def prepare(self, cell: MotionCell, folder: Path) -> None:
        """Write the folder of a cell's trial, in which fieldkit runs."""
        field_robots, craft = self.field_robots, cell.craft
        shutil.copytree(field_robots.folder / "robots", folder / "robots")
        lines = (field_robots.folder / SITE_FILE).read_text(encoding="utf-8").splitlines()
        other_robot = field_robots.cast[_ROLES[Craft.ROVER if craft.flies else Craft.PX4]].name
        name = field_robots.cast[_ROLES[craft]].name
        roles = f"roles: {{masterless: {{sender: {other_robot}, receiver: {name}}}}}"
        lines = [line for line in lines if not line.startswith("roles:")] + [roles]
        text = "\n".join(lines) + "\n"
        if cell.routed:
            text = replace_text(text, f"{name}: {{profile: {craft},", f"{name}: {{profile: {craft}_routed,")
        (folder / SITE_FILE).write_text(text, encoding="utf-8")
        path_m, inner_s = (_PATHS | (_FLOWN_PATHS if craft.flies else _DRIVEN_PATHS))[cell.moment]
        write_procedure(
            folder,
            (_FLY if craft.flies else _DRIVE).format(
                path_m=path_m,
                inner_s=inner_s,
                speed_m_s=DRIVE_SPEED_M_S,
                height_m=FLIGHT_HEIGHT_M,
                lease_s=FLIGHT_LEASE_S,
            ),
        )

    def start_router(self, craft: Craft) -> None:
        """Start a MAVLink router on a drone, and wait until it accepts clients."""
        inner = self.home(craft).parts[2]
        argv = (sys.executable, str(Path(motion_router.__file__)), str(ROUTER_PORT), str(AUTOPILOT_PORT))
        process = subprocess.Popen(
            ("nsenter", "--target", inner, "--net", "--pid", "--", *argv), stdout=subprocess.PIPE, text=True
        )
        self._routers[craft] = process
        assert process.stdout is not None
        assert process.stdout.readline() == "up\n"

    def router_pids(self, craft: Craft) -> set[int]:
        """The process ids of the router on a drone."""
        process = self._routers.get(craft)
        if process is None:
            return set()
        pids = {process.pid, *descendants(process.pid)}
        return {
            pid for pid in pids if any(argument.endswith("motion_router.py") for argument in command_line(pid)[:2])
        }

    def stop_router(self, craft: Craft) -> None:
        """Stop the router on a drone, if there is one."""
        process = self._routers.pop(craft, None)
        if process is not None:
            # `nsenter` is not killed, since it waits for the router, which would otherwise become an orphan.
            send(signal.SIGKILL, descendants(process.pid))
            process.wait(LONG_S)
            assert process.stdout is not None
            process.stdout.close()

    def restore_lab(self, craft: Craft, folder: Path) -> list[str]:
        """Restore the lab after a trial, as an operator would; return descriptions of the processes that still ran.

        Args:
            craft: The robot that moved.
            folder: The folder of the trial.
        """
        for role in self.field_robots.cast:
            self.field_robots.links.restore(role)
            self.field_robots.links.delay(role, 0.0)
            self.field_robots.links.drop(role)
        if craft in self._routers:  # a new router, so that the drone's programs can land it
            self.stop_router(craft)
            self.start_router(craft)
        problems = []
        pid = self.robot(craft).pid
        send(signal.SIGCONT, agents_on(pid))
        if any(self.home(craft).glob("*/*")):
            fieldkit(folder, "abort", "--yes")
        try:
            wait_until(lambda: not agents_on(pid), Deadline.after(40))
        except AssertionError:
            remaining = agents_on(pid)
            problems = [f"left running: {' '.join(argv)[:80]}" for argv in remaining.values()]
            send(signal.SIGKILL, remaining)
        self.stop_router(craft)
        self.field_robots.testbed.bring_back(_ROLES[craft], has_returned=False)
        return problems

    def close(self) -> None:
        """Stop the routers."""
        for craft in list(self._routers):
            self.stop_router(craft)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@contextmanager
def motion_lab(folder: Path) -> Iterator[MotionLab]:
    """Yield the lab in an empty folder; it stops at the latest when the calling thread ends."""
    write_profiles(folder)
    (folder / "lab.yaml").write_text(_SITE, encoding="utf-8")
    with ExitStack() as stack:
        with pytest.MonkeyPatch.context() as monkeypatch:
            monkeypatch.chdir(folder)  # profiles are loaded from the working folder
            field_robots = stack.enter_context(
                start_field_robots(folder, site=folder / "lab.yaml", topology=Topology.MASTER)
            )
        yield stack.enter_context(MotionLab(field_robots))


def start_trial(folder: Path) -> "subprocess.Popen[bytes]":
    """Start fieldkit's trial of a prepared folder in a separate process group, with its output in files there."""
    with (folder / "out").open("wb") as out, (folder / "err").open("wb") as err:
        return subprocess.Popen(
            (sys.executable, "-m", "fieldkit", "trial", "matrix", "5m", "--yes", "--allow-motion", "--json"),
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=err,
            env=os.environ | {"PYTHONUNBUFFERED": "1", "PYTHONPATH": str(ROOT)},
            start_new_session=True,
        )
