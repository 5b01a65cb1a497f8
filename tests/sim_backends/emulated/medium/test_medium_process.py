"""The medium between real namespaces, with real tools; and its shutdown."""

import math
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
import scipy

from benchmarks.namespaces import Namespace
from fieldkit.config import schema
from fieldkit.config.profiles import Radio
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import ConfigurationError, LinkError, RobotError
from fieldkit.core.model import DelayParts, Vector
from sim_backends.emulated.medium.medium_client import MediumClient
from sim_backends.emulated.robot.tun_devices import open_tun
from sim_backends.radio.antennas import antenna_of
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.radio.world_channel import WorldChannel
from sim_backends.world.motion import Attitude
from tests.helpers.host import is_running
from tests.helpers.paths import ROOT
from tests.helpers.sshd import wait_until

pytestmark = pytest.mark.emulated

RADIO = Radio(interface="wlan0", standard="802.11g", tx_power_dbm=17, sensitivity_dbm=-82)
ADDRESSES = {"a": "10.9.0.1", "b": "10.9.0.2", "r": "10.9.0.3"}
PLACES: dict[str, Vector] = {"a": (0.0, 0.0, 0.0), "b": (9.0, 0.0, 0.0), "r": (4.5, 0.0, 0.0)}
PLAIN = "{loss: 0%, delay: 0ms, rate: unlimited}"
LONG_S = 60.0

LISTEN = """
import socket, struct, sys
group = socket.inet_aton("239.1.1.1") + socket.inet_aton(sys.argv[1])
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
    listener.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group)
    listener.bind(("", 7000))
    listener.settimeout(60)
    print("ready", flush=True)
    print(listener.recv(100).decode(), flush=True)
"""
SEND = """
import socket, sys
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as speaker:
    speaker.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
    speaker.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("10.9.0.1"))
    for _ in range(int(sys.argv[2])):
        speaker.sendto(b"hello", (sys.argv[1], 7000))
"""

NO_PACKETS = DelayParts(packets=0, processing_ns=0, transmission_ns=0, propagation_ns=0, queuing_ns=0)

Bench = Callable[[str], tuple[MediumClient, dict[str, Namespace]]]


@contextmanager
def benches() -> Iterator[Bench]:
    """Yield a function that makes three namespaces a, b, r on a medium with the given options."""
    with ExitStack() as stack:

        def make(text: str) -> tuple[MediumClient, dict[str, Namespace]]:
            options = schema.validate(schema.parse(text, source="radio.yaml"), RadioOptions)
            medium = stack.enter_context(MediumClient(options, seed=1))
            spaces = {name: stack.enter_context(Namespace()) for name in ADDRESSES}
            for name, space in spaces.items():
                fd = space.tun("wlan0", f"{ADDRESSES[name]}/24")
                medium.attach(name, f"{ADDRESSES[name]}/24", RADIO, fd)
                os.close(fd)
            return medium, spaces

        yield make


@pytest.fixture
def bench() -> Iterator[Bench]:
    with benches() as make:
        yield make


@pytest.fixture(scope="module")
def routed_namespaces() -> Iterator[tuple[MediumClient, dict[str, Namespace]]]:
    """Namespaces with default routes, for tests that depend on no counters."""
    with benches() as make:
        medium, spaces = make(PLAIN)
        for space in spaces.values():
            space.ip("route", "add", "default", "dev", "wlan0")
        yield medium, spaces


def ping(space: Namespace, address: str, *options: str, count: int = 20) -> list[float]:
    """Return the round-trip times in ms of the replies."""
    argv = ("ping", "-n", "-i", "0.01", "-W", "1", "-c", str(count), *options, address)
    return [float(value) for value in re.findall(r"time=([\d.]+)", space.run(*argv, timeout_s=60).stdout)]


def wait_for(condition: Callable[[], bool], condition_text: str) -> None:
    deadline = Deadline.after(LONG_S)
    while not condition():
        assert not deadline.expired, f"not within {LONG_S:g} s: {condition_text}"
        time.sleep(0.01)


