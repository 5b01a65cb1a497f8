"""Transports of the co-simulation beside ns-3: `python -m benchmarks.cosim_vs_ns3 [--figure FILE] [--json]`.

Needs ns-3 3.37 and a C++ compiler: `apt-get install libns3-dev g++`. One station sends to another, in sight or behind
a wall, over 802.11g with the same power, noise, path loss, queue and slots in both. UDP sends 2 Mbit/s, and what is
lost counts; TCP sends as fast as it may. What the wall takes is worked out here, and ns-3 is given the sum.
"""

import argparse
import json
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Final, Literal

import numpy as np

from benchmarks.radio_vs_ns3 import SENSITIVITY_DBM, TX_POWER_DBM, build, path_loss_db
from sim_backends.network.ip import Fragment
from sim_backends.network.packets import Packet
from sim_backends.network.radio import RadioNetwork
from sim_backends.network.tcp.connection import TcpSample
from sim_backends.network.tcp.options import TcpOptions
from sim_backends.network.tcp.transport import Tcp
from sim_backends.network.udp import Udp
from sim_backends.radio.model import WifiInWorld
from sim_backends.radio.options import RadioOptions
from sim_backends.radio.world_channel import CHANNEL_6_HZ, Antenna
from sim_backends.world.motion import State
from sim_backends.world.world import World

NOISE_DBM: Final = -94.966
"""What ns-3 makes of a noise figure of 6 dB: thermal noise of 20 MHz at 290 K beside it. At -95 dBm up to 7
datagrams of 100 less are lost."""
SECONDS: Final = 10.0
TRACE_S: Final = 20.0
QUEUE_PACKETS: Final = 100
RUNS: Final = 4
RATE_MBIT_S: Final = 2.0
PAYLOAD_BYTES: Final = 1000
MESSAGE_BYTES: Final = 14480
HEIGHT_M: Final = 1.0
Control = Literal["newreno", "cubic"]
CONTROLS: Final[dict[Control, str]] = {"newreno": "TcpLinuxReno", "cubic": "TcpCubic"}
"""What ns-3 calls them."""
DISTANCES_M: Final = {
    ("g54", False): (10, 30, 42, 44, 46, 47, 48),
    ("g54", True): (5, 15, 19, 20, 21),
    (None, False): (10, 50, 70, 80, 90),
    (None, True): (15, 25, 35, 40),
}

Trace = list[tuple[float, float]]
"""Times in s, and congestion windows in segments."""


@dataclass(frozen=True)
class Row:
    """What was measured on one link, by ns-3 and by us."""

    mode: str | None
    wall: bool
    distance_m: int
    tcp_mbit_s: tuple[float, float]
    udp_mbit_s: tuple[float, float]
    udp_loss: tuple[float, float]


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
    """Return where the two stations are."""
    return {"a": (0.0, 0.0, HEIGHT_M), "b": (distance_m, 0.0, HEIGHT_M)}


def loss_db(distance_m: float, *, wall: bool) -> float:
    """Return the path loss that ns-3 is given."""
    one, other = (np.array([place]) for place in places_m(distance_m).values())
    return path_loss_db(distance_m) + float(world(wall=wall).penetration_loss_db(one, other, CHANNEL_6_HZ)[0])


