"""Transports of the co-simulation compared with ns-3: `python -m benchmarks.cosim_vs_ns3 [--figure FILE] [--json]`.

Needs ns-3 3.37 and a C++ compiler: `apt-get install libns3-dev g++`. One station sends to another, in sight or behind
a wall, over 802.11g with the same power, noise, path loss, queue and slots in both. UDP sends 2 Mbit/s, and its loss
is measured; TCP sends at full rate. The loss of the wall is computed here, and ns-3 gets the total path loss.

There are three variants of ns-3: unchanged in 802.11g; unchanged in 802.11a, which has no signal extension (ns-3
models it wrongly); and 802.11a with a corrected TCP, because ns-3's TCP deviates from the standards at the edge of
a link's range (`ns3_link_streams.h` lists the corrections). Each link is run with enough seeds for a narrow interval
of the ratio. `--links g54` runs only the links with this text in their names.
"""

import argparse
import json
import math
import os
import sys
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final, Literal

import numpy as np
from scipy.stats import t as student

from benchmarks.radio_vs_ns3 import NOISE_DBM, SENSITIVITY_DBM, TX_POWER_DBM, Ns3, build, path_loss_db
from sim_backends.network.ip import Fragment
from sim_backends.network.packets import Packet
from sim_backends.network.radio import RadioNetwork
from sim_backends.network.tcp.connection import Tcp, TcpSample
from sim_backends.network.tcp.tcp_options import TcpOptions
from sim_backends.network.udp import Udp
from sim_backends.radio.antennas import Antenna
from sim_backends.radio.models.radio_model import WifiInWorld
from sim_backends.radio.phy.modes import CHANNEL_6_HZ
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.motion import State
from sim_backends.world.penetration import Obstacles
from sim_backends.world.world import World

SECONDS: Final = 10.0
"""Simulated time of a run."""
TRACE_S: Final = 20.0
"""Simulated time of a run whose congestion window is drawn."""
QUEUE_PACKETS: Final = 100
BATCH, MAX_RUNS, NARROW = 2, 48, 0.08
"""Runs per batch, and maximum number of runs. No further batch is run if the relative half-width of the ratio's
interval is below the third value."""
RATE_MBIT_S: Final = 2.0
PAYLOAD_BYTES: Final = 1000
MESSAGE_BYTES: Final = 14480
SEGMENT_BYTES: Final = TcpOptions().segment_bytes
HEIGHT_M: Final = 1.0
Control = Literal["newreno", "cubic-rfc9438"]
CONTROLS: Final[dict[Control, str]] = {"newreno": "TcpLinuxReno", "cubic-rfc9438": "TcpCubic"}
"""Congestion controls of `Control`, and their names in ns-3."""
Peer = Literal["802.11g", "802.11a", "corrected", "ours"]
PEERS: Final[tuple[Peer, ...]] = ("802.11g", "802.11a", "corrected", "ours")
"""Three variants of ns-3, and the co-simulation."""
DISTANCES_M: Final = {
    # 802.11g with the mode g54, or with minstrel's choice of modes (None); in sight (False) or behind the wall (True)
    ("g54", False): (10, 44, 46, 47, 48),
    ("g54", True): (15, 19, 20, 21),
    (None, False): (10, 50, 70, 80, 90),
    (None, True): (15, 25, 35),
}

Trace = list[tuple[float, float]]
"""Times in s, and congestion windows in segments."""


@dataclass(frozen=True)
class Cell:
    """A link.

    Attributes:
        mode: Wi-Fi mode of all frames; None for the modes that minstrel selects.
        wall: True if the wall is between the stations.
        distance_m: Distance of the stations in metres.
    """

    mode: str | None
    wall: bool
    distance_m: int

    def __str__(self) -> str:
        return f"{self.mode or 'minstrel'}, {'behind a wall' if self.wall else 'in sight'}, {self.distance_m} m"


@dataclass(frozen=True)
class Row:
    """Results of one link, each of shape (runs, peers): goodputs in Mbit/s, and shares of lost datagrams."""

    cell: Cell
    newreno: np.ndarray
    cubic: np.ndarray
    udp_loss: np.ndarray


