"""MAVSDK and MAVProxy, independent programs, fly the emulated drone from another robot over the medium."""

import json
import math
import sys
from collections.abc import Iterator
from typing import Any

import pytest

from fieldkit.core.deadline import Deadline
from fieldkit.core.model import Placement, Role, Scenario, Topology
from fieldkit.core.units import parse_distance
from sim_backends.emulated import testbed
from sim_backends.emulated.backend import EmulatedBackend
from sim_backends.emulated.emulated_options import EmulatedOptions, RosChoice
from sim_backends.emulated.testbed import EmulatedTestbed
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.world import load_world
from tests.helpers.paths import ROOT

pytestmark = pytest.mark.emulated

LOSS = "0.05"
"""Loss in each direction."""


@pytest.fixture
def emulation(request: pytest.FixtureRequest) -> Iterator[EmulatedTestbed]:
    """The robots of the paper; the parameter is the physics simulator, by default that of the autopilot."""
    with testbed.bring_up(
        EmulatedBackend(None, None).cast(Topology.MASTER),
        options=EmulatedOptions(radio=RadioOptions(fading=False), physics=getattr(request, "param", None)),
        world=load_world("lawn"),
        ros=RosChoice.BUILTIN,
        seed=1,
    ) as robots:
        robots.place(Placement(Scenario.LOS, Topology.MASTER, parse_distance("5m")))
        yield robots


def fly(emulation: EmulatedTestbed, program: str) -> dict[str, Any]:
    """Let a program on the sender's robot fly the drone; return its report."""
    drone = emulation.robots[Role.RELAY].spec
    sent_before = emulation.medium.stats().ports[drone.name].sent_packets
    words = (sys.executable, "-m", f"tests.helpers.{program}", drone.ip, str(drone.mavlink_port), LOSS)
    argv = ("env", f"PYTHONPATH={ROOT}", *words)
    result = emulation.shells[Role.SENDER].run(argv, deadline=Deadline.after(240))
    assert emulation.medium.stats().ports[drone.name].sent_packets - sent_before > 100
    log = emulation.shells[Role.RELAY].run(("cat", "/run/robot/autopilot.log"), deadline=Deadline.after(10))
    assert log.stdout == b""
    report: dict[str, Any] = json.loads(result.stdout.decode().splitlines()[-1])
    assert max(report["nearest_m"]) < 0.5
    return report


def test_mavsdk_flies_a_mission_of_three_points_although_every_twentieth_datagram_is_lost(
    emulation: EmulatedTestbed,
) -> None:
    report = fly(emulation, "mavsdk_flight")
    assert report["items"] == 3
    assert 90 <= report["battery"] < 100.1
    # The lab recorded the same flight, down to the ground below its last corner.
    path_m = [
        point.position_m for point in emulation.oracle.track(0) if point.role is Role.RELAY and point.position_m
    ]
    (east_m, north_m, up_m), last_m = path_m[0], path_m[-1]
    assert max(point[2] for point in path_m) - up_m == pytest.approx(1.0, abs=0.2)
    assert min(math.dist(point[:2], (east_m + 2.0, north_m + 2.0)) for point in path_m) < 0.5
    assert math.dist(last_m, (east_m, north_m + 2.0, up_m)) < 0.6


@pytest.mark.parametrize("emulation", ["kinematic"], indirect=True)
def test_mavproxy_flies_a_mission_although_every_twentieth_datagram_is_lost(emulation: EmulatedTestbed) -> None:
    report = fly(emulation, "mavproxy_flight")
    assert report["height_m"] < 0.2
    for text in ("Loaded 4 waypoints in ", "COMPONENT_ARM_DISARM: ACCEPTED", "DISARMED"):
        assert text in report["output"]
