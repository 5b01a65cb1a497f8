"""The co-simulated medium between real namespaces: every policy, delays, motion in physics simulators, lateness."""

import csv
import math
import os
import re
import shlex
import signal
import socket
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import RobotError, TestbedLostError
from fieldkit.core.model import Lateness, Vector
from fieldkit.measure.evidence import oracle_delays
from sim_backends.cosim.policies.registry import BUILTIN
from sim_backends.emulated.cosimulated.clock import RealTime
from sim_backends.emulated.cosimulated.cosim_process import CosimulatedMedium
from sim_backends.emulated.cosimulated.cosim_session import CosimSession
from sim_backends.emulated.emulated_options import SyncOptions
from sim_backends.emulated.medium import air_files
from sim_backends.emulated.medium.server import Layout
from sim_backends.emulated.robot.spec import ANTENNA_M
from sim_backends.emulated.ros.motion_record import SILENT_NS
from sim_backends.federates.frames import NETWORK
from sim_backends.federates.named import command_line, default_options
from sim_backends.world.motion import State
from sim_backends.world.world import load_world
from tests.helpers.cosim_benches import BODY, PLACES, cosim_bench, distance_m
from tests.helpers.nightly import mark_nightly
from tests.helpers.sshd import wait_until

pytestmark = pytest.mark.emulated


@pytest.mark.parametrize("policy", BUILTIN)
def test_pings_cross_the_network_with_every_policy(policy: str, tmp_path: Path) -> None:
    sync = SyncOptions.model_validate({"name": policy, "window": "5ms"})
    with cosim_bench(tmp_path, sync=sync) as bench:
        endpoints = "a", "b", socket.IPPROTO_ICMP, 0
        bench.medium.delays(*endpoints)
        assert len(bench.ping()) == 20
        stats = bench.medium.stats()
        assert stats.ports["b"].delivered_packets == 20
        assert stats.links["a", "b"].delivered == 20
        assert sum(stats.packet_lateness_counts.values()) == 40
        assert sum(stats.window_lateness_counts.values()) > 2


def test_a_recording_of_the_air_continues_in_a_new_session(tmp_path: Path) -> None:
    """A relay makes the medium start a new session."""
    with cosim_bench(tmp_path) as bench:
        bench.medium.record(tmp_path)
        bench.ping(count=2)
        bench.medium.place(PLACES, relay="b")
        bench.ping(count=3)
        bench.medium.record(None)
    with (tmp_path / air_files.CSV).open(encoding="ascii", newline="") as file:
        frames = [(line["transmitter"], line["size_bytes"], line["attempt"]) for line in csv.DictReader(file)]
    assert frames.count(("a", str(84 + 36), "1")) == 5, "a packet of ping, with the headers of Wi-Fi"


def test_ns3_carries_unicast_and_broadcast_packets(tmp_path: Path) -> None:
    network = command_line("ns3", NETWORK)
    options = default_options("ns3", NETWORK)
    with cosim_bench(tmp_path, network=network, network_options=options) as bench:
        assert len(bench.ping()) == 20
        delays = bench.medium.stats().delays["a", "b"]
        (sample,) = bench.medium.links(continue_sampling=False)["a"]
        bench.ping("-b", count=3, address="10.9.0.255")
        stats = bench.medium.stats()
        assert stats.ports["b"].delivered_packets == 23
        assert stats.ports["a"].delivered_packets == 20
    assert delays.packets == 20
    assert 20 * 30_000 < delays.transmission_ns < 20 * 20_000_000, "84 bytes, from 65 Mbit/s to 1 Mbit/s with retries"
    assert 20 * 20 < delays.propagation_ns < 20 * 40, "9 m at the speed of light"
    (peer,) = sample.stations
    assert (peer.station, peer.tx_packets, peer.rx_packets, peer.tx_failures) == ("b", 20, 20, 0)
    assert peer.tx_rate_bit_s is not None
    assert peer.rx_rate_bit_s is not None
    assert 1e6 <= min(peer.tx_rate_bit_s, peer.rx_rate_bit_s) <= 65e6
    assert sample.busy_ns is not None
    assert sample.active_ns is not None
    assert delays.transmission_ns < sample.busy_ns < sample.active_ns
    (tmp_path / "builtin").mkdir()
    with cosim_bench(tmp_path / "builtin") as bench:
        (expected,) = bench.medium.links(continue_sampling=False)["a"]
    assert peer.signal_dbm == pytest.approx(expected.stations[0].signal_dbm, abs=1e-6)
    assert sample.noise_dbm == pytest.approx(expected.noise_dbm)