def world(*, wall: bool) -> World:
    """Return open ground, or a concrete wall north to south, 2 m east of the origin."""
    wall_of = {
        "name": "wall",
        "kind": "wall",
        "from_m": [2, -9],
        "to_m": [2, 9],
        "height": "3m",
        "thickness": "0.2m",
        "material": "concrete",
    }
    return World.model_validate(
        {"name": "link", "summary": "one link", "area_m": [200, 20], "obstacles": [wall_of] * wall}
    )


def places_m(distance_m: float) -> dict[str, tuple[float, float, float]]:
    """Return the positions of the two stations."""
    return {"a": (0.0, 0.0, HEIGHT_M), "b": (distance_m, 0.0, HEIGHT_M)}


def loss_db(distance_m: float, *, wall: bool) -> float:
    """Return the path loss for ns-3, including the wall."""
    start_m, end_m = (np.array([place]) for place in places_m(distance_m).values())
    obstacles = Obstacles(world(wall=wall))
    return path_loss_db(distance_m) + float(obstacles.penetration_loss_db(start_m, end_m, CHANNEL_6_HZ)[0])


class Link:
    """A link of the co-simulation.

    Args:
        cell: Its place and mode.
        run: Number of the run, used as the seed.
    """

    def __init__(self, cell: Cell, run: int) -> None:
        options = RadioOptions(fading=False, noise_floor_dbm=NOISE_DBM, mode=cell.mode, queue_packets=QUEUE_PACKETS)
        antennas = dict.fromkeys("ab", Antenna("802.11g", TX_POWER_DBM, SENSITIVITY_DBM))
        self._radio: WifiInWorld[Fragment] = WifiInWorld(run, options, antennas, world(wall=cell.wall))
        self._states = {name: State(place_m) for name, place_m in places_m(cell.distance_m).items()}

    def udp(self) -> tuple[float, float]:
        """Return goodput in Mbit/s and loss of a stream of datagrams."""
        every_ns = round(8e3 * PAYLOAD_BYTES / RATE_MBIT_S)
        at_ns = range(every_ns, round(SECONDS * 1e9), every_ns)
        packets = [self._packet(number, PAYLOAD_BYTES, "udp", sent_ns) for number, sent_ns in enumerate(at_ns)]
        network = RadioNetwork(self._radio, "ab", transports={"udp": Udp})
        arrivals, _ = network.advance(round((SECONDS + 5) * 1e9), packets, self._states)
        return len(arrivals) * PAYLOAD_BYTES * 8 / SECONDS / 1e6, 1 - len(arrivals) / len(packets)

    def tcp(self, control: Control, seconds: float = SECONDS) -> tuple[float, Trace]:
        """Return the goodput in Mbit/s of an endless stream, and its congestion window over time."""
        trace: Trace = []

        def record(sample: TcpSample) -> None:
            trace.append((sample.at_ns / 1e9, sample.window_bytes / SEGMENT_BYTES))

        make = partial(Tcp, options=TcpOptions(congestion=control), log=record)
        network = RadioNetwork(self._radio, "ab", transports={"tcp": make})
        count = round(seconds * 54e6 / 8 / MESSAGE_BYTES)
        packets = [self._packet(number, MESSAGE_BYTES, "tcp", 0) for number in range(count)]
        arrivals, _ = network.advance(round(seconds * 1e9), packets, self._states)
        return len(arrivals) * MESSAGE_BYTES * 8 / seconds / 1e6, trace

    @staticmethod
    def _packet(number: int, size_bytes: int, protocol: str, at_ns: int) -> Packet:
        return Packet(number, "a", "b", size_bytes, ("stream", number), at_ns, at_ns, protocol)


class Ns3Link:
    """A link of ns-3, with the interface of `Link`.

    Args:
        ns3: The ns-3 program.
        cell: Its place and mode.
        run: Number of the run, used as the seed.
        peer: The variant of ns-3.
    """

    def __init__(self, ns3: Ns3, cell: Cell, run: int, peer: Peer) -> None:
        # 802.11a has the modes, slots and times of 802.11g, but no signal extension and no modes of 802.11b.
        standard = "ErpOfdm" if peer == "802.11g" else "Ofdm"
        mode_options = {
            "mode": f"{standard}Rate{cell.mode[1:] if cell.mode else 6}Mbps",
            "adapt": int(cell.mode is None),
        }
        self._control = "Counting{}" if peer == "corrected" else "ns3::{}"
        loss = loss_db(cell.distance_m, wall=cell.wall)
        self._run = partial(ns3, loss=loss, queue=QUEUE_PACKETS, RngRun=run, **mode_options)

    def udp(self) -> tuple[float, float]:
        """Return goodput in Mbit/s and loss; see `Link.udp`."""
        goodput, lost = self._run(what="udp", rate=RATE_MBIT_S, payload=PAYLOAD_BYTES, seconds=SECONDS).split()
        return float(goodput), float(lost)

    def tcp(self, control: Control, seconds: float = SECONDS) -> tuple[float, Trace]:
        """Return goodput and congestion window; see `Link.tcp`."""
        name = self._control.format(CONTROLS[control])
        lines = self._run(what="tcp", control=name, seconds=seconds).splitlines()
        trace = [(int(at) / 1e9, int(window) / SEGMENT_BYTES) for at, _, window in map(str.split, lines[:-1])]
        return float(lines[-1].split()[0]), trace


