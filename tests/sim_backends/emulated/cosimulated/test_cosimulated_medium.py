"""The co-simulated medium between real namespaces: every policy, delays, motion by the physics, lateness."""

import math
import socket
from pathlib import Path

import pytest

from fieldkit.core.errors import ConfigurationError, RobotError
from fieldkit.core.model import Vector
from sim_backends.cosim.policies.registry import BUILTIN
from sim_backends.emulated.emulated_options import SyncOptions
from sim_backends.emulated.robot.spec import ANTENNA_M
from sim_backends.federates.frames import NETWORK
from sim_backends.federates.named import command_line
from sim_backends.world.world import load_world
from tests.helpers.cosim_benches import BODY, PLACES, cosim_bench, distance_m

pytestmark = pytest.mark.emulated


@pytest.mark.parametrize("policy", BUILTIN)
def test_pings_cross_the_network_with_every_policy(policy: str, tmp_path: Path) -> None:
    sync = SyncOptions.model_validate({"name": policy, "window": "5ms"})
    with cosim_bench(tmp_path, sync=sync) as bench:
        ends = "a", "b", socket.IPPROTO_ICMP, 0
        bench.medium.delays(*ends)
        assert len(bench.ping()) == 20
        stats = bench.medium.stats()
        assert stats.ports["b"].written == 20
        assert stats.links["a", "b"].delivered == 20
        assert sum(stats.late.values()) == 40
        assert sum(stats.late_windows.values()) > 2


def test_ns3_carries_unicast_and_broadcast_packets(tmp_path: Path) -> None:
    try:
        network = command_line("ns3", NETWORK)
    except ConfigurationError as error:
        pytest.skip(error.what)
    with cosim_bench(tmp_path, network=network) as bench:
        assert len(bench.ping()) == 20
        bench.ping("-b", count=3, address="10.9.0.255")
        stats = bench.medium.stats()
        assert stats.ports["b"].written == 23
        assert stats.ports["a"].written == 20


def test_the_delay_of_the_network_and_of_the_policy_are_separate(tmp_path: Path) -> None:
    """With a window of 20 ms a packet waits for 10 ms on average, and the network takes less than 2 ms."""
    sync = SyncOptions.model_validate({"name": "sliding_window", "window": "20ms"})
    with cosim_bench(tmp_path, sync=sync) as bench:
        listener = bench.spaces["b"].start("ncat", "-l", "7000")
        ends = "a", "b", socket.IPPROTO_TCP, 7000
        bench.medium.delays(*ends)
        rtt_ms = bench.ping()
        assert 15 < sum(rtt_ms) / len(rtt_ms) < 60
        listener.kill()
        listener.communicate()


def test_a_multicast_and_a_station_out_of_range(tmp_path: Path) -> None:
    with cosim_bench(tmp_path) as bench:
        assert len(bench.ping("-b", count=3, address="10.9.0.255")) <= 3
        assert bench.medium.stats().links["a", "b"].delivered == 3
        bench.medium.place({"a": PLACES["a"]})
        assert not bench.ping(count=2)
        bench.medium.place(PLACES)
        assert bench.ping(count=3)


@pytest.mark.parametrize("physics", ["kinematic", "mujoco"])
def test_a_robot_hits_the_wall_and_is_put_elsewhere(physics: str, tmp_path: Path) -> None:
    """The wall of the lawn begins at 3.9 m; the chassis of MuJoCo is shorter than the cylinder that contains it."""
    if physics == "mujoco":
        pytest.importorskip("mujoco")
    places_m: dict[str, Vector] = {**PLACES, "a": (3.6, 18.0, ANTENNA_M)}
    with cosim_bench(tmp_path, physics=physics, world=load_world("lawn"), places_m=places_m) as bench:
        stopped = bench.driven.drive(0.2, 3.0)
        assert 3.9 - BODY.limits.radius_m - 0.02 < stopped.place_m[0] < 3.9
        assert not math.hypot(*stopped.velocity_m_s) > 0.02
        places_m["a"] = PLACES["a"]
        bench.driven.assign(places_m["a"], facing_rad=math.pi / 2)
        bench.medium.place(places_m)
        moved = bench.driven.drive(0.2, 1.0)
        assert moved.place_m[0] == pytest.approx(PLACES["a"][0], abs=0.02)
        assert moved.place_m[1] == pytest.approx(PLACES["a"][1] + 0.2, abs=0.1)
        assert bench.ping(count=3)


def test_a_robot_cannot_be_put_into_the_wall(tmp_path: Path) -> None:
    with cosim_bench(tmp_path, world=load_world("lawn")) as bench:
        inside_m = 4.0, 18.0, ANTENNA_M
        bench.driven.assign(inside_m)
        with pytest.raises(RobotError, match="a would be within wall, at 4, 18"):
            bench.medium.place({**PLACES, "a": inside_m})


def test_a_driven_robot_stops_without_commands_and_at_its_next_place(tmp_path: Path) -> None:
    with cosim_bench(tmp_path) as bench:
        moved = bench.driven.drive(0.2, 1.0)
        assert distance_m(moved, PLACES["a"]) == pytest.approx(0.2, abs=0.1)
        assert moved.heading_rad == pytest.approx(0)
        assert moved.odometry[0] == pytest.approx(distance_m(moved, PLACES["a"]))
