"""Emulated robots that the test starts, so that they still run after fieldkit has ended.

The field backend reaches them over loopback.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fieldkit.backends.protocols import Cast
from fieldkit.config.locations import SITE_FILE
from fieldkit.config.site import load_site
from fieldkit.core.deadline import Deadline
from fieldkit.core.model import Placement, Role, Scenario, Topology
from fieldkit.core.prompts import Unattended
from fieldkit.core.units import parse_distance
from sim_backends.emulated.backend import EmulatedBackend
from sim_backends.emulated.robot import ssh_server
from sim_backends.emulated.testbed import EmulatedTestbed
from tests.helpers.forwarder import Forwarder
from tests.helpers.labs import built_in_ros
from tests.helpers.sshd import make_key

_HIDE_SUDO: Final = 'sudo=$(command -v sudo) || exit 0; mount --bind /dev/null "$sudo"'
"""Robots share the programs of this machine, but they have no sudo, so that results do not depend on this machine."""


@dataclass(frozen=True)
class FieldRobots:
    """Running robots on the emulated medium, as a field deployment would provide them.

    Attributes:
        folder: Folder with `fieldkit.yaml` for the field backend and with the login key; run fieldkit here.
        cast: The robot of each role.
        testbed: The robots and their medium; inject faults here. Its `shells` reach robots whose link is cut.
        links: The forwarder to each robot's SSH server, with `cut`, `restore` and `drop`.
    """

    folder: Path
    cast: Cast
    testbed: EmulatedTestbed
    links: Forwarder[Role]


@contextmanager
def start_field_robots(
    folder: Path, *, topology: Topology = Topology.MASTERLESS, site: Path | None = None, distance: str = "5m"
) -> Iterator[FieldRobots]:
    """Yield the placed robots of an emulated testbed, and write a site file to `folder` that reaches them by SSH.

    The robots stop at the latest when the calling thread ends, so the thread must live as long as the test.

    Args:
        folder: The folder for the site files and the key.
        topology: The topology of the robots to start.
        site: Site file of the emulated testbed; if None, robots as in `built_in_ros` are used.
        distance: Distance between the robots, in line of sight; `testbed.place` changes it.
    """
    backend = EmulatedBackend(*load_site(site or built_in_ros(folder, "robots.yaml")))
    cast = backend.cast(topology)
    with backend.open(cast, seed=1, sink=lambda _: None, operator=Unattended()) as testbed:
        assert isinstance(testbed, EmulatedTestbed)
        testbed.place(Placement(Scenario.LOS, topology, parse_distance(distance)))
        for shell in testbed.shells.values():
            shell.run(("sh", "-c", _HIDE_SUDO), deadline=Deadline.after(30))
        with Forwarder({role: robot.connect for role, robot in testbed.robots.items()}) as links:
            field_robots = FieldRobots(folder, cast, testbed, links)
            (folder / SITE_FILE).write_text(_site(field_robots, topology), encoding="utf-8")
            yield field_robots


def _site(field_robots: FieldRobots, topology: Topology) -> str:
    key = field_robots.folder / "login"
    authorized = make_key(key)
    lines = ["backend: field", "robots:"]
    for role, robot in field_robots.cast.items():
        host_key = _authorize(field_robots.testbed, role, authorized)
        access = (
            f"host: 127.0.0.1, port: {field_robots.links.port(role)}, user: root, key: {key}, host_key: {host_key}"
        )
        lines.append(f"  {robot.name}: {{profile: {robot.profile.name}, address: {robot.address}, {access}}}")
    roles = ", ".join(f"{role}: {robot.name}" for role, robot in field_robots.cast.items())
    return "\n".join([*lines, f"roles: {{{topology}: {{{roles}}}}}"]) + "\n"


def _authorize(testbed: EmulatedTestbed, role: Role, authorized: str) -> str:
    """Authorize a key to log in to a robot; return the robot's host key."""
    script = 'cat >>"$HOME/.ssh/authorized_keys" && ssh-keygen -y -f "$1"'
    argv = ("sh", "-c", script, "sh", ssh_server.HOST_KEY)
    completed = testbed.shells[role].run(argv, stdin=authorized.encode(), deadline=Deadline.after(30))
    return " ".join(completed.stdout.decode().split()[:2])
