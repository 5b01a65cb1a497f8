"""Cost of the medium by the number of robots, with EMANE's figures: `python -m benchmarks.swarm [--json]`, as root.

The medium is the process that carries packets between emulated robots. For each number of robots, over ideal fixed
links and over Wi-Fi, the benchmark measures round trips between two robots, the lateness of their packets in the
medium, the rate of 64-byte UDP payloads, and the throughput of TCP. A bare veth pair is measured once for
comparison. The other robots are silent and should not add cost; the processor time per frame is measured at 2,000
packets/s. Then all neighbours form pairs, in each of which one robot sends to the other: over fixed links at full
rate, over Wi-Fi at 2,000 packets/s in total, about a third of the channel's capacity. These robots are network
namespaces without services. Finally, it measures robots with SSH server and sensors: their start-up time and
processor time, and the memory per robot without shared pages (`own`) and with a proportional part of them (`pss`).
"""

import argparse
import json
import os
import re
import statistics
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from typing import Final

from benchmarks.footprint import Memory, cpu_s
from benchmarks.medium import PAYLOAD_BYTES, RADIO, iperf, listening_iperf, packets_in, quantile, radio, veth_path
from benchmarks.namespaces import Namespace
from fieldkit.core.model import Lateness, Role, Topology
from fieldkit.measure.evidence.oracle_delays import lateness_quantile_ns
from sim_backends.emulated.backend import EmulatedBackend
from sim_backends.emulated.emulated_options import RosChoice
from sim_backends.emulated.medium.medium_client import MediumClient
from sim_backends.emulated.nodes import EmulatedRobot
from sim_backends.emulated.provisioning import KeyPair, robot_spec
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.world import World

SIZES: Final = (2, 10, 30, 50)
TCP_SIZES: Final = (2, 10)  # numbers of robots with which TCP is measured
RADIOS: Final = {"fixed": radio("0ms"), "wifi": RadioOptions(fading=False)}
PINGS: Final = 300
ONE_SENDER_PACKETS_S: Final = 2_000
ALL_SENDERS_PACKETS_S: Final = {"fixed": 0, "wifi": 2_000}
"""Packets per second of all senders together; 0 is full rate."""
REFERENCE: Final = {
    "rtt_median_ms": ("0.85", "2.0", "3.9", "6.0"),
    "rtt_p99_ms": ("4.3", "5.0", "5.6", "8.5"),
    "packets_s": ("30,000", "10,000", "2,000-3,000", "1,000"),
    "tcp_mbit_s": ("249-447", "69-122", "", ""),
    "start_s": ("", "0.11", "0.30", "0.50"),
    "pss_mb": ("", "3.2", "2.5", "2.4"),
}
"""EMANE 1.5.3 on 2 idle cores, with nodes without SSH server or sensors; TCP over RF Pipe and Comm Effect."""

SENDER_SCRIPT: Final = f"""
import socket, sys, time
address, seconds, packets_s = sys.argv[1], float(sys.argv[2]), float(sys.argv[3])
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
    started_s, sent = time.monotonic(), 0
    while (passed_s := time.monotonic() - started_s) < seconds:
        if packets_s and sent > passed_s * packets_s:
            time.sleep(sent / packets_s - passed_s)
        sender.sendto(bytes({PAYLOAD_BYTES}), (address, 9))
        sent += 1
"""

Figures = dict[str, float]


@contextmanager
def swarm(
    size: int, options: RadioOptions, world: World | None = None
) -> Iterator[tuple[MediumClient, list[Namespace]]]:
    """Yield a medium with `size` namespaces in a row, 0.5 m apart; the second has the address 10.9.0.2."""
    with ExitStack() as stack:
        medium = stack.enter_context(MediumClient(options, world, seed=1))
        spaces = [stack.enter_context(Namespace()) for _ in range(size)]
        for number, space in enumerate(spaces, 1):
            address = f"10.9.0.{number}/24"
            fd = space.tun("wlan0", address)
            medium.attach(f"r{number}", address, RADIO, fd)
            os.close(fd)
        medium.place({f"r{number}": (0.5 * number, 0.0, 0.0) for number in range(1, size + 1)})
        yield medium, spaces


def measure_medium(size: int, options: RadioOptions, seconds: float) -> Figures:
    """Return the figures of the medium for two of `size` robots."""
    with swarm(size, options) as (medium, (client, server, *_)):
        client.run("ping", "-c", "3", "10.9.0.2")
        before = Counter(medium.stats().packet_lateness_counts)
        figures = round_trips(client)
        figures |= lateness(medium, before)
        figures |= throughput(client, server, seconds)
        if size in TCP_SIZES:
            figures |= tcp(client, server, seconds)
        return figures


def measure_veth(seconds: float) -> Figures:
    """Return the figures of a veth pair."""
    with veth_path() as (client, server):
        client.run("ping", "-c", "3", "10.9.0.2")
        return round_trips(client) | throughput(client, server, seconds) | tcp(client, server, seconds)


def round_trips(client: Namespace) -> Figures:
    """Return the round trips from `client` to 10.9.0.2, in ms."""
    pings = client.run("ping", "-c", str(PINGS), "-i", "0.01", "10.9.0.2", timeout_s=60.0).stdout
    rtt_ms = [float(value) for value in re.findall(r"time=([\d.]+)", pings)]
    return {"rtt_median_ms": statistics.median(rtt_ms), "rtt_p99_ms": quantile(rtt_ms, 0.99)}


