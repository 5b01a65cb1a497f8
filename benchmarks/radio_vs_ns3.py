"""The radio model compared with ns-3 on equal links: `python -m benchmarks.radio_vs_ns3 [--figure FILE] [--json]`.

Needs ns-3 3.37 and a C++ compiler: `apt-get install libns3-dev g++`. In both simulators the stations have the same
transmit power, noise, path loss, packet sizes and slot times. ns-3 uses its DCF, its receiver and its NIST error
model. Neither simulator aggregates frames.
"""

import argparse
import json
import math
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from typing_extensions import override

from sim_backends.federates.compiling import CompiledProgram
from sim_backends.ns3.federate import standard_flag, version
from sim_backends.radio.antennas import Antenna
from sim_backends.radio.phy.error_rates import packet_error
from sim_backends.radio.phy.high_throughput import PhyCapability
from sim_backends.radio.phy.modes import CHANNEL_6_HZ, G_MODES, N_MODES, WifiMode
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.radio.wifi import Wifi
from sim_backends.radio.world_channel import WorldChannel

SOURCE: Final = Path(__file__).with_name("ns3_link.cc")
LIBRARIES: Final = (
    *("core", "network", "internet", "mobility", "wifi"),
    *("applications", "propagation", "traffic-control", "point-to-point"),
)
PAYLOAD_BYTES: Final = 1000
SECONDS: Final = 10.0  # simulated time
TX_POWER_DBM, SENSITIVITY_DBM = 17.0, -82.0
NOISE_DBM: Final = 10 * math.log10(1.3803e-23 * 290 * 20e6 * 1e3) + 6
"""-94.97 dBm, as ns-3 computes it: thermal noise of 20 MHz at 290 K, with its value of the Boltzmann constant, and a
noise figure of 6 dB. With -95 dBm up to 7 % fewer datagrams are lost at the edge of a link."""
DISTANCES_M: Final = (5, 10, 20, 30, 40, 50, 60, 70, 80, 90)
STATIONS: Final = (1, 2, 5, 10)
STRONG_DB: Final = 52.0
PAIR_RATIOS_DB: Final = (52.0, 15.0, 8.0)
"""Ratios of signal to noise of the first pair at the second pair, which at 15 dB decodes only the ACKs of the first
pair, and at 8 dB none of its frames (EIFS). In ns-3, EIFS of 802.11g has an ACK of 802.11b, so 802.11a is used."""
FIXED: Final = tuple(mode for mode in G_MODES if mode.name in {"g6", "g24", "g54"})

Row = tuple[str, float, float]
"""Name of the measurement, the value of ns-3, and the value of the radio model."""


def ns3_name(mode: WifiMode) -> str:
    """Return the name of a mode in ns-3."""
    return f"HtMcs{mode.name[1:]}" if mode.is_high_throughput else f"ErpOfdmRate{mode.name[1:]}Mbps"


@dataclass(frozen=True)
class Ns3:
    """The ns-3 program; a call runs it with options and returns its output."""

    program: Path

    def __call__(self, **options: object) -> str:
        """Run the program with these options and return its output."""
        words = [f"--{name}={value}" for name, value in options.items()]
        return subprocess.run([self.program, *words], check=True, timeout=600, capture_output=True, text=True).stdout


def build() -> Ns3:
    """Compile the ns-3 program on first use, and return it."""
    program = CompiledProgram(
        "ns3-link",
        SOURCE,
        ("ns3-core", "ns3-wifi"),
        "apt-get install g++ libns3-dev",
        flags=("-O2", standard_flag(version())),
        libraries=tuple(f"-lns3-{name}" for name in LIBRARIES),
    )
    return Ns3(program.path())


def packet_errors(ns3: Ns3) -> dict[str, list[tuple[float, float, float]]]:
    """Return per mode the SNR in dB and the packet error of 1000 bytes, of ns-3 and of the radio model."""
    curves = {}
    for mode in (*G_MODES, *N_MODES):
        lines = ns3(what="errors", mode=ns3_name(mode), payload=PAYLOAD_BYTES).splitlines()
        points = [(float(ratio), float(error)) for ratio, error in (line.split() for line in lines)]
        curves[mode.name] = [(ratio, error, packet_error(mode, ratio, PAYLOAD_BYTES)) for ratio, error in points]
    return curves


def shift_db(curve: Sequence[tuple[float, float, float]]) -> float:
    """Return the largest shift between the two curves at errors of 50, 10 and 1 %, model minus ns-3."""

    def at(level: float, column: int) -> float:
        """Return the lowest SNR of the curve in `column` with a smaller error than `level`."""
        return next(point[0] for point in curve if point[column] < level)

    return max((at(level, 2) - at(level, 1) for level in (0.5, 0.1, 0.01)), key=abs)