def test_robots_ping_each_other_and_counters_agree(bench: Bench) -> None:
    medium, spaces = bench(PLAIN)
    medium.place(PLACES)
    assert len(ping(spaces["a"], ADDRESSES["b"])) == 20
    stats = medium.stats()
    assert stats.links["a", "b"].delivered == stats.links["b", "a"].delivered == 20
    assert ("a", "r") not in stats.links or stats.links["a", "r"].sent == 0
    assert stats.ports["b"].delivered_packets == 20
    assert stats.scheduling.startswith(("fifo", "normal"))
    assert len([*Path(f"/proc/{medium.pid}/task").iterdir()]) == 1, "numpy's OpenBLAS starts no threads in the medium"


def test_delay_applies_in_both_directions_and_twice_through_the_relay(bench: Bench) -> None:
    medium, spaces = bench("{loss: 0%, delay: 20ms, rate: unlimited}")
    medium.place(PLACES)
    assert 40 <= min(ping(spaces["a"], ADDRESSES["b"])) < 80
    medium.place(PLACES, relay="r")
    assert min(ping(spaces["a"], ADDRESSES["b"])) >= 80
    assert 40 <= min(ping(spaces["a"], ADDRESSES["r"])) < 80
    assert medium.stats().links["r", "b"].delivered == 20


def test_links_are_sampled_on_request_without_traffic_on_the_air(bench: Bench) -> None:
    medium, spaces = bench("{fading: false}")
    medium.place(PLACES, relay="r")
    first_samples = medium.links(continue_sampling=True)
    assert {name: len(samples) for name, samples in first_samples.items()} == {"a": 1, "b": 1, "r": 1}
    assert len(ping(spaces["a"], ADDRESSES["b"], count=80)) == 80
    last_samples, stats = medium.links(continue_sampling=False), medium.stats()
    assert len(last_samples["a"]) >= 4, "in 0.8 s"
    sent_counts = {name: port.sent_packets - port.other_packets for name, port in stats.ports.items()}
    assert sent_counts == {"a": 80, "b": 80, "r": 0}, "a kernel solicits routers of IPv6 once, which is not counted"
    assert sum(link.sent for link in stats.links.values()) == 4 * 80, "two hops each way, and nothing else"
    stations = {name: samples[-1].stations for name, samples in last_samples.items()}
    assert [station.station for station in stations["a"]] == ["r"], "a station lists its access point"
    assert [(station.station, station.tx_packets, station.rx_packets) for station in stations["r"]] == [
        ("a", 80, 80),
        ("b", 80, 80),
    ]
    busy_s = [sample.busy_ns / 1e9 for sample in (last_samples["a"][-1],) if sample.busy_ns is not None]
    assert 0 < busy_s[0] < 1
    assert stations["a"][0].signal_dbm == pytest.approx(stations["r"][0].signal_dbm), "both send with the same power"


def test_the_attitude_of_a_robot_turns_its_antenna() -> None:
    """A half-wave dipole: 2.15 dBi, or -5.43 dBi at 30 degrees from its wire."""
    options = RadioOptions(fading=False)
    dipole = Radio.model_validate({**RADIO.model_dump(), "antenna": {"pattern": "dipole"}})
    with MediumClient(options, seed=1) as medium, Namespace() as first, Namespace() as second:
        for name, space, radio in (("a", first, dipole), ("b", second, RADIO)):
            fd = space.tun("wlan0", f"{ADDRESSES[name]}/24")
            medium.attach(name, f"{ADDRESSES[name]}/24", radio, fd)
            os.close(fd)
        signals_dbm = []
        for pitch_rad in (0.0, math.radians(60)):
            attitudes = {"a": Attitude(pitch_rad=pitch_rad)}
            medium.place({name: PLACES[name] for name in "ab"}, attitudes=attitudes)
            assert ping(first, ADDRESSES["b"], count=2)
            signals_dbm.append(medium.links(continue_sampling=True)["b"][-1].stations[0].signal_dbm or 0.0)
    assert signals_dbm[1] - signals_dbm[0] == pytest.approx(-5.43 - 2.15, abs=0.02)


