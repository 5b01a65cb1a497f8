"""Speed of the co-simulation in one process: `python -m benchmarks.cosim_speed [--json]`.

Driving robots, 5 m apart, send 10 packets of 100 bytes per second to the next robot by UDP over fading Wi-Fi, under
`sliding_window` with windows of 1.1 ms. The figures per number of robots are medians of several rounds: the real-time
factor; exchanges between the physics and the network simulator per second; the cost of an exchange without the time
of both simulators and of the programs; and the cost of the coordinator relative to a plain loop that steps the same
programs and simulators through the same windows, without policies, record of packets (ledger) or event hash. If
coordinator and loop deliver different packets, or at different times, the benchmark raises an error. Then scenarios
that ship with fieldkit are measured, and robots that drive and fly in MuJoCo, in windows of 10 ms; their cost is
relative to the steps of MuJoCo alone.

The benchmark runs in one thread without waiting, so all times are processor times. Other load still slows it down
through shared caches and a lower clock.
"""

import argparse
import gc
import heapq
import json
import os
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Final

from benchmarks.mujoco_fleet import measure_mujoco
from sim_backends.cosim.agents import Agents
from sim_backends.cosim.coordinator import Coordinator
from sim_backends.cosim.policies.window_policies import SlidingWindow
from sim_backends.cosim.programs.senders import Periodic
from sim_backends.cosim.run_record import Run
from sim_backends.cosim.scenario.build import build
from sim_backends.cosim.scenario.loading import load_scenario
from sim_backends.network.packets import Packet, ReceivedDatagram
from sim_backends.network.radio import RadioNetwork
from sim_backends.physics.paths import Paths
from sim_backends.radio.antennas import Antenna
from sim_backends.radio.models.radio_model import WifiInWorld
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.motion import State, WayPoints

COUNTS: Final = (3, 10, 30, 100, 200)
"""Numbers of robots."""
SCENARIOS: Final = ("baylands",)
MUJOCO_COUNTS: Final = (3, 10, 30)
WINDOW_NS: Final = 1_100_000
PERIOD_NS: Final = 100_000_000
SIZE_BYTES: Final = 100
ANTENNA: Final = Antenna("802.11n", 15.0, -92.0)

Figures = dict[str, float]
Arrivals = list[tuple[str, int, int]]
"""Flow, packet number and arrival time in ns."""


