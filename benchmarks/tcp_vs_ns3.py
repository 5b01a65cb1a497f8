"""TCP of the co-simulation compared with ns-3's, with equal losses on a cable: `python -m benchmarks.tcp_vs_ns3`.

Needs ns-3 3.37 and a C++ compiler: `apt-get install libns3-dev g++`. One station sends to another at full rate. The
cable loses packets with given numbers, so that all differences are due to TCP. With fixed loss patterns it prints the
congestion windows after the losses; with random losses, which are equal for all peers, it prints the goodputs.
`--events PATTERN CONTROL` prints the events around the first difference between ns-3 and fieldkit.
"""

import argparse
import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from itertools import chain, zip_longest
from typing import Final, get_args

import numpy as np
from scipy.stats import t as student

from benchmarks.cosim_vs_ns3 import CONTROLS, Control
from benchmarks.radio_vs_ns3 import Ns3, build
from sim_backends.network.packets import Packet
from sim_backends.network.tcp.connection import Tcp, TcpSample
from sim_backends.network.tcp.tcp_options import TcpOptions
from tests.helpers.scripted_wire import ScriptedWire, lose_packets

RATE_MBIT_S: Final = 10
DELAY_MS: Final = 10
QUEUE_PACKETS: Final = 100
SECONDS: Final = 10.0  # simulated time
SEEDS: Final = 40
MAX_PACKETS: Final = 20_000  # that a sender of the co-simulation has to send
AT_S: Final = (0.2, 0.3, 0.5, 1.0, 2.0, 5.0)
"""Times at which the congestion window is printed."""
SEGMENT_BYTES: Final = TcpOptions().segment_bytes


@dataclass(frozen=True)
class Losses:
    """Packets that the cable loses, by their numbers from 0, the handshake included.

    Attributes:
        data: Lost packets to the receiver: 0 is the SYN, 1 the ACK of the handshake, 2 the first with data.
        acks: Lost packets to the sender: 0 is the SYN-ACK.
    """

    data: Collection[int]
    acks: Collection[int] = ()


PATTERNS: Final = {
    "1 packet": Losses([100]),
    "3 packets": Losses([100, 101, 130]),
    "burst of 20": Losses(range(100, 120)),
    "burst of 110": Losses(range(100, 210)),
}
"""The longest burst includes the remaining packets of a window, all packets that the ACKs of this window release, and
two series of retransmissions."""

RANDOM_LOSSES: Final = {
    "2 % of data": (0.02, 0.0, SECONDS),
    "14 % of data": (0.14, 0.0, SECONDS),
    "7 % each way": (0.07, 0.07, SECONDS),
    "40 % of data": (0.4, 0.0, 100.0),
}
"""Loss shares of data and of ACKs, and the duration in seconds.

The losses of data are similar to those at 20 m behind the wall of `cosim_vs_ns3`, and at 47 m in line of sight.
"""

PEERS: Final = {"ns-3": "ns3::{}", "corrected": "Counting{}", "no clamp": "Counting{}"}
"""Patterns of the class names of congestion controls: of ns-3, of the corrected variant, and of the corrected variant
without CUBIC's clamp.

The corrected variant does not count data again when it is acknowledged after a SACK; `ns3_link_streams.h` explains
this. With the clamp the window grows after a timeout by at least one segment per 20 acknowledged segments. Without
the clamp it grows by at least one per 255 segments, the largest value that can be set.
"""


def random_losses(seed: int, data: float, acks: float) -> Losses:
    """Return random losses of these shares, without losses in the handshake, which does not affect the window."""
    draws = np.random.default_rng(seed).random((2, MAX_PACKETS))
    draws[:, :2] = 1
    lost = [np.flatnonzero(row < share).tolist() for row, share in zip(draws, (data, acks), strict=True)]
    return Losses(*lost)


@dataclass(frozen=True)
class Run:
    """A run of a sender.

    Attributes:
        events: Time in ns, kind and value of each event: `window` and `threshold` in segments, `timeout` in ms,
            `sent` with the number of the segment, from 0, and in ns-3 also `state` with the number of the state.
        mbit_s: Its goodput.
    """

    events: list[tuple[int, str, float]]
    mbit_s: float

    @property
    def sent(self) -> list[tuple[int, float]]:
        """Time and number of each sent segment."""
        return [(at_ns, value) for at_ns, kind, value in self.events if kind == "sent"]

    def window_at(self, at_s: float) -> float:
        """Return the congestion window at a time, in segments; NaN before the first event with a window."""
        before = (value for at_ns, kind, value in reversed(self.events) if kind == "window" and at_ns <= at_s * 1e9)
        return next(before, math.nan)