DISC = """
import sys, time
from sim_backends.federates.serving import serve
from sim_backends.network.disc import Disc

class Slow(Disc):
    def __init__(self, hello):
        super().__init__(1e5, 30_000_000)

    def advance(self, *request):
        time.sleep(float(sys.argv[1]))
        return super().advance(*request)

serve(Slow, name="slow")
"""
SEND = """
import socket, time
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as speaker:
    for _ in range(20):
        speaker.sendto(b"hello", ("10.9.0.2", 7000))
        time.sleep(0.013)
"""


def disc_command(folder: Path, answer_s: float) -> str:
    """Return the command of a network with a delay of 30 ms that needs `answer_s` for each answer."""
    program = folder / "slow.py"
    program.write_text(DISC, encoding="utf-8")
    return shlex.join((sys.executable, str(program), str(answer_s)))


def test_the_delay_of_the_network_and_of_the_policy_are_separate(tmp_path: Path) -> None:
    """Packets arrive within windows of 20 ms: they wait for 10 ms on average."""
    sync = SyncOptions.model_validate({"name": "sliding_window", "window": "20ms"})
    with cosim_bench(tmp_path, network=disc_command(tmp_path, 0), sync=sync) as bench:
        endpoints = "a", "b", socket.IPPROTO_UDP, 7000
        bench.medium.delays(*endpoints)
        bench.spaces["a"].run(sys.executable, "-c", SEND)
        wait_until(lambda: bench.medium.delays(*endpoints).packets == 20, Deadline.after(30))
        delays = bench.medium.delays(*endpoints)
        assert delays.undivided_ns == 20 * 30_000_000
        assert delays.policy_ns is not None
        assert 4e6 < delays.policy_ns / delays.packets < 16e6


def test_a_network_that_cannot_keep_up_makes_packets_and_windows_late(tmp_path: Path) -> None:
    """Each window of 1 ms takes 20 ms. A lag of more than 1 s is skipped, so that the lab still answers."""
    sync = SyncOptions.model_validate({"name": "sliding_window", "window": "1ms"})
    with cosim_bench(tmp_path, network=disc_command(tmp_path, 0.02), sync=sync) as bench:
        wait_until(
            lambda: max(bench.medium.stats().window_lateness_counts, default=0) > 100_000_000, Deadline.after(60)
        )
        bench.ping(count=2)
        stats = bench.medium.stats()
        assert max(stats.packet_lateness_counts) > 100_000_000
        lateness = Lateness(bound_ns=100_000_000, packets={}, windows=stats.window_lateness_counts)
        reason = oracle_delays.lateness_problem(lateness)
        assert reason is not None
        assert re.fullmatch(r"\d+ windows? of the .* too late, by up to [\d.e+]+ ms; the bound is 100 ms", reason)
        text = oracle_delays.lateness_text(Lateness(bound_ns=100_000_000, packets={}, windows={}), lateness)
        (tmp_path / "lateness.txt").write_text(text, encoding="ascii")
        assert oracle_delays.read_lateness(tmp_path / "lateness.txt") == lateness


def test_a_broadcast_is_delivered_unless_a_station_has_no_place(tmp_path: Path) -> None:
    with cosim_bench(tmp_path) as bench:
        assert len(bench.ping("-b", count=3, address="10.9.0.255")) <= 3
        assert bench.medium.stats().links["a", "b"].delivered == 3
        bench.medium.place({"a": PLACES["a"]})
        assert not bench.ping(count=2)
        bench.medium.place(PLACES)
        assert bench.ping(count=3)