def places_in_a_fade(options: RadioOptions) -> dict[str, Vector]:
    """Return places of b and r about 78 m apart, which are in range on average but out of range in a deep fade."""
    channel = WorldChannel(1, {"b": antenna_of(RADIO), "r": antenna_of(RADIO)}, options)
    for centimetres in range(7700, 7900):
        places: dict[str, Vector] = {"b": (0.0, 0.0, 0.0), "r": (centimetres / 100, 0.0, 0.0)}
        channel.move(0, places)
        if channel.are_linked(0, 1) and channel.powers_mw(0, 0)[1] < channel.sensitivity_mw[1] / 2:
            return places
    raise AssertionError("no fade in this range")


def test_a_moving_robot_leaves_a_fade(bench: Bench) -> None:
    text = "{fading: true, k_db: -20, stir_m_s: 0}"
    medium, spaces = bench(text)
    places = places_in_a_fade(schema.validate(schema.parse(text, source="radio.yaml"), RadioOptions))
    medium.place(places)
    assert ping(spaces["b"], ADDRESSES["r"]) == []
    medium.place(places, velocities_m_s={"b": (-10.0, 0.0, 0.0)})
    assert ping(spaces["b"], ADDRESSES["r"])


def test_the_parts_of_a_delay_are_those_of_all_hops(bench: Bench) -> None:
    medium, spaces = bench("{loss: 0%, delay: 20ms, rate: 8Mbit/s}")
    for hops, relay in ((1, None), (2, "r")):
        medium.place(PLACES, relay=relay)
        before = medium.stats().delays.get(("a", "b"), NO_PACKETS)
        rtt_ms = ping(spaces["a"], ADDRESSES["b"], "-s", "972", "-i", "0.1")  # so that no packet queues
        after = medium.stats().delays["a", "b"]
        assert after.policy_ns is None, "there is no co-simulation"
        differences = {
            name: value - getattr(before, name) for name, value in vars(after).items() if value is not None
        }
        delta = DelayParts(**differences)
        assert (delta.packets, delta.queuing_ns) == (20, 0)
        assert delta.propagation_ns == hops * 20 * 20_000_000
        assert delta.transmission_ns == hops * 20 * 1_000_000, "1,000 bytes at 8 Mbit/s"
        assert 0 < delta.processing_ns < sum(rtt_ms) * 1e6, (
            "compared with round trips, which include the reverse path"
        )
    assert medium.stats().delays.keys() == {("a", "b"), ("b", "a")}
    spaces["b"].ip("link", "set", "wlan0", "down")
    before = medium.stats().delays["a", "b"]
    assert ping(spaces["a"], ADDRESSES["b"], count=2) == []
    assert medium.stats().delays["a", "b"] == before, "packets refused by the robot were not delivered"