class Fleet:
    """Robots in a square that drive eastwards at different speeds and send to the next robot.

    Args:
        count: Number of robots.
    """

    def __init__(self, count: int) -> None:
        self.names = [f"r{number}" for number in range(count)]
        self.next_of = dict(zip(self.names, [*self.names[1:], self.names[0]], strict=True))
        self.first_ns = {name: number * PERIOD_NS // count for number, name in enumerate(self.names)}

    def physics(self) -> Paths:
        """Return the physics simulator, which moves the robots."""
        side = round(len(self.names) ** 0.5)
        motions = []
        for number, name in enumerate(self.names):
            east_m, north_m = 5.0 * (number % side), 5.0 * (number // side)
            points_m = [(east_m, north_m, 1.0), (east_m + 1000.0, north_m, 1.0)]
            motions.append(WayPoints(name, points_m, 1 + 0.3 * number / len(self.names)))
        return Paths(motions)

    def programs(self) -> dict[str, Periodic]:
        """Return the program of each robot."""
        return {
            name: Periodic(name, other, period_ns=PERIOD_NS, size_bytes=SIZE_BYTES, first_ns=self.first_ns[name])
            for name, other in self.next_of.items()
        }

    def network(self) -> RadioNetwork:
        """Return the network simulator."""
        return RadioNetwork(WifiInWorld(1, RadioOptions(), dict.fromkeys(self.names, ANTENNA), None), self.names)


def run_coordinator(fleet: Fleet, seconds: float) -> tuple[Arrivals, Figures]:
    """Return the arrivals under the coordinator, and its figures."""
    agents = Agents(fleet.physics(), fleet.programs())
    pairs = list(fleet.next_of.items())
    coordinator = Coordinator(agents, fleet.network(), SlidingWindow(WINDOW_NS / 1e9), pairs)
    gc.collect()
    started_s = time.process_time()
    run = coordinator.advance(round(seconds * 1e9))
    spent_s = time.process_time() - started_s
    arrivals = [(*identity, fate.arrived_ns) for identity, fate in run.fates.items() if fate.arrived_ns is not None]
    return arrivals, figures(run, spent_s)


def figures(run: Run, spent_s: float) -> Figures:
    """Return the figures of a run that took `spent_s` of processor time."""
    exchanges, seconds = len(run.windows_ns), run.windows_ns[-1] / 1e9
    share = run.wall_s["exchange"] / sum(run.wall_s.values())
    return {
        "real_time_factor": seconds / spent_s,
        "exchanges_per_s": exchanges / spent_s,
        "exchange_us": share * spent_s / exchanges * 1e6,
        "packets": len(run.fates),
        "spent_s": spent_s,
    }


class PlainLoop:
    """A minimal loop that advances programs, physics and network simulator together.

    It reads the wake times of the programs, passes them their packets, sends theirs, and stores payloads in transit.
    In this benchmark arrivals do not change the wake times of programs, so the loop does not read them again.

    Args:
        fleet: The robots.
    """

    def __init__(self, fleet: Fleet) -> None:
        self.arrived: Arrivals = []
        self._physics, self._network, self._programs = fleet.physics(), fleet.network(), fleet.programs()
        self._wakes: list[tuple[int, str]] = []
        self._in_transit: dict[int, tuple[Packet, object]] = {}
        self._packets = 0
        for name in self._programs:
            self._plan(name)

    def run(self, to_ns: int) -> None:
        """Advance to `to_ns`, window by window."""
        physics, network, wakes, in_transit = self._physics, self._network, self._wakes, self._in_transit
        received_by_name: dict[str, list[ReceivedDatagram]] = {}
        now_ns = 0
        while now_ns < to_ns:
            packets: list[Packet] = []
            if received_by_name:
                states = physics.advance(now_ns, {})
                for name, received in received_by_name.items():
                    packets += self._wake(name, now_ns, states, received)
                received_by_name = {}
            now_ns = min(now_ns + WINDOW_NS, to_ns)
            while wakes and wakes[0][0] <= now_ns:
                at_ns, name = heapq.heappop(wakes)
                packets += self._wake(name, at_ns, physics.advance(at_ns, {}), ())
                self._plan(name)
            arrivals, drops = network.advance(now_ns, packets, physics.advance(now_ns, {}))
            for arrival in arrivals:
                packet, payload = in_transit.pop(arrival.packet_id)
                received_packet = ReceivedDatagram(packet.source, payload, packet.sent_ns, arrival.at_ns)
                received_by_name.setdefault(arrival.receiver, []).append(received_packet)
                self.arrived.append((*packet.identity, arrival.at_ns))
            for drop in drops:
                del in_transit[drop.packet_id]

    def _plan(self, name: str) -> None:
        wake_ns = self._programs[name].next_wake_ns()
        if wake_ns is not None:
            heapq.heappush(self._wakes, (wake_ns, name))

    def _wake(
        self, name: str, at_ns: int, states: Mapping[str, State], received: Sequence[ReceivedDatagram]
    ) -> list[Packet]:
        """Wake a program; return the packets that it sends."""
        packets = []
        for datagram in self._programs[name].wake(at_ns, states[name], received).datagrams:
            self._packets += 1
            identity = datagram.flow, datagram.number
            packet = Packet(self._packets, name, datagram.destination, datagram.size_bytes, identity, at_ns, at_ns)
            self._in_transit[self._packets] = packet, datagram.payload
            packets.append(packet)
        return packets


def run_plain_loop(fleet: Fleet, seconds: float) -> tuple[Arrivals, float]:
    """Return the arrivals in the plain loop, and its processor time."""
    loop = PlainLoop(fleet)
    gc.collect()
    started_s = time.process_time()
    loop.run(round(seconds * 1e9))
    return loop.arrived, time.process_time() - started_s


def measure_fleet(count: int, seconds: float) -> Figures:
    """Return the figures for a number of robots.

    Raises:
        RuntimeError: Coordinator and plain loop deliver different packets, or deliver them at different times.
    """
    fleet = Fleet(count)
    # The plain loop runs before and after the coordinator, so that a drift of the machine's speed affects both
    # equally.
    expected, before_s = run_plain_loop(fleet, seconds)
    arrivals, measured = run_coordinator(fleet, seconds)
    _, after_s = run_plain_loop(fleet, seconds)
    if sorted(arrivals) != sorted(expected):
        raise RuntimeError(f"coordinator and plain loop deliver different packets among {count} robots")
    share_added = 2 * measured["spent_s"] / (before_s + after_s) - 1
    return measured | {"coordinator_adds_percent": 100 * share_added}


def measure_scenario(name: str) -> Figures:
    """Return the figures of a shipped scenario."""
    simulation = build(load_scenario(name))
    started_s = time.process_time()
    run = simulation.run()
    return figures(run, time.process_time() - started_s)


def medians(rounds: int, measure: Callable[[], Figures]) -> Figures:
    """Return the median of each figure."""
    results = [measure() for _ in range(rounds)]
    return {name: statistics.median(result[name] for result in results) for name in results[0]}


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=2.0, help="simulated time per round")
    parser.add_argument("--robots", type=int, nargs="*", default=COUNTS)
    parser.add_argument("--scenarios", nargs="*", default=SCENARIOS)
    parser.add_argument("--mujoco", type=int, nargs="*", default=MUJOCO_COUNTS, help="numbers of robots in MuJoCo")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args(arguments)
    load_before = os.getloadavg()[0]
    results = {
        f"{count} robots": medians(options.rounds, partial(measure_fleet, count, options.seconds))
        for count in options.robots
    }
    results |= {name: medians(options.rounds, partial(measure_scenario, name)) for name in options.scenarios}
    results |= {
        f"MuJoCo {count}": medians(options.rounds, partial(measure_mujoco, count, options.seconds))
        for count in options.mujoco
    }
    if options.json:
        print(json.dumps({"load_before": load_before, "figures": results}, indent=2))
        return
    print(f"{options.rounds} rounds, medians; load before: {load_before:.2f}, after: {os.getloadavg()[0]:.2f}")
    columns = list(dict.fromkeys(column for row in results.values() for column in row))
    print(f"{'':12}" + "".join(f"{column:>26}" for column in columns))
    for name, values in results.items():
        print(f"{name:12}" + "".join(f"{values[column]:>26.4g}" if column in values else "" for column in columns))


if __name__ == "__main__":
    main()