def run_once(ns3: Ns3, cell: Cell, run: int) -> list[list[float]]:
    """Return per peer the goodputs of NewReno and CUBIC and the loss of UDP, each on a new link."""

    def link(peer: Peer) -> Link | Ns3Link:
        return Link(cell, run) if peer == "ours" else Ns3Link(ns3, cell, run, peer)

    return [[*(link(peer).tcp(control, SECONDS)[0] for control in CONTROLS), link(peer).udp()[1]] for peer in PEERS]


def measure_link(ns3: Ns3, cell: Cell, pool: ProcessPoolExecutor) -> Row:
    """Return the results of a link, from as many runs as needed but at most `MAX_RUNS`."""
    runs: list[list[list[float]]] = []
    while True:
        runs += pool.map(partial(run_once, ns3, cell), range(len(runs) + 1, len(runs) + 1 + BATCH))
        newreno, cubic, udp_loss = np.moveaxis(np.array(runs), 2, 0)
        ratio, low, high = ratio_of(newreno[:, -1], newreno[:, -2])
        if len(runs) >= MAX_RUNS or math.isnan(ratio) or high / low < (1 + NARROW) ** 2:
            return Row(cell, newreno, cubic, udp_loss)


def ratio_of(fieldkit: np.ndarray, ns3: np.ndarray) -> tuple[float, float, float]:
    """Return the ratio of two means and its 95 % interval, from the logarithm's variance.

    All are NaN if one of the means, which are goodputs, is below 0.01 Mbit/s.
    """
    if min(fieldkit.mean(), ns3.mean()) < 0.01:
        return math.nan, math.nan, math.nan
    spread = math.sqrt(sum(runs.var(ddof=1) / len(runs) / runs.mean() ** 2 for runs in (fieldkit, ns3)))
    factor = math.exp(student.ppf(0.975, 2 * len(fieldkit) - 2) * spread)
    ratio = float(fieldkit.mean() / ns3.mean())
    return ratio, ratio / factor, ratio * factor


def points_of(fieldkit: np.ndarray, ns3: np.ndarray) -> tuple[float, float]:
    """Return the difference of two mean shares in percentage points, and half of its 95 % interval."""
    spread = math.sqrt(sum(runs.var(ddof=1) / len(runs) for runs in (fieldkit, ns3)))
    return 100 * float(fieldkit.mean() - ns3.mean()), 100 * float(student.ppf(0.975, 2 * len(fieldkit) - 2)) * spread


def rows(ns3: Ns3, name_parts: Sequence[str]) -> Iterable[Row]:
    """Yield the results of links whose name contains one of `name_parts`."""
    cells = [
        Cell(mode, wall, distance_m)
        for (mode, wall), distances_m in DISTANCES_M.items()
        for distance_m in distances_m
    ]
    with ProcessPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        for cell in cells:
            if any(text in str(cell) for text in name_parts):
                yield measure_link(ns3, cell, pool)


def traces(ns3: Ns3) -> dict[Control, tuple[Trace, Trace]]:
    """Return the congestion windows over time of ns-3 and of the co-simulation on a good link."""
    result: dict[Control, tuple[Trace, Trace]] = {}
    cell = Cell("g54", wall=False, distance_m=20)
    for control in CONTROLS:
        links = Ns3Link(ns3, cell, 1, "802.11g"), Link(cell, 1)
        ns3_trace, trace = (link.tcp(control, TRACE_S)[1] for link in links)
        result[control] = ns3_trace, trace
    return result