def goodput_mbit_s(
    distance_m: float, *, stations: int = 1, mode: WifiMode | None = None, relay: bool = False
) -> float:
    """Return the goodput of saturated stations in the radio model, all `distance_m` apart."""
    names = [f"s{n}" for n in range(stations)] + ["receiver"] + ["relay"] * relay
    antennas = {name: Antenna("802.11g", TX_POWER_DBM, SENSITIVITY_DBM) for name in names}
    options = RadioOptions(fading=False, noise_floor_dbm=NOISE_DBM, mode=mode.name if mode else None)
    space = _Equidistant(1, antennas, options)
    space.set_distance(distance_m)
    wifi: Wifi[str] = Wifi(space, 1)
    wifi.set_relay("relay" if relay else None)
    arrived = dropped = 0
    for name in names[:stations]:
        for _ in range(50):
            wifi.send(0, name, name, PAYLOAD_BYTES + 28, "receiver")
    while (now_ns := wifi.next_event_ns()) is not None and now_ns < SECONDS * 1e9:
        for at_ns, _, name, _, _ in wifi.deliveries(now_ns):
            arrived += 1
            wifi.send(at_ns, name, name, PAYLOAD_BYTES + 28, "receiver")
        # A dropped packet is replaced by a new one, so that the queues stay full.
        lost = sum(counters.lost for counters in wifi.counters().values())
        while dropped < lost:
            dropped += 1
            wifi.send(now_ns, names[dropped % stations], names[dropped % stations], PAYLOAD_BYTES + 28, "receiver")
    return arrived * PAYLOAD_BYTES * 8 / SECONDS / 1e6


def pair_goodputs_mbit_s(between_db: float) -> list[float]:
    """Return the goodputs of two pairs of 802.11a in the radio model, each with a saturated sender.

    The ratio of signal to noise is `STRONG_DB`, except for frames of the first pair at the second pair: `between_db`.
    """
    phy = PhyCapability("n", "5 GHz", 20, 1, 800)
    antennas = {name: Antenna("802.11n", TX_POWER_DBM, NOISE_DBM, phy) for name in "abcd"}
    options = RadioOptions(fading=False, noise_floor_dbm=NOISE_DBM, mode="a54")
    channel = _WithDifs(1, antennas, options)
    losses_db = np.where(np.eye(4, dtype=bool), np.inf, _loss_db(STRONG_DB))
    losses_db[:2, 2:] = _loss_db(between_db)
    channel.use_losses(losses_db)
    wifi: Wifi[str] = Wifi(channel, 1)
    receivers, arrived = {"a": "b", "c": "d"}, dict.fromkeys("ac", 0)
    for name, receiver in receivers.items():
        for _ in range(50):
            wifi.send(0, name, name, PAYLOAD_BYTES + 28, receiver)
    while (now_ns := wifi.next_event_ns()) is not None and now_ns < SECONDS * 1e9:
        for at_ns, _, name, _, _ in wifi.deliveries(now_ns):
            arrived[name] += 1
            wifi.send(at_ns, name, name, PAYLOAD_BYTES + 28, receivers[name])
    return [count * PAYLOAD_BYTES * 8 / SECONDS / 1e6 for count in arrived.values()]


def _loss_db(ratio_db: float) -> float:
    """Return the path loss that gives a signal-to-noise ratio."""
    return TX_POWER_DBM - NOISE_DBM - ratio_db


class _WithDifs(WorldChannel):
    """A channel on which stations at 5 GHz have no QoS."""

    @override
    def ifs_ns(self, station: int) -> int:
        return self.band.difs_ns


class _Equidistant(WorldChannel):
    """A channel in which all pairs of stations have the same distance, as in the ns-3 program.

    This is impossible in a plane, so the losses are set.
    """

    def set_distance(self, distance_m: float) -> None:
        count = len(self.names)
        self.use_losses(np.where(np.eye(count, dtype=bool), np.inf, path_loss_db(distance_m)))


def path_loss_db(distance_m: float) -> float:
    """Return the log-distance path loss with exponent 3 in dB, which ns-3 and the radio model use."""
    return 20 * math.log10(4 * math.pi * CHANNEL_6_HZ / 299_792_458.0) + 30 * math.log10(distance_m)


