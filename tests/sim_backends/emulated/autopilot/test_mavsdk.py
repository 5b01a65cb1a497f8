"""MAVSDK, which knows nothing of us, flies the emulated drone from another robot, across the medium."""

import json
import sys
from collections.abc import Iterator

import pytest

from fieldkit.core.deadline import Deadline
from fieldkit.core.model import Placement, Role, Scenario, Topology
from fieldkit.core.units import parse_distance
from sim_backends.emulated import testbed
from sim_backends.emulated.backend import EmulatedBackend
from sim_backends.emulated.options import EmulatedOptions, RosChoice
from sim_backends.emulated.testbed import EmulatedTestbed
from sim_backends.radio.options import RadioOptions
from sim_backends.world.world import load_world
from tests.helpers.paths import ROOT

pytestmark = pytest.mark.emulated

FLIGHT = str(ROOT / "tests/helpers/mavsdk_flight.py")
LOSS = "0.05"


@pytest.fixture
def up() -> Iterator[EmulatedTestbed]:
    with testbed.bring_up(
        EmulatedBackend(None, None).cast(Topology.MASTER),
        options=EmulatedOptions(radio=RadioOptions(fading=False)),
        world=load_world("lawn"),
        ros=RosChoice.BUILTIN,
        seed=1,
    ) as robots:
        robots.place(Placement(Scenario.LOS, Topology.MASTER, parse_distance("5m")))
        yield robots


def test_a_mission_of_three_points_where_every_twentieth_datagram_is_lost(up: EmulatedTestbed) -> None:
    drone = up.robots[Role.RELAY].spec
    assert drone.mavlink_port is not None
    carried = up.medium.stats().ports[drone.name].read
    argv = (sys.executable, FLIGHT, drone.ip, str(drone.mavlink_port), LOSS)
    done = up.shells[Role.SENDER].run(argv, deadline=Deadline.after(150))
    seen = json.loads(done.stdout.decode().splitlines()[-1])
    assert max(seen["nearest_m"]) < 0.5
    assert seen["items"] == 3
    assert 90 <= seen["battery"] < 100.1
    assert up.medium.stats().ports[drone.name].read - carried > 100
    log = up.shells[Role.RELAY].run(("cat", "/run/robot/autopilot.log"), deadline=Deadline.after(10))
    assert log.stdout == b""
