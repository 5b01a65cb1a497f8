"""A lab whose ground robot drives by itself and is a real one for fieldkit: `rover-1`, and `box-1` beside it."""

import math
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
from sim_backends.emulated.ros.steered import Steered
from tests.helpers.labs import BOX, changed
from tests.helpers.outside import Outside, robots_outside
from tests.helpers.paths import ROOT
from tests.helpers.sshd import wait_until

LONG_S: Final = 90.0
SPEED_M_S: Final = 0.6
_SITE: Final = """\
backend: emulated
robots:
  rover-1: {profile: rover}
  box-1: {profile: box}
roles:
  masterless: {sender: rover-1, receiver: box-1}
emulated: {ros: auto}
"""
_ROLES: Final = "roles: {masterless: {sender: rover-1, receiver: box-1}}"
RECEIVER_SITE: Final = "receiver.yaml"
"""Site file in which the rover is the receiver, which keeps its place at all distances."""
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
      path: [{{away: {way_m:g}m}}]
      speed: {speed_m_s:g}m/s
      during: [{{wait: {{duration: {inside_s:.1f}s}}}}]
"""
_SETUP: Final = ("/opt/ros/noetic/setup.bash",)


def rover_profile(*, fence_m: float, ros: str = "ros1", lease_s: float = 2.0, acceleration_m_s2: float = 2.0) -> str:
    """Return the profile `rover`: a TurtleBot3 that is fast, so that tests take less time."""
    return changed(
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
        outside: Its robots; `outside.folder` has `fieldkit.yaml` and `receiver.yaml`.
    """

    outside: Outside

    @property
    def folder(self) -> Path:
        """Where fieldkit is run."""
        return self.outside.folder

    @property
    def motion(self) -> Steered | None:
        """Motion of the rover as its base reports it to the lab; None before its first."""
        return self.outside.testbed.robots[Role.SENDER].steered()

    @property
    def drives(self) -> bool:
        """Whether the rover drives at more than half of its speed."""
        return (now := self.motion) is not None and abs(now.speed_m_s) > SPEED_M_S / 2

    @property
    def stationary(self) -> bool:
        """Whether the rover has moved before, and does not now."""
        return (now := self.motion) is not None and not now.moves

    @property
    def place_m(self) -> Vector:
        """Where the rover is."""
        return self.track_m(0)[-1]

    def track_m(self, since_ns: int) -> list[Vector]:
        """Return the places of the rover from a time on, in nanoseconds since 1970 UTC."""
        track = self.outside.testbed.oracle.track(0)
        return [
            where.position_m
            for where in track
            if where.role is Role.SENDER and where.utc_ns >= since_ns and where.position_m is not None
        ]

    def put(self, distance: str) -> None:
        """Carry the rover to a distance from the box, as a person does; it is stationary before."""
        self.outside.testbed.place(Placement(Scenario.LOS, Topology.MASTERLESS, parse_distance(distance)))

    def wait_until_it_drives(self) -> None:
        """Return when the rover drives."""
        wait_until(lambda: self.drives, Deadline.after(LONG_S))

    def push(self, distance_m: float) -> None:
        """Drive the rover ahead by its velocity topic, as somebody does with a remote control."""
        begin_m = self.place_m
        topic = ("rostopic", "pub", "-r", "10", "/cmd_vel", "geometry_msgs/Twist", "{linear: {x: 1.0}}")
        words = ("sh", "-c", '"$@" & cat >/dev/null; kill $!', "sh", *with_environment(topic, setup=_SETUP))
        session = self.outside.testbed.shells[Role.SENDER].begin(words, deadline=Deadline.after(LONG_S))
        wait_until(lambda: math.dist(self.place_m, begin_m) > distance_m, Deadline.after(LONG_S))
        session.end(deadline=Deadline.after(LONG_S), check=False)
        wait_until(lambda: self.stationary, Deadline.after(LONG_S))

    def write_procedure(self, role: Role, way_m: float) -> None:
        """Write the procedure `drive`, in which a role moves."""
        inside_s = way_m / SPEED_M_S + 1.0  # it turns back when the steps inside have ended
        text = _DRIVE.format(role=role, way_m=way_m, inside_s=inside_s, speed_m_s=SPEED_M_S)
        (self.folder / "procedures").mkdir(exist_ok=True)
        (self.folder / "procedures" / "drive.yaml").write_text(text, encoding="utf-8")


@contextmanager
def rover_lab(folder: Path, *, fence_m: float = 30.0, lease_s: float = 2.0) -> Iterator[RoverLab]:
    """Yield the lab, in an empty folder; it ends with the calling thread at the latest."""
    (folder / "robots").mkdir()
    (folder / "robots" / "rover.yaml").write_text(rover_profile(fence_m=fence_m, lease_s=lease_s), encoding="utf-8")
    (folder / "robots" / "box.yaml").write_text(BOX, encoding="utf-8")
    (folder / "lab.yaml").write_text(_SITE, encoding="utf-8")
    with chdir(folder), robots_outside(folder, site=folder / "lab.yaml") as outside:
        site = (folder / SITE_FILE).read_text(encoding="utf-8")
        swapped = changed(site, _ROLES, "roles: {masterless: {sender: box-1, receiver: rover-1}}")
        (folder / RECEIVER_SITE).write_text(swapped, encoding="utf-8")
        yield RoverLab(outside)
