"""A lab with a ground robot that drives, `rover-1`, and a computer, `box-1`; fieldkit uses them like real robots."""

import math
import subprocess
from collections.abc import Iterator
from contextlib import chdir, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fieldkit.config.locations import SITE_FILE
from fieldkit.core.deadline import Deadline
from fieldkit.core.model import Placement, Role, Scenario, Topology, Vector
from fieldkit.core.units import parse_distance
from fieldkit.remote.command import with_environment
from sim_backends.emulated.ros.motion_record import RecordedMotion
from tests.helpers import texts
from tests.helpers.field_robots import FieldRobots, start_field_robots
from tests.helpers.labs import BOX, replace_text
from tests.helpers.paths import ROOT
from tests.helpers.runs import wait_during
from tests.helpers.sshd import wait_until

LONG_S: Final = 90.0
SPEED_M_S: Final = 0.6
_SITE: Final = texts.site({"rover-1": "rover", "box-1": "box"}, emulated="ros: auto")
_ROLES: Final = "roles: {masterless: {sender: rover-1, receiver: box-1}}"
RECEIVER_SITE: Final = "receiver.yaml"
"""Site file in which the rover is the receiver; the receiver has the same position at all distances."""
_DRIVE: Final = """\
name: drive
summary: A robot drives away
scenario: los
topology: masterless
protocols: [udp]
repeats: 1
attempts: 1
steps:
  - move:
      robot: {role}
      path: [{{away: {path_m:g}m}}]
      speed: {speed_m_s:g}m/s
      during: [{{wait: {{duration: {wait_s:.1f}s}}}}]
"""
_SETUP: Final = ("/opt/ros/noetic/setup.bash",)


def rover_profile(*, fence_m: float, ros: str = "ros1", lease_s: float = 2.0, acceleration_m_s2: float = 2.0) -> str:
    """The profile `rover`: a TurtleBot3 with a higher speed, so that tests take less time."""
    return replace_text(
        (ROOT / "robots/turtlebot3_burger.yaml").read_text(encoding="utf-8"),
        *("name: turtlebot3_burger", "name: rover", "variant: ros1", f"variant: {ros}"),
        *("max_speed_m_s: 0.22", "max_speed_m_s: 1.0", "fence_m: 30", f"fence_m: {fence_m:g}"),
        *("turn_rad_s: 1.0", "turn_rad_s: 3.0", "acceleration_m_s2: 0.5"),
        f"acceleration_m_s2: {acceleration_m_s2:g}, lease: {lease_s:g}s",
    )


@dataclass
class RoverLab:
    """The lab.

    Attributes:
        field_robots: Its robots; `field_robots.folder` contains `fieldkit.yaml` and `receiver.yaml`.
    """

    field_robots: FieldRobots

    @property
    def folder(self) -> Path:
        """The working folder for fieldkit."""
        return self.field_robots.folder

    @property
    def motion(self) -> RecordedMotion | None:
        """Motion of the rover as its base reports it to the lab; None before the first report."""
        return self.field_robots.testbed.robots[Role.SENDER].recorded_motion()

    @property
    def drives(self) -> bool:
        """True if the rover drives at more than half of its speed."""
        return (motion := self.motion) is not None and abs(motion.speed_m_s) > SPEED_M_S / 2

    @property
    def stationary(self) -> bool:
        """True if the rover has moved before but is now stationary."""
        return (motion := self.motion) is not None and not motion.is_moving

    @property
    def place_m(self) -> Vector:
        """Position of the rover."""
        return self.track_m(0)[-1]

    def track_m(self, since_ns: int) -> list[Vector]:
        """Positions of the rover since a UTC time in ns."""
        track = self.field_robots.testbed.oracle.track(0)
        return [
            position.position_m
            for position in track
            if position.role is Role.SENDER and position.utc_ns >= since_ns and position.position_m is not None
        ]

    def place_at(self, distance: str) -> None:
        """Place the stationary rover at a distance from the box, as a person would carry it."""
        self.field_robots.testbed.place(Placement(Scenario.LOS, Topology.MASTERLESS, parse_distance(distance)))

    def wait_until_it_drives(self, process: "subprocess.Popen[str]") -> None:
        """Wait until the rover drives in a started run; raise AssertionError if the run ends earlier."""
        wait_during(process, lambda: self.drives, within_s=2 * LONG_S)

    def drive_forward(self, distance_m: float) -> None:
        """Drive the rover forward with its velocity topic, as a remote control would."""
        start_m = self.place_m
        topic = ("rostopic", "pub", "-r", "10", "/cmd_vel", "geometry_msgs/Twist", "{linear: {x: 1.0}}")
        argv = ("sh", "-c", '"$@" & cat >/dev/null; kill $!', "sh", *with_environment(topic, setup=_SETUP))
        session = self.field_robots.testbed.shells[Role.SENDER].begin(argv, deadline=Deadline.after(LONG_S))
        wait_until(lambda: math.dist(self.place_m, start_m) > distance_m, Deadline.after(LONG_S))
        session.end(deadline=Deadline.after(LONG_S), check=False)
        wait_until(lambda: self.stationary, Deadline.after(LONG_S))

    def write_procedure(self, role: Role, path_m: float) -> None:
        """Write the procedure `drive`, in which the robot of a role moves."""
        wait_s = path_m / SPEED_M_S + 1.0  # it returns after the inner steps
        text = _DRIVE.format(role=role, path_m=path_m, wait_s=wait_s, speed_m_s=SPEED_M_S)
        (self.folder / "procedures").mkdir(exist_ok=True)
        (self.folder / "procedures" / "drive.yaml").write_text(text, encoding="utf-8")


@contextmanager
def rover_lab(folder: Path, *, fence_m: float = 30.0, lease_s: float = 2.0) -> Iterator[RoverLab]:
    """Yield the lab in an empty folder; it stops at the latest when the calling thread ends."""
    (folder / "robots").mkdir()
    (folder / "robots" / "rover.yaml").write_text(rover_profile(fence_m=fence_m, lease_s=lease_s), encoding="utf-8")
    (folder / "robots" / "box.yaml").write_text(BOX, encoding="utf-8")
    (folder / "lab.yaml").write_text(_SITE, encoding="utf-8")
    with chdir(folder), start_field_robots(folder, site=folder / "lab.yaml") as field_robots:
        site = (folder / SITE_FILE).read_text(encoding="utf-8")
        receiver_site = replace_text(site, _ROLES, "roles: {masterless: {sender: box-1, receiver: rover-1}}")
        (folder / RECEIVER_SITE).write_text(receiver_site, encoding="utf-8")
        yield RoverLab(field_robots)