def run_cosim(control: Control, losses: Losses, seconds: float = SECONDS) -> Run:
    """Return a run of the co-simulation's sender."""
    samples: list[TcpSample] = []
    wire = ScriptedWire(
        DELAY_MS * 1_000_000,
        rate_bit_s=RATE_MBIT_S * 1_000_000,
        queue_packets=QUEUE_PACKETS,
        script=lose_packets({"a": frozenset(losses.data), "b": frozenset(losses.acks)}),
    )
    transport = wire.transports["tcp"] = Tcp(wire, TcpOptions(congestion=control), log=samples.append)
    for number in range(MAX_PACKETS):
        transport.send(Packet(number, "a", "b", SEGMENT_BYTES, ("stream", number), 0, 0, "tcp"))
    wire.run(round(seconds * 1e9))
    events: list[tuple[int, str, float]] = []
    for sample in samples:
        events.append((sample.at_ns, "window", sample.window_bytes / SEGMENT_BYTES))
        events.append((sample.at_ns, "timeout", sample.timeout_ns / 1e6))
        if sample.threshold_bytes is not None:
            events.append((sample.at_ns, "threshold", sample.threshold_bytes / SEGMENT_BYTES))
    for packet in wire.transmitted:
        segment = packet.packet.body[1]
        if segment.length:
            events.append((packet.at_ns, "sent", segment.first // SEGMENT_BYTES))
    events.sort(key=lambda event: event[0])
    return Run(events, len(wire.delivered) * SEGMENT_BYTES * 8 / seconds / 1e6)


def run_ns3(ns3: Ns3, peer: str, control: Control, losses: Losses, seconds: float = SECONDS) -> Run:
    """Return a run of the sender of one of the `PEERS`."""
    lost = {"lost-data": losses.data, "lost-acks": losses.acks}
    options: dict[str, object] = {name: ",".join(map(str, numbers)) for name, numbers in lost.items() if numbers}
    if peer == "no clamp":
        options["ns3::TcpCubic::CntClamp"] = 255
    lines = ns3(
        what="tcp",
        cable=1,
        control=PEERS[peer].format(CONTROLS[control]),
        rate=RATE_MBIT_S,
        delay=DELAY_MS,
        queue=QUEUE_PACKETS,
        seconds=seconds,
        **options,
    ).splitlines()
    units = {"window": SEGMENT_BYTES, "threshold": SEGMENT_BYTES, "timeout": 1e6, "sent": SEGMENT_BYTES, "state": 1}
    words = (line.split() for line in lines[:-1])
    events = [
        (int(at_ns), kind, int(value) // SEGMENT_BYTES if kind == "sent" else int(value) / units[kind])
        for at_ns, kind, value in words
    ]
    return Run(events, float(lines[-1].split()[0]))


def first_difference_ns(first: Run, second: Run) -> int | None:
    """Return the time at which two senders first sent different segments, or None if they never did."""
    for a, b in zip_longest(first.sent, second.sent):
        if a is None or b is None:
            return (a or b)[0]
        if a[1] != b[1]:
            return min(a[0], b[0])
    return None


def paired_ratio(ours_mbit_s: np.ndarray, peers_mbit_s: np.ndarray) -> tuple[float, float]:
    """Return the ratio of the mean goodputs, and half of its 95 % interval. Runs with equal losses are paired."""
    ratio = float(ours_mbit_s.mean() / peers_mbit_s.mean())
    error = float(
        (ours_mbit_s - ratio * peers_mbit_s).std(ddof=1) / peers_mbit_s.mean() / math.sqrt(len(ours_mbit_s))
    )
    return ratio, float(student.ppf(0.975, len(ours_mbit_s) - 1)) * error


def pattern_lines(ns3: Ns3) -> Iterator[str]:
    """Yield windows and goodputs after fixed loss patterns."""
    yield f"{'segments after (s)':32}" + " ".join(f"{at_s:6}" for at_s in AT_S)
    for control in CONTROLS:
        for name, losses in PATTERNS.items():
            runs = {peer: run_ns3(ns3, peer, control, losses) for peer in PEERS} | {
                "ours": run_cosim(control, losses)
            }
            for peer, run in runs.items():
                windows = " ".join(f"{run.window_at(at_s):6.1f}" for at_s in AT_S)
                yield f"{control:9}{name:14}{peer:9}{windows}  {run.mbit_s:.2f} Mbit/s"


def random_loss_lines(ns3: Ns3) -> Iterator[str]:
    """Yield goodputs under random losses, the same for all."""
    for control in CONTROLS:
        for name, (data, acks, seconds) in RANDOM_LOSSES.items():
            goodputs: dict[str, list[float]] = {peer: [] for peer in (*PEERS, "ours")}
            for seed in range(SEEDS):
                losses = random_losses(seed, data, acks)
                for peer in PEERS:
                    goodputs[peer].append(run_ns3(ns3, peer, control, losses, seconds).mbit_s)
                goodputs["ours"].append(run_cosim(control, losses, seconds).mbit_s)
            mbit_s = {peer: np.array(values) for peer, values in goodputs.items()}
            means = " ".join(f"{peer} {values.mean():.3f}" for peer, values in mbit_s.items())
            ratios = (paired_ratio(mbit_s["ours"], mbit_s[peer]) for peer in PEERS)
            yield f"{control:9}{name:14}{means} | ours relative to peers " + " ".join(
                "{:.2f} ({:.2f})".format(*pair) for pair in ratios
            )


def event_lines(ns3: Ns3, name: str, control: Control) -> Iterator[str]:
    """Yield the events of the unchanged ns-3 and of the co-simulation's sender around their first difference."""
    runs = {"ns-3": run_ns3(ns3, "ns-3", control, PATTERNS[name]), "ours": run_cosim(control, PATTERNS[name])}
    at_ns = first_difference_ns(*runs.values())
    if at_ns is None:
        yield "both send the same segments"
        return
    around_ns = 5_000_000
    for peer, run in runs.items():
        for event_ns, kind, value in run.events:
            if abs(event_ns - at_ns) <= around_ns:
                yield f"{peer:6}{event_ns / 1e6:10.3f} ms  {kind:10}{value:.2f}"


def main() -> None:
    """Print both tables, or the events of one pattern."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--events", nargs=2, metavar=("PATTERN", "CONTROL"), help="print events around the first difference"
    )
    arguments = parser.parse_args()
    if arguments.events and (arguments.events[0] not in PATTERNS or arguments.events[1] not in get_args(Control)):
        parser.error(f"patterns: {', '.join(PATTERNS)}; controls: {', '.join(CONTROLS)}")
    ns3 = build()
    tables = (pattern_lines(ns3), random_loss_lines(ns3))
    lines = event_lines(ns3, *arguments.events) if arguments.events else chain(*tables)
    for line in lines:
        print(line, flush=True)


if __name__ == "__main__":
    main()
