"""Cost of the medium, compared with a bare veth pair: `python -m benchmarks.medium [--json]`, as root.

The medium is the process that carries packets between emulated robots. Two namespaces without robots are used. Each
round measures for each path, in this order: round-trip time at zero delay (ping), TCP throughput (iperf3), 64-byte
UDP payloads at full rate (iperf3), and the error of a delay: 5 ms on the medium, 0 on the veth pair. For UDP it
counts the packets at the receiver's interface, and the packets that the receiving program reads; on two cores the
processor time of that program is the bottleneck. For the delay, a sender writes its send time into a datagram every
2 ms, and the receiver's kernel records the arrival time by the same clock. The column `bare timer` has the part of
the error that is due to the machine: the lateness of a 5 ms sleep at the same priority.
"""

import argparse
import json
import os
import re
import socket
import statistics
import struct
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Final

from benchmarks.namespaces import Namespace
from fieldkit.config.profiles import Radio
from sim_backends.emulated.cosimulated.client import CosimulatedClient
from sim_backends.emulated.cosimulated.simulators import Simulators
from sim_backends.emulated.medium.medium_client import MediumClient
from sim_backends.radio.radio_options import RadioOptions

RADIO: Final = Radio(interface="wlan0", standard="802.11g", tx_power_dbm=17, sensitivity_dbm=-82)
PAYLOAD_BYTES: Final = 64
DELAY_MS: Final = 5.0
PROBE_PORT: Final = 9000
START_S: Final = 60.0
"""Maximum time from the start of the receiver to the first datagram: a busy machine starts the sender late."""
IDLE_S: Final = 5.0
"""Time without a datagram after which the remaining ones count as lost."""
# linux/socket.h: the kernel's receive time as struct timespec.
SO_TIMESTAMPNS: Final = 35

Figures = dict[str, float]


def radio(delay: str) -> RadioOptions:
    """Return options of a radio that only delays packets by `delay`."""
    return RadioOptions.model_validate({"loss": "0%", "delay": delay, "rate": "unlimited"})


@contextmanager
def medium_path(
    options: RadioOptions, seed: int = 1, *, on_cosimulation: bool = False
) -> Iterator[tuple[Namespace, Namespace]]:
    """Yield two namespaces 9 m apart on a medium with `options`; the second has the address 10.9.0.2."""
    medium_client = _cosimulated(options, seed) if on_cosimulation else MediumClient(options, seed=seed)
    with Namespace() as client, Namespace() as server, medium_client as medium:
        for name, namespace, address in (("client", client, "10.9.0.1/24"), ("server", server, "10.9.0.2/24")):
            fd = namespace.tun("wlan0", address)
            medium.attach(name, address, RADIO, fd)
            os.close(fd)
        medium.place({"client": (0.0, 0.0, 0.0), "server": (9.0, 0.0, 0.0)})
        yield client, server


def _cosimulated(options: RadioOptions, seed: int) -> MediumClient:
    simulators, policy = Simulators("kinematic", "builtin"), {"name": "event_driven"}
    return CosimulatedClient(options, seed=seed, bodies={}, simulators=simulators, policy=policy)


@contextmanager
def veth_path() -> Iterator[tuple[Namespace, Namespace]]:
    """Yield two namespaces joined by a veth pair; the second has the address 10.9.0.2."""
    with Namespace() as client, Namespace() as server:
        client.veth(server, "10.9.0.1/24", "10.9.0.2/24")
        yield client, server


def measure_throughput(client: Namespace, server: Namespace, seconds: float) -> Figures:
    """Return round-trip times in ms, TCP throughput in Mbit/s, and UDP packets per second."""
    client.run("ping", "-c", "3", "10.9.0.2")
    pings = client.run("ping", "-c", "1000", "-i", "0.002", "10.9.0.2", timeout_s=60.0).stdout
    rtt_ms = [float(value) for value in re.findall(r"time=([\d.]+)", pings)]
    with listening_iperf(server):
        tcp = iperf(client, seconds)
        carried_before = packets_in(server)
        udp = iperf(client, seconds, "-u", "-b", "0", "-l", str(PAYLOAD_BYTES))
        carried = packets_in(server) - carried_before
    received = udp["sum"]["packets"] - udp["sum"]["lost_packets"]
    return {
        "rtt_median_ms": statistics.median(rtt_ms),
        "rtt_p99_ms": quantile(rtt_ms, 0.99),
        "tcp_mbit_s": tcp["sum_received"]["bits_per_second"] / 1e6,
        "carried_packets_s": carried / udp["sum"]["seconds"],
        "received_packets_s": received / udp["sum"]["seconds"],
    }


def packets_in(namespace: Namespace) -> int:
    """Return the number of packets that the interfaces of `namespace` received, without loopback."""
    links = json.loads(namespace.run("ip", "-json", "-statistics", "link").stdout)
    return sum(link["stats64"]["rx"]["packets"] for link in links if link["ifname"] != "lo")


@contextmanager
def listening_iperf(namespace: Namespace) -> Iterator[None]:
    """Run an iperf3 server in `namespace`."""
    server = namespace.start("iperf3", "--server", "--forceflush")
    try:
        assert server.stdout is not None
        while "Server listening" not in server.stdout.readline():
            if server.poll() is not None:
                raise RuntimeError("iperf3 did not start")
        yield
    finally:
        server.kill()
        server.communicate()


def iperf(namespace: Namespace, seconds: float, *options: str) -> dict[str, dict[str, float]]:
    """Return the `end` section of an iperf3 run against 10.9.0.2."""
    argv = ("iperf3", "--client", "10.9.0.2", "--json", "--time", f"{seconds:g}", *options)
    result = namespace.run(*argv, timeout_s=seconds + 30)
    end: dict[str, dict[str, float]] = json.loads(result.stdout)["end"]
    return end