def test_flows_of_one_pair_are_distinguished_in_fragments_and_mixed(bench: Bench) -> None:
    """The link has 8 Mbit/s and 20 ms; traffic is 2 datagrams of 6 fragments each, 3 small ones, and a ping."""
    medium, spaces = bench("{loss: 0%, delay: 20ms, rate: 8Mbit/s}")
    medium.place(PLACES)
    flows = {port: ("a", "b", socket.IPPROTO_UDP, port) for port in (1234, 1235)}
    reverse_flow = ("b", "a", socket.IPPROTO_UDP, 1234)
    for flow in (*flows.values(), reverse_flow):
        assert medium.delays(*flow) == NO_PACKETS
    sender_program = "import socket,sys; s=socket.socket(socket.AF_INET,socket.SOCK_DGRAM)\n"
    sender_program += "for n, size, port in ((2, 8192, 1234), (3, 972, 1235), (1, 9000, 99)):\n"
    sender_program += "    for _ in range(n): s.sendto(bytes(size), (sys.argv[1], port))"
    ping(spaces["a"], ADDRESSES["b"], count=2)
    spaces["a"].run(sys.executable, "-c", sender_program, ADDRESSES["b"])
    wait_until(lambda: medium.delays(*flows[1235]).packets == 3, Deadline.after(LONG_S))
    large, small = (medium.delays(*flow) for flow in flows.values())
    assert (large.packets, large.propagation_ns) == (12, 12 * 20_000_000)
    assert large.transmission_ns == 2 * 1000 * (8200 + 6 * 20), "a byte takes 1 us"
    assert (small.packets, small.transmission_ns) == (3, 3 * 1_000_000)
    assert medium.delays(*reverse_flow) == NO_PACKETS


def test_large_packets_arrive_complete_in_fragments(bench: Bench) -> None:
    medium, spaces = bench("{fading: false}")
    medium.place(PLACES)
    assert len(ping(spaces["a"], ADDRESSES["b"], "-s", "8192", "-p", "a5", count=5)) == 5
    assert medium.stats().links["a", "b"].sent == 5 * 6


def test_the_loss_has_the_configured_value(bench: Bench) -> None:
    medium, spaces = bench("{loss: 10%, delay: 0ms, rate: unlimited}")
    medium.place(PLACES)
    spaces["a"].run(sys.executable, "-c", SEND, ADDRESSES["b"], "3000").check_returncode()
    wait_for(lambda: medium.stats().links["a", "b"].sent == 3000, "all datagrams are on the air")
    counters = medium.stats().links["a", "b"]
    interval = scipy.stats.binomtest(counters.lost, counters.sent).proportion_ci(
        confidence_level=0.99, method="wilson"
    )
    assert interval.low <= 0.1 <= interval.high


def test_lateness_of_the_medium_is_reported(bench: Bench) -> None:
    medium, spaces = bench("{loss: 0%, delay: 1500ms, rate: unlimited}")
    medium.place(PLACES)
    request = spaces["a"].start("ping", "-n", "-c", "1", ADDRESSES["b"])
    wait_for(lambda: medium.stats().links["a", "b"].sent == 1, "the request is on the air")
    os.kill(medium.pid, signal.SIGSTOP)
    assert ping(spaces["b"], ADDRESSES["a"], "-W", "2", count=1) == [], "the medium is stopped"
    os.kill(medium.pid, signal.SIGCONT)
    request.communicate(timeout=LONG_S)
    lateness_counts = medium.stats().packet_lateness_counts
    assert sum(lateness_counts.values()) >= 2
    # The medium was stopped for two seconds; the delay of the request was 1.5 s of them.
    assert 0.25e9 < max(lateness_counts) < LONG_S * 1e9


def test_no_packet_arrives_at_a_loss_of_100_percent(bench: Bench) -> None:
    medium, spaces = bench("{loss: 100%}")
    medium.place(PLACES)
    assert ping(spaces["a"], ADDRESSES["b"], count=5) == []
    stats = medium.stats()
    assert (stats.links["a", "b"].lost, stats.ports["b"].delivered_packets) == (5, 0)


def test_a_link_ends_out_of_range_and_is_restored_in_range(bench: Bench) -> None:
    medium, spaces = bench("{fading: false}")
    medium.place(PLACES | {"b": (5000.0, 0.0, 0.0)})
    assert ping(spaces["a"], ADDRESSES["b"], count=3) == []
    medium.place(PLACES)
    assert len(ping(spaces["a"], ADDRESSES["b"], count=3)) == 3