def main() -> None:
    """Run both, print the table, and draw the figure if `--figure` is given."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--links",
        nargs="*",
        default=[""],
        metavar="TEXT",
        help="only links with this text in their names, for example g54",
    )
    parser.add_argument("--json", action="store_true", help="print single values as JSON")
    parser.add_argument("--figure", type=Path, help="write goodputs and windows of both to this SVG file")
    arguments = parser.parse_args()
    measured_rows = []
    ns3 = build()
    for row in rows(ns3, arguments.links):
        measured_rows.append(row)
        print(line(row), file=sys.stderr if arguments.json else sys.stdout, flush=True)
    windows = traces(ns3) if arguments.figure else {}
    if arguments.figure:
        draw(arguments.figure, measured_rows, windows)
    if arguments.json:
        values = {
            str(row.cell): [row.newreno.tolist(), row.cubic.tolist(), row.udp_loss.tolist()] for row in measured_rows
        }
        json.dump(values, sys.stdout)


def line(row: Row) -> str:
    """Return the results of a link as a table row.

    For each congestion control it has the mean goodputs of the `PEERS`, and the ratios of the co-simulation to each
    variant of ns-3; for UDP the mean losses in percent, and differences in percentage points.
    """
    parts = [f"{row.cell!s:32}{len(row.newreno):3} runs"]
    for name, values in (("newreno", row.newreno), ("cubic", row.cubic)):
        means = " ".join(f"{mean:6.2f}" for mean in values.mean(axis=0))
        ratios = (ratio_of(values[:, -1], ns3) for ns3 in values.T[:-1])
        intervals = " ".join(
            "-" if math.isnan(ratio[0]) else "{:.2f} [{:.2f}, {:.2f}]".format(*ratio) for ratio in ratios
        )
        parts.append(f"{name} {means}  {intervals}")
    means = " ".join(f"{100 * mean:5.1f}" for mean in row.udp_loss.mean(axis=0))
    # The variant with the corrected TCP has the same UDP.
    differences = (points_of(row.udp_loss[:, -1], row.udp_loss[:, peer]) for peer in (0, 1))
    parts.append(f"udp lost {means}  " + " ".join("{:+.1f} ({:.1f})".format(*points) for points in differences))
    return " | ".join(parts)


def draw(path: Path, results: Sequence[Row], windows: dict[Control, tuple[Trace, Trace]]) -> None:
    """Draw goodputs over distance (ns-3: lines, co-simulation: marks) and congestion windows over time."""
    import matplotlib as mpl  # noqa: PLC0415 (needed only for the figure)
    from matplotlib.figure import Figure  # noqa: PLC0415

    mpl.rcParams["svg.hashsalt"] = "cosim_vs_ns3"
    figure = Figure(figsize=(11, 3.4), layout="constrained")
    left, *others = figure.subplots(1, 3)
    for number, (mode, wall) in enumerate(DISTANCES_M):
        link_rows = [row for row in results if (row.cell.mode, row.cell.wall) == (mode, wall)]
        if not link_rows:
            continue
        at_m = [row.cell.distance_m for row in link_rows]
        means = np.array([row.newreno.mean(axis=0) for row in link_rows])
        label = f"{mode or 'minstrel'}, {'wall' if wall else 'in sight'}"
        left.plot(at_m, means[:, -2], color=f"C{number}", label=label)
        left.plot(at_m, means[:, -1], "o", color=f"C{number}", markerfacecolor="none")
    left.set(xlabel="distance (m)", ylabel="goodput of NewReno (Mbit/s)", ylim=(-1, 38))
    left.legend(title="ns-3, corrected: lines; ours: marks", fontsize="small", ncols=2, loc="upper right")
    for axes, (control, (ns3, fieldkit)) in zip(others, windows.items(), strict=True):
        for trace, colour, label in ((ns3, "0.6", "ns-3"), (fieldkit, "C0", "ours")):
            # One value per 20 ms is enough for the figure.
            sampled = {round(at_s / 0.02): window for at_s, window in trace}
            axes.plot(
                [0.02 * step for step in sampled], list(sampled.values()), color=colour, label=label, linewidth=1
            )
        axes.set(xlabel="time (s)", ylabel="congestion window (segments)", title=CONTROLS[control], ylim=(0, 210))
        axes.legend(fontsize="small")
    figure.savefig(path, metadata={"Date": None})


if __name__ == "__main__":
    main()