def lateness(medium: MediumClient, before: Counter[int]) -> Figures:
    """Return the lateness of the medium's packets since the counts `before`, in ms."""
    late = Lateness(bound_ns=1, packets=Counter(medium.stats().packet_lateness_counts) - before)
    shares = {"median": 0.5, "p99": 0.99, "max": 1.0}
    return {
        f"late_{word}_ms": (lateness_quantile_ns(late.packets, share) or 0) / 1e6 for word, share in shares.items()
    }


def throughput(client: Namespace, server: Namespace, seconds: float) -> Figures:
    """Return the rate of small packets that `server` receives, in packets per second."""
    with listening_iperf(server):
        arrived = packets_in(server)
        udp = iperf(client, seconds, "-u", "-b", "0", "-l", str(PAYLOAD_BYTES))
        return {"packets_s": (packets_in(server) - arrived) / udp["sum"]["seconds"]}


def tcp(client: Namespace, server: Namespace, seconds: float) -> Figures:
    """Return the throughput of TCP, in Mbit/s."""
    with listening_iperf(server):
        return {"tcp_mbit_s": iperf(client, seconds)["sum_received"]["bits_per_second"] / 1e6}


def measure_pairs(size: int, options: RadioOptions, seconds: float, packets_s: int, pairs: int) -> Figures:
    """Return the rate of received packets in pairs of `size` robots, and the cost per packet in the medium."""
    with swarm(size, options) as (medium, spaces):
        senders, receivers = spaces[: 2 * pairs : 2], spaces[1 : 2 * pairs : 2]
        packets_s_each = str(packets_s / len(senders))
        before, arrived = Counter(medium.stats().packet_lateness_counts), sum(map(packets_in, receivers))
        started_s, cpu_before_s = time.monotonic(), cpu_s(medium.pid)
        senders_running = [
            sender.start(
                sys.executable, "-c", SENDER_SCRIPT, f"10.9.0.{2 * number + 2}", str(seconds), packets_s_each
            )
            for number, sender in enumerate(senders)
        ]
        for process in senders_running:
            process.communicate(timeout=10 * seconds + 60)
        lasted_s, spent_s = time.monotonic() - started_s, cpu_s(medium.pid) - cpu_before_s
        arrived = sum(map(packets_in, receivers)) - arrived
        figures = {"packets_s": arrived / lasted_s, "cpu_us": 1e6 * spent_s / arrived}
        return figures | lateness(medium, before)


def measure_startup(size: int) -> Figures:
    """Return the cost of the start-up of `size` robots with their services, and the mean memory of a robot.

    The processor time includes that of this process, which starts the robots.
    """
    cast = EmulatedBackend(None, None).cast(Topology.MASTER)
    login, host_key = KeyPair.make(), KeyPair.make()
    spec = robot_spec(cast, Role.SENDER, ros=RosChoice.BUILTIN, login=login, host_key=host_key)
    started_s, started_cpu_s = time.monotonic(), time.process_time()
    with ExitStack() as stack:
        pool = stack.enter_context(ThreadPoolExecutor(8))
        robots = [
            stack.enter_context(EmulatedRobot(replace(spec, name=f"r{number}"))) for number in range(1, size + 1)
        ]
        list(pool.map(_serve, robots))
        lasted_s = time.monotonic() - started_s
        processors_s = time.process_time() - started_cpu_s + sum(cpu_s(robot.pid) for robot in robots)
        memory = [Memory.of(robot.pid) for robot in robots]
        for robot in robots:
            robot.request_exit()
    return {
        "start_s": lasted_s,
        "cpu_s": processors_s,
        "own_mb": statistics.mean(robot_memory.own_bytes for robot_memory in memory) / 1e6,
        "pss_mb": statistics.mean(robot_memory.pss_bytes for robot_memory in memory) / 1e6,
    }


def _serve(robot: EmulatedRobot) -> None:
    robot.build()
    robot.open_radio()
    robot.start()


def show(table: dict[str, dict[int, Figures]], veth: Figures, sizes: Sequence[int]) -> None:
    """Print the results, and EMANE's figures below."""
    print(f"{'':29}" + "".join(f"{size:>14}" for size in sizes))
    for path, by_size in table.items():
        for name in by_size[sizes[0]]:
            values = [by_size[size].get(name) for size in sizes]
            print(
                f"{path:11}{name:18}" + "".join(f"{'' if value is None else f'{value:.6g}':>14}" for value in values)
            )
    for name, value in veth.items():
        print(f"{'veth':11}{name:18}{value:>14.6g}")
    for name, figures in REFERENCE.items():
        emane_by_size = dict(zip(SIZES, figures, strict=True))
        print(f"{'EMANE':11}{name:18}" + "".join(f"{emane_by_size.get(size, ''):>14}" for size in sizes))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES, help="numbers of robots")
    parser.add_argument("--seconds", type=float, default=3.0, help="length of each throughput run")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    print(f"load before: {os.getloadavg()[0]:.2f}", file=sys.stderr)
    table = {
        name: {size: measure_medium(size, radio_options, options.seconds) for size in options.sizes}
        for name, radio_options in RADIOS.items()
    }
    for name, radio_options in RADIOS.items():
        for senders, rate in (("one", ONE_SENDER_PACKETS_S), ("all", ALL_SENDERS_PACKETS_S[name])):
            table[f"{name}, {senders}"] = {
                size: measure_pairs(size, radio_options, options.seconds, rate, 1 if senders == "one" else size // 2)
                for size in options.sizes
            }
    veth = measure_veth(options.seconds)
    table["robots"] = {size: measure_startup(size) for size in options.sizes}
    if options.json:
        print(json.dumps({"veth": veth, **table}, indent=2))
    else:
        show(table, veth, options.sizes)
    print(f"load after: {os.getloadavg()[0]:.2f}", file=sys.stderr)


if __name__ == "__main__":
    main()
