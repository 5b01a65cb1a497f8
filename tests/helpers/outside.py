"""Emulated robots that outlive fieldkit: the test holds them, the field backend reaches them over loopback ports."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from fieldkit.backends.protocols import Cast
from fieldkit.config.locations import SITE_FILE
from fieldkit.config.site import load_site
from fieldkit.core.deadline import Deadline
from fieldkit.core.model import Placement, Role, Scenario, Topology
from fieldkit.core.prompts import Nobody
from fieldkit.core.units import parse_distance
from sim_backends.emulated.backend import EmulatedBackend
from sim_backends.emulated.robot import ssh_server
from sim_backends.emulated.testbed import EmulatedTestbed
from tests.helpers.forwarder import Forwarder
from tests.helpers.labs import built_in_ros
from tests.helpers.sshd import make_key


@dataclass(frozen=True)
class Outside:
    """Robots on the air, as the field has them.

    Attributes:
        folder: Where `fieldkit.yaml` for the field backend and the login key are; run fieldkit here.
        cast: Who plays which role.
        testbed: The robots and their medium: faults go in here; its `shells` reach robots whose link is cut.
        links: The way to each robot's SSH server: `cut`, `restore` and `drop` it.
    """

    folder: Path
    cast: Cast
    testbed: EmulatedTestbed
    links: Forwarder[Role]


@contextmanager
def robots_outside(
    folder: Path, *, topology: Topology = Topology.MASTERLESS, site: Path | None = None, distance: str = "5m"
) -> Iterator[Outside]:
    """Yield the robots of an emulated testbed, placed, with a site file in `folder` that reaches them by SSH.

    They end with the calling thread at the latest, so call this in one that lives as long as the test.

    Args:
        folder: Gets the site files and the key.
        topology: Whose robots to bring up.
        site: Site file of the emulated testbed; without one, robots as `built_in_ros` has them.
        distance: How far apart they stand, in line of sight; `testbed.place` moves them.
    """
    backend = EmulatedBackend(*load_site(site or built_in_ros(folder, "robots.yaml")))
    cast = backend.cast(topology)
    with backend.open(cast, seed=1, sink=lambda _: None, operator=Nobody()) as testbed:
        assert isinstance(testbed, EmulatedTestbed)
        testbed.place(Placement(Scenario.LOS, topology, parse_distance(distance)))
        with Forwarder({role: robot.connect for role, robot in testbed.robots.items()}) as links:
            outside = Outside(folder, cast, testbed, links)
            (folder / SITE_FILE).write_text(_site(outside, topology), encoding="utf-8")
            yield outside


def _site(outside: Outside, topology: Topology) -> str:
    key = outside.folder / "login"
    authorized = make_key(key)
    lines = ["backend: field", "robots:"]
    for role, robot in outside.cast.items():
        pinned = _let_in(outside.testbed, role, authorized)
        access = f"host: 127.0.0.1, port: {outside.links.port(role)}, user: root, key: {key}, host_key: {pinned}"
        lines.append(f"  {robot.name}: {{profile: {robot.profile.name}, address: {robot.address}, {access}}}")
    roles = ", ".join(f"{role}: {robot.name}" for role, robot in outside.cast.items())
    return "\n".join([*lines, f"roles: {{{topology}: {{{roles}}}}}"]) + "\n"


def _let_in(testbed: EmulatedTestbed, role: Role, authorized: str) -> str:
    """Let a key log in on a robot; return the robot's host key."""
    script = 'cat >>"$HOME/.ssh/authorized_keys" && ssh-keygen -y -f "$1"'
    argv = ("sh", "-c", script, "sh", ssh_server.HOST_KEY)
    done = testbed.shells[role].run(argv, stdin=authorized.encode(), deadline=Deadline.after(30))
    return " ".join(done.stdout.decode().split()[:2])