class Link:
    """A link of ours.

    Args:
        mode: The mode of every frame; None lets stations choose.
        distance_m: From one station to the other.
        wall: Whether a wall is between.
        run: Which of several runs: the seed.
    """

    def __init__(self, mode: str | None, distance_m: float, wall: bool, run: int) -> None:
        options = RadioOptions(fading=False, noise_floor_dbm=NOISE_DBM, mode=mode, queue_packets=QUEUE_PACKETS)
        antennas = dict.fromkeys("ab", Antenna("802.11g", TX_POWER_DBM, SENSITIVITY_DBM))
        self._radio: WifiInWorld[Fragment] = WifiInWorld(run, options, antennas, world(wall=wall))
        self._states = {name: State(place_m) for name, place_m in places_m(distance_m).items()}

    def udp(self) -> tuple[float, float]:
        """Return goodput in Mbit/s and loss of a stream of datagrams."""
        every_ns = round(8e3 * PAYLOAD_BYTES / RATE_MBIT_S)
        at_ns = range(every_ns, round(SECONDS * 1e9), every_ns)
        packets = [self._packet(number, PAYLOAD_BYTES, "udp", each_ns) for number, each_ns in enumerate(at_ns)]
        network = RadioNetwork(self._radio, "ab", transports={"udp": Udp})
        arrivals, _ = network.advance(round((SECONDS + 5) * 1e9), packets, self._states)
        return len(arrivals) * PAYLOAD_BYTES * 8 / SECONDS / 1e6, 1 - len(arrivals) / len(packets)

    def tcp(self, options: TcpOptions, seconds: float = SECONDS) -> tuple[float, Trace]:
        """Return goodput in Mbit/s of a stream that never ends, and its congestion window."""
        trace: Trace = []

        def note(sample: TcpSample) -> None:
            trace.append((sample.at_ns / 1e9, sample.window_bytes / options.segment_bytes))

        make = partial(Tcp, options=options, log=note)
        network = RadioNetwork(self._radio, "ab", transports={"tcp": make})
        count = round(seconds * 54e6 / 8 / MESSAGE_BYTES)
        packets = [self._packet(number, MESSAGE_BYTES, "tcp", 0) for number in range(count)]
        arrivals, _ = network.advance(round(seconds * 1e9), packets, self._states)
        return len(arrivals) * MESSAGE_BYTES * 8 / seconds / 1e6, trace

    @staticmethod
    def _packet(number: int, size_bytes: int, protocol: str, at_ns: int) -> Packet:
        return Packet(number, "a", "b", size_bytes, ("stream", number), at_ns, at_ns, protocol)


class Ns3Link:
    """A link of ns-3; as `Link`, after the call that runs ns-3."""

    def __init__(self, ns3: Callable[..., str], mode: str | None, distance_m: float, wall: bool, run: int) -> None:
        chosen = {"adapt": 1} if mode is None else {"mode": f"ErpOfdmRate{mode[1:]}Mbps"}
        self._run = partial(ns3, loss=loss_db(distance_m, wall=wall), queue=QUEUE_PACKETS, RngRun=run, **chosen)

    def udp(self) -> tuple[float, float]:
        """See `Link.udp`."""
        goodput, lost = self._run(what="udp", rate=RATE_MBIT_S, payload=PAYLOAD_BYTES, seconds=SECONDS).split()
        return float(goodput), float(lost)

    def tcp(self, options: TcpOptions, seconds: float = SECONDS) -> tuple[float, Trace]:
        """See `Link.tcp`."""
        lines = self._run(what="tcp", control=f"ns3::{CONTROLS[options.congestion]}", seconds=seconds).splitlines()
        trace = [(float(at_s), int(window) / options.segment_bytes) for at_s, window in map(str.split, lines[:-1])]
        return float(lines[-1].split()[0]), trace


def measured(link: Callable[[int], Link | Ns3Link]) -> tuple[float, float, float]:
    """Return goodput of TCP and of UDP in Mbit/s, and loss of UDP, each on a link that nobody used before.

    Where some datagrams are lost and some are not, chance decides over TCP: these are means of several runs.
    """
    runs = []
    for run in range(1, 1 + RUNS):
        runs.append((link(run).tcp(TcpOptions())[0], *link(run).udp()))
        if runs[0][2] in {0.0, 1.0}:
            break
    tcp_mbit_s, udp_mbit_s, udp_loss = np.mean(runs, axis=0).tolist()
    return tcp_mbit_s, udp_mbit_s, udp_loss


def rows(ns3: Callable[..., str]) -> list[Row]:
    """Return goodput and loss over distance."""
    found = []
    for (mode, wall), distances_m in DISTANCES_M.items():
        for distance_m in distances_m:
            theirs = measured(partial(Ns3Link, ns3, mode, distance_m, wall))
            ours = measured(partial(Link, mode, distance_m, wall))
            found.append(Row(mode, wall, distance_m, *zip(theirs, ours, strict=True)))
            print(f"{len(found)} of {sum(map(len, DISTANCES_M.values()))} links", file=sys.stderr, flush=True)
    return found