def test_packets_that_waited_to_be_read_count_as_late(bench: Bench) -> None:
    medium, spaces = bench(PLAIN)
    medium.place(PLACES)
    assert len(ping(spaces["a"], ADDRESSES["b"])) == 20
    os.kill(medium.pid, signal.SIGSTOP)
    wait_for(lambda: ") T " in Path(f"/proc/{medium.pid}/stat").read_text(), "the medium is stopped")
    spaces["a"].run(sys.executable, "-c", SEND, ADDRESSES["b"], "200").check_returncode()
    time.sleep(0.5)
    os.kill(medium.pid, signal.SIGCONT)
    wait_for(lambda: medium.stats().ports["b"].delivered_packets >= 220, "all datagrams are delivered")
    stats = medium.stats()
    # The error is one poll timeout, 10 ms; most of the 200 packets are not read immediately.
    assert sum(count for late_ns, count in stats.packet_lateness_counts.items() if late_ns >= 0.49e9) >= 200
    assert stats.delays["a", "b"].processing_ns >= 200 * 0.49e9
    assert sum(stats.packet_lateness_counts.values()) == sum(parts.packets for parts in stats.delays.values())


@pytest.mark.parametrize("address", ["239.1.1.1", "10.9.0.255", "255.255.255.255"])
@pytest.mark.parametrize("relay", [None, "r"])
def test_multicast_and_broadcast_reach_all_robots(
    routed_namespaces: tuple[MediumClient, dict[str, Namespace]], address: str, relay: str | None
) -> None:
    medium, spaces = routed_namespaces
    medium.place(PLACES, relay=relay)
    listeners = {name: spaces[name].start(sys.executable, "-c", LISTEN, ADDRESSES[name]) for name in ("b", "r")}
    for listener in listeners.values():
        assert listener.stdout is not None
        assert listener.stdout.readline() == "ready\n"
    sender = spaces["a"].run(sys.executable, "-c", SEND, address, "1")
    assert sender.returncode == 0, sender.stderr
    assert {name: listener.communicate(timeout=LONG_S)[0] for name, listener in listeners.items()} == {
        "b": "hello\n",
        "r": "hello\n",
    }


def test_unroutable_packets_are_counted_and_not_carried(bench: Bench) -> None:
    medium, spaces = bench(PLAIN)
    assert ping(spaces["a"], ADDRESSES["b"], count=2) == []
    assert medium.stats().ports["a"].unroutable_packets == 2
    medium.place({name: PLACES[name] for name in ("a", "b")})
    assert ping(spaces["a"], ADDRESSES["r"], count=2) == []
    assert ping(spaces["a"], "10.9.0.77", count=2) == []
    assert medium.stats().ports["a"].unroutable_packets == 6
    spaces["b"].ip("link", "set", "wlan0", "down")
    assert ping(spaces["a"], ADDRESSES["b"], count=2) == []
    assert medium.stats().ports["a"].unroutable_packets == 8


def test_the_medium_continues_after_a_robot_has_gone(bench: Bench) -> None:
    medium, spaces = bench(PLAIN)
    medium.place(PLACES)
    spaces["r"].close()
    spaces["b"].ip("link", "delete", "wlan0")
    assert ping(spaces["a"], ADDRESSES["b"], count=2) == []
    assert medium.stats().ports["a"].unroutable_packets == 2


def test_a_packet_socket_can_be_attached_and_closed() -> None:
    packet = bytes((0x45, 0, 0, 20, *(0,) * 8, 10, 9, 0, 1, 10, 9, 0, 2))
    with ExitStack() as stack:
        options = schema.validate(schema.parse(PLAIN, source="radio.yaml"), RadioOptions)
        medium = stack.enter_context(MediumClient(options, seed=1))
        robots = {}
        for name in ("a", "b"):
            medium_end, robot_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            robots[name] = stack.enter_context(robot_end)
            with medium_end:
                medium.attach(name, f"{ADDRESSES[name]}/24", RADIO, medium_end.fileno())
        medium.place({name: PLACES[name] for name in robots})
        robots["b"].settimeout(LONG_S)
        robots["a"].send(packet)
        assert robots["b"].recv(100) == packet
        robots["b"].close()
        robots["a"].send(packet)
        wait_until(lambda: medium.stats().ports["a"].sent_packets == 2, Deadline.after(LONG_S))