def rows(ns3: Ns3) -> list[Row]:
    """Return goodputs in Mbit/s over distance, for contending stations, and through an access point."""

    def ns3_mbit_s(**options: object) -> float:
        return float(ns3(seconds=SECONDS, payload=PAYLOAD_BYTES, **options))

    results: list[Row] = []
    for mode in FIXED:
        for distance_m in DISTANCES_M:
            ns3_value = ns3_mbit_s(loss=path_loss_db(distance_m), mode=ns3_name(mode))
            results.append((f"{mode.name}, {distance_m} m", ns3_value, goodput_mbit_s(distance_m, mode=mode)))
    for distance_m in DISTANCES_M:
        ns3_value = ns3_mbit_s(loss=path_loss_db(distance_m), adapt=1)
        results.append((f"minstrel, {distance_m} m", ns3_value, goodput_mbit_s(distance_m)))
    for mode in (FIXED[0], FIXED[-1]):
        for stations in STATIONS:
            ns3_value = ns3_mbit_s(loss=path_loss_db(5), mode=ns3_name(mode), stations=stations)
            fieldkit_mbit_s = goodput_mbit_s(5, stations=stations, mode=mode)
            results.append((f"{mode.name}, {stations} contending", ns3_value, fieldkit_mbit_s))
        ns3_value = ns3_mbit_s(loss=path_loss_db(5), mode=ns3_name(mode), relay=1)
        results.append((f"{mode.name}, through an access point", ns3_value, goodput_mbit_s(5, mode=mode, relay=True)))
    for between_db in PAIR_RATIOS_DB:
        ns3_values = ns3(
            what="pairs",
            loss=_loss_db(STRONG_DB),
            between=_loss_db(between_db),
            mode=f"Ofdm{ns3_name(FIXED[-1]).removeprefix('ErpOfdm')}",
            seconds=SECONDS,
            payload=PAYLOAD_BYTES,
        ).split()
        for pair, (ns3_word, fieldkit_mbit_s) in enumerate(
            zip(ns3_values, pair_goodputs_mbit_s(between_db), strict=True), 1
        ):
            results.append((f"a54, pair {pair}, {between_db:g} dB between", float(ns3_word), fieldkit_mbit_s))
    return results


def main() -> None:
    """Run both, print the table, and draw the figure if `--figure` is given; or only print JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true", help="print single values as JSON, and draw no figure")
    parser.add_argument("--figure", type=Path, help="write the curves of both to this SVG file")
    arguments = parser.parse_args()
    ns3 = build()
    curves, goodputs = packet_errors(ns3), rows(ns3)
    if arguments.json:
        json.dump({"packet_error": curves, "goodput_mbit_s": goodputs}, sys.stdout)
        return
    print("packet error over SNR, largest shift at errors of 50, 10 and 1 % (dB):")
    print("  " + ", ".join(f"{name} {shift_db(curve):+.2f}" for name, curve in curves.items()))
    print(f"{'UDP goodput (Mbit/s)':32}{'ns-3':>9}{'fieldkit':>9}{'ratio':>8}")
    for what, ns3_mbit_s, fieldkit_mbit_s in goodputs:
        ratio = f"{fieldkit_mbit_s / ns3_mbit_s:8.3f}" if ns3_mbit_s > 0.05 else f"{'-':>8}"
        print(f"{what:32}{ns3_mbit_s:9.2f}{fieldkit_mbit_s:9.2f}{ratio}")
    if arguments.figure:
        draw(arguments.figure, curves, goodputs)


def draw(path: Path, curves: dict[str, list[tuple[float, float, float]]], goodputs: Sequence[Row]) -> None:
    """Draw the curves of ns-3 as lines and of the radio model as marks."""
    import matplotlib as mpl  # noqa: PLC0415 (needed only for the figure)
    from matplotlib.figure import Figure  # noqa: PLC0415

    mpl.rcParams["svg.hashsalt"] = "radio_vs_ns3"
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    for number, mode in enumerate(G_MODES):
        points = [point for point in curves[mode.name] if -2 < point[0] < 26]
        colour = f"C{number}"
        left.plot([p[0] for p in points], [p[1] for p in points], color=colour, label=f"{mode.rate_bit_s / 1e6:g}")
        left.plot([p[0] for p in points[::5]], [p[2] for p in points[::5]], ".", color=colour)
    left.set(xlabel="signal to noise (dB)", ylabel="share of frames lost", yscale="log", ylim=(1e-3, 1.2))
    left.legend(title="Mbit/s", fontsize="small")
    for number, name in enumerate(["g6", "g24", "g54", "minstrel"]):
        name_rows = [row for row in goodputs if row[0].startswith(f"{name}, ") and row[0].endswith(" m")]
        distances_m = [float(row[0].split()[1]) for row in name_rows]
        right.plot(distances_m, [row[1] for row in name_rows], color=f"C{number}", label=name)
        right.plot(distances_m, [row[2] for row in name_rows], "o", color=f"C{number}", markerfacecolor="none")
    right.set(xlabel="distance (m)", ylabel="saturated UDP goodput (Mbit/s)", ylim=(-1, 33))
    right.legend(title="ns-3: lines; ours: marks", fontsize="small", loc="upper right", ncols=2)
    figure.savefig(path, metadata={"Date": None})


if __name__ == "__main__":
    main()