@pytest.mark.parametrize("physics", ["kinematic", "mujoco"])
def test_a_robot_stops_at_the_wall_and_can_be_placed_elsewhere(physics: str, tmp_path: Path) -> None:
    """The wall of the lawn begins at 3.9 m; the chassis of MuJoCo is shorter than the cylinder that contains it."""
    places_m: dict[str, Vector] = {**PLACES, "a": (3.6, 18.0, ANTENNA_M)}
    with cosim_bench(tmp_path, physics=physics, world=load_world("lawn"), places_m=places_m) as bench:
        motion_at_wall = bench.control_files.drive(0.2, 3.0)
        assert 3.9 - BODY.limits.radius_m - 0.02 < motion_at_wall.position_m[0] < 3.9
        assert not math.hypot(*motion_at_wall.velocity_m_s) > 0.02
        places_m["a"] = PLACES["a"]
        bench.control_files.assign(places_m["a"], facing_rad=math.pi / 2)
        bench.medium.place(places_m)
        later_motion = bench.control_files.drive(0.2, 1.0)
        assert later_motion.position_m[0] == pytest.approx(PLACES["a"][0], abs=0.02)
        assert later_motion.position_m[1] == pytest.approx(PLACES["a"][1] + 0.2, abs=0.1)
        assert bench.ping(count=3)


@pytest.mark.parametrize("physics", mark_nightly(["mujoco", "kinematic"]))
def test_a_robot_stops_if_its_physics_is_suspended_or_killed(physics: str, tmp_path: Path) -> None:
    """Its sensors and the lab extrapolate the last record for `SILENT_NS`; afterwards it is at rest."""
    with cosim_bench(tmp_path, physics=physics) as bench:
        pid = bench.medium.pid
        bench.control_files.drive(0.2, 1.0)
        os.kill(pid, signal.SIGSTOP)
        last_motion = bench.control_files.drive(0.2, SILENT_NS / 1e9)
        assert last_motion.is_moving
        motion_at_rest = last_motion.at(time.monotonic_ns() + SILENT_NS)
        assert not motion_at_rest.is_moving
        assert distance_m(motion_at_rest, last_motion.position_m) <= 0.2 * SILENT_NS / 1e9 + 0.01
        os.kill(pid, signal.SIGCONT)
        wait_until(
            lambda: (motion := bench.control_files.motion()) is not None and not motion.is_moving, Deadline.after(60)
        )
        wait_until(lambda: bench.control_files.drive(0.2, 0.5).is_moving, Deadline.after(60))
        os.kill(pid, signal.SIGKILL)
        with pytest.raises(TestbedLostError, match="killed by SIGKILL"):
            bench.medium.place(PLACES)
        motion = bench.control_files.drive(0.2, SILENT_NS / 1e9)
        assert not motion.at(time.monotonic_ns() + SILENT_NS).is_moving


def test_a_robot_cannot_be_placed_within_the_wall(tmp_path: Path) -> None:
    with cosim_bench(tmp_path, world=load_world("lawn")) as bench:
        wall_place_m = 4.0, 18.0, ANTENNA_M
        bench.control_files.assign(wall_place_m)
        with pytest.raises(RobotError, match="a would be within wall, at 4, 18"):
            bench.medium.place({**PLACES, "a": wall_place_m})


def test_a_driven_robot_stops_without_commands_and_at_its_next_place(tmp_path: Path) -> None:
    with cosim_bench(tmp_path) as bench:
        later_motion = bench.control_files.drive(0.2, 1.0)
        assert distance_m(later_motion, PLACES["a"]) == pytest.approx(0.2, abs=0.1)
        assert later_motion.heading_rad == pytest.approx(0)
        assert later_motion.odometry[0] == pytest.approx(distance_m(later_motion, PLACES["a"]))


def test_a_slow_placement_does_not_delay_simulated_time() -> None:
    def place(_states: Mapping[str, State], _on_air: frozenset[str]) -> None:
        time.sleep(0.02)

    medium = object.__new__(CosimulatedMedium)
    medium._clock, medium._ports, medium._layout = RealTime(), {}, Layout()
    session = SimpleNamespace(stations=(), settings=SimpleNamespace(relay=None), physics=SimpleNamespace(place=place))
    medium._session = cast("CosimSession", session)
    epoch_ns = medium._clock.epoch_ns
    medium._place_stations({}, None)
    assert medium._clock.epoch_ns == epoch_ns, "windows would end early, and packets would be late by less"