def test_the_medium_continues_between_the_other_robots(bench: Bench) -> None:
    medium, spaces = bench(PLAIN)
    medium.place(PLACES)
    spaces["r"].ip("link", "delete", "wlan0")
    assert len(ping(spaces["a"], ADDRESSES["b"], count=5)) == 5


def test_invalid_requests_are_rejected(routed_namespaces: tuple[MediumClient, dict[str, Namespace]]) -> None:
    medium, spaces = routed_namespaces
    fd = spaces["a"].tun("wlan1", "10.9.1.1/24")
    with pytest.raises(RobotError, match="already attached"):
        medium.attach("a", "10.9.1.1/24", RADIO, fd)
    with pytest.raises(RobotError, match="already attached"):
        medium.attach("new", "10.9.0.2/24", RADIO, fd)
    with pytest.raises(RobotError, match="nonsense"):
        medium.attach("new", "nonsense", RADIO, fd)
    os.close(fd)
    with pytest.raises(ConfigurationError, match="position: x"):
        medium.place({"x": (0.0, 0.0, 0.0)})
    with pytest.raises(ConfigurationError, match="position: r"):
        medium.place({"a": PLACES["a"]}, relay="r")


def test_close_stops_the_medium_and_may_be_repeated() -> None:
    medium = MediumClient(RadioOptions(), seed=1)
    medium.stats()
    medium.close()
    medium.close()
    assert not is_running(medium.pid)


def test_a_killed_medium_raises_an_error() -> None:
    with MediumClient(RadioOptions(), seed=1) as medium:
        medium.stats()
        os.kill(medium.pid, signal.SIGKILL)
        for _ in range(2):
            with pytest.raises(LinkError, match="does not answer") as error_info:
                medium.stats()
        assert str(medium.pid) in error_info.value.where


MEDIUM_OWNER = """
import time
from sim_backends.emulated.medium.medium_client import MediumClient
from sim_backends.radio.radio_options import RadioOptions
medium = MediumClient(RadioOptions(), seed=1)
medium.stats()
print(medium.pid, flush=True)
time.sleep(600)
"""


def test_the_medium_exits_if_its_owner_is_killed() -> None:
    owner = subprocess.Popen([sys.executable, "-c", MEDIUM_OWNER], stdout=subprocess.PIPE, text=True, cwd=ROOT)
    assert owner.stdout is not None
    pid = int(owner.stdout.readline())
    owner.kill()
    owner.communicate()
    wait_for(lambda: not is_running(pid), "the medium exits")


def test_the_medium_exits_if_its_control_socket_is_closed() -> None:
    robot_end, medium_end = socket.socketpair()
    with robot_end, medium_end:
        argv = [sys.executable, "-m", "sim_backends.emulated.medium.process", str(medium_end.fileno()), "1", "ip"]
        process = subprocess.Popen(argv, pass_fds=[medium_end.fileno()], cwd=ROOT)
        medium_end.close()
        robot_end.close()
        assert process.wait(LONG_S) == 0


OPEN_AGAIN = """
from fieldkit.core.errors import FieldkitError
from sim_backends.emulated.robot.tun_devices import open_tun
try:
    open_tun("wlan0")
except FieldkitError as error:
    print(error.what)
"""


def test_an_error_of_the_tun_device_has_its_reason() -> None:
    with pytest.raises(ConfigurationError, match="is not a valid interface name"):
        open_tun("a-name-that-is-too-long")
    with Namespace() as space:
        first = space.tun("wlan0", "10.9.0.1/24")
        second = space.run(sys.executable, "-c", OPEN_AGAIN)
        os.close(first)
    assert second.stdout == "cannot create the TUN interface: Device or resource busy\n"