def measure_delay(client: Namespace, server: Namespace, probes: int) -> list[float]:
    """Return the one-way delays in ms of the datagrams that arrived; one is sent every 2 ms."""
    module = ("-m", "benchmarks.medium", "--probes", str(probes))
    receiver = server.start(sys.executable, *module, "--probe", "receive")
    assert receiver.stdout is not None
    receiver.stdout.readline()
    sender = client.start(sys.executable, *module, "--probe", "send")
    delays, _ = receiver.communicate(timeout=probes * 0.002 + START_S + IDLE_S + 30)
    sender.communicate(timeout=10)
    delays_ms = [float(word) for word in delays.split()]
    if len(delays_ms) < probes:
        print(f"note: {probes - len(delays_ms)} of {probes} datagrams were lost", file=sys.stderr)
    return delays_ms


def send_probes(probes: int) -> None:
    """Send datagrams with their send time, one every 2 ms."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for _ in range(probes):
            sender.sendto(struct.pack("q", time.time_ns()), ("10.9.0.2", PROBE_PORT))
            time.sleep(0.002)


def receive_probes(probes: int) -> None:
    """Print the one-way delay in ms of each datagram of `send_probes` that arrives."""
    delays_ms: list[float] = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        receiver.bind(("", PROBE_PORT))
        receiver.settimeout(START_S)
        print("ready", flush=True)
        while len(delays_ms) < probes:
            try:
                data, ((_, _, stamp),), _, _ = receiver.recvmsg(8, 64)
            except TimeoutError:
                break
            receiver.settimeout(IDLE_S)
            seconds, nanoseconds = struct.unpack("qq", stamp)
            delays_ms.append((seconds * 1_000_000_000 + nanoseconds - struct.unpack("q", data)[0]) / 1e6)
    print(*delays_ms)


def timer_lateness_ms(sleeps: int) -> list[float]:
    """Return the lateness in ms of sleeps of 5 ms in a separate real-time process."""
    script = (
        f"import time\nfor _ in range({sleeps}):\n t = time.monotonic_ns(); time.sleep(0.005)\n"
        " print((time.monotonic_ns() - t) / 1e6 - 5)"
    )
    argv = ["chrt", "--fifo", "1", sys.executable, "-c", script]
    output = subprocess.run(argv, capture_output=True, text=True, check=True, timeout=60).stdout
    return [float(word) for word in output.split()]


def quantile(values: Sequence[float], share: float) -> float:
    """Return the empirical quantile of `values`."""
    return sorted(values)[min(len(values) - 1, int(share * len(values)))]


def errors(name: str, errors_ms: Sequence[float]) -> Figures:
    """Return median and 99th percentile of the magnitude of `errors_ms`."""
    magnitudes = [abs(value) for value in errors_ms]
    return {f"{name}_median_ms": statistics.median(magnitudes), f"{name}_p99_ms": quantile(magnitudes, 0.99)}


def measure_round(seconds: float, probes: int, *, on_cosimulation: bool = False) -> dict[str, Figures]:
    """Run one round, and return the figures of each path."""
    with ExitStack() as stack:
        ends = stack.enter_context(veth_path())
        veth = measure_throughput(*ends, seconds)
        veth |= errors("delay_error", measure_delay(*ends, probes))
    with medium_path(radio("0ms"), on_cosimulation=on_cosimulation) as (client, server):
        medium = measure_throughput(client, server, seconds)
    with medium_path(radio(f"{DELAY_MS}ms"), on_cosimulation=on_cosimulation) as (client, server):
        delays_ms = measure_delay(client, server, probes)
        medium |= errors("delay_error", [value - DELAY_MS for value in delays_ms])
    return {"veth": veth, "medium": medium, "timer": errors("delay_error", timer_lateness_ms(500))}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=3.0, help="length of each throughput run")
    parser.add_argument("--probes", type=int, default=2000, help="datagrams per delay measurement")
    parser.add_argument("--on-cosimulation", action="store_true", help="measure the medium of a co-simulation")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--probe", choices=("send", "receive"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.probe:
        (send_probes if options.probe == "send" else receive_probes)(options.probes)
        return
    load_before = os.getloadavg()[0]
    rounds = [
        measure_round(options.seconds, options.probes, on_cosimulation=options.on_cosimulation)
        for _ in range(options.rounds)
    ]
    if options.json:
        print(json.dumps({"load_before": load_before, "rounds": rounds}, indent=2))
        return
    print(f"{options.rounds} rounds, median (lowest to highest); load before: {load_before:.2f}")
    print(f"{'':22}{'veth':>28}{'medium':>28}{'medium/veth':>13}{'bare timer':>28}")
    for name in rounds[0]["medium"]:
        cells = {
            path: [figures[name] for results in rounds if name in (figures := results[path])] for path in rounds[0]
        }
        ratio = statistics.median(cells["medium"]) / statistics.median(cells["veth"])
        texts = {path: spread(values) for path, values in cells.items()}
        print(f"{name:22}{texts['veth']:>28}{texts['medium']:>28}{ratio:>13.2f}{texts['timer']:>28}")


def spread(values: Sequence[float]) -> str:
    """Return `median (lowest to highest)` of `values`, or an empty string for no values."""
    if not values:
        return ""
    digits = 0 if min(values) > 100 else 3
    return f"{statistics.median(values):.{digits}f} ({min(values):.{digits}f} to {max(values):.{digits}f})"


if __name__ == "__main__":
    main()