def traces(ns3: Callable[..., str]) -> dict[Control, tuple[Trace, Trace]]:
    """Return congestion windows over time by ns-3 and by us, on a good link."""
    found: dict[Control, tuple[Trace, Trace]] = {}
    for control in CONTROLS:
        options = TcpOptions(congestion=control)
        links = Ns3Link(ns3, "g54", 20, wall=False, run=1), Link("g54", 20, wall=False, run=1)
        theirs, ours = (link.tcp(options, TRACE_S)[1] for link in links)
        found[control] = theirs, ours
    return found


def main() -> None:
    """Run both, print the table, and draw the figure where asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true", help="single values")
    parser.add_argument("--figure", type=Path, help="write goodputs and windows of both to this SVG file")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        ns3 = build(Path(folder))
        found = rows(ns3)
        windows = traces(ns3) if arguments.figure else {}
    if arguments.figure:
        draw(arguments.figure, found, windows)
    if arguments.json:
        json.dump([asdict(row) for row in found], sys.stdout)
        return
    print(f"{'':36}{'TCP goodput (Mbit/s)':^24}{'UDP goodput (Mbit/s)':^24}{'UDP loss (%)':^22}")
    print(f"{'':36}" + f"{'ns-3':>8}{'ours':>8}{'ratio':>8}" * 2 + f"{'ns-3':>7}{'ours':>7}{'points':>8}")
    for row in found:
        name = f"{row.mode or 'minstrel'}, {'behind a wall' if row.wall else 'in sight'}, {row.distance_m} m"
        goodputs = "".join(
            f"{theirs:8.2f}{ours:8.2f}" + (f"{ours / theirs:8.3f}" if theirs > 0.05 else f"{'-':>8}")
            for theirs, ours in (row.tcp_mbit_s, row.udp_mbit_s)
        )
        theirs, ours = (100 * share for share in row.udp_loss)
        print(f"{name:36}{goodputs}{theirs:7.1f}{ours:7.1f}{ours - theirs:+8.1f}")


def draw(path: Path, found: Sequence[Row], windows: dict[Control, tuple[Trace, Trace]]) -> None:
    """Draw goodputs over distance, and congestion windows over time, theirs as lines and ours as marks or dashes."""
    import matplotlib as mpl  # noqa: PLC0415 (only who wants the figure needs it)
    from matplotlib.figure import Figure  # noqa: PLC0415

    mpl.rcParams["svg.hashsalt"] = "cosim_vs_ns3"
    figure = Figure(figsize=(11, 3.4), layout="constrained")
    left, *others = figure.subplots(1, 3)
    for number, (mode, wall) in enumerate(DISTANCES_M):
        own = [row for row in found if (row.mode, row.wall) == (mode, wall)]
        label = f"{mode or 'minstrel'}, {'wall' if wall else 'in sight'}"
        left.plot(
            [row.distance_m for row in own], [row.tcp_mbit_s[0] for row in own], color=f"C{number}", label=label
        )
        marks = [row.tcp_mbit_s[1] for row in own]
        left.plot([row.distance_m for row in own], marks, "o", color=f"C{number}", markerfacecolor="none")
    left.set(xlabel="distance (m)", ylabel="TCP goodput (Mbit/s)", ylim=(-1, 38))
    left.legend(title="ns-3: lines; ours: marks", fontsize="small", ncols=2, loc="upper right")
    for axes, (control, (theirs, ours)) in zip(others, windows.items(), strict=True):
        for trace, colour, label in ((theirs, "0.6", "ns-3"), (ours, "C0", "ours")):
            # One value per 20 ms: a line of ten thousand points shows no more.
            kept = {round(at_s / 0.02): window for at_s, window in trace}
            axes.plot([0.02 * step for step in kept], list(kept.values()), color=colour, label=label, linewidth=1)
        axes.set(xlabel="time (s)", ylabel="congestion window (segments)", title=CONTROLS[control], ylim=(0, 210))
        axes.legend(fontsize="small")
    figure.savefig(path, metadata={"Date": None})


if __name__ == "__main__":
    main()
