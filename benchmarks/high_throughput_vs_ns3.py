"""802.11n, ac and ax compared with ns-3: `python -m benchmarks.high_throughput_vs_ns3 [--json]`.

Needs ns-3 3.37 and a C++ compiler: `apt-get install libns3-dev g++`. Airtimes are compared for all modes at 5 GHz,
and packet errors of 1000 bytes for the modes with one stream in 40 MHz and a guard interval of 800 ns. Known
differences of airtimes are due to ns-3: it does not end the data of short guard intervals at multiples of 4 us (IEEE
802.11-2020, 19.4.3, 21.4.3), omits VHT-SIG-B (4 us) of frames to one station, and uses 8 us for each HE-LTF at all
guard intervals. Then goodput with A-MPDU is compared in one mode: for one station at signal-to-noise ratios down to
the limit of its range; for several stations, as a mean of several seeds; with RTS; with A-MSDUs; and with access
categories. In rows `bare` and in rows with an access category, ns-3 waits for the ADDBA Response for 1 s, as Linux
does, has no retry limit, and sends no BlockAckReq: ns-3 3.37 does not reset its count of failed aggregates to a
receiver when an aggregate succeeds, so it drops a whole aggregate at the seventh failure.
"""

import argparse
import json
import statistics
import sys
from collections.abc import Iterator
from typing import Final

import numpy as np

from benchmarks.radio_vs_ns3 import NOISE_DBM, PAYLOAD_BYTES, SENSITIVITY_DBM, TX_POWER_DBM, Ns3, Row, build, shift_db
from sim_backends.radio.antennas import Antenna
from sim_backends.radio.phy.error_rates import packet_error
from sim_backends.radio.phy.high_throughput import HighThroughput, PhyCapability, format_modes, guard_intervals_ns
from sim_backends.radio.phy.modes import WifiMode
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.radio.wifi import Wifi
from sim_backends.radio.world_channel import WorldChannel

WIDTHS_MHZ: Final[dict[HighThroughput, tuple[int, ...]]] = {"HT": (20, 40), "VHT": (20, 40, 80), "HE": (20, 40, 80)}
STREAMS: Final = (1, 2)
HT20_7: Final = format_modes("HT", "2.4 GHz", 20, 1, 800)[7]
"""The mode of the goodputs: MCS 7 of 802.11n with one stream in 20 MHz."""
RATIOS_DB: Final = (40.0, 26.0, 24.5, 24.0, 23.5, 23.0)
"""Signal-to-noise ratios of a single station."""
STATIONS: Final = (2, 5, 10, 20)
AMSDU_BYTES: Final = 3_839
AMSDU_STATIONS: Final = (1, 2, 5, 10, 20)
DSCPS: Final = {"background": 8, "video": 40, "voice": 48}
QUEUED: Final = 300
"""Packets in the queue of each station; a packet that arrived is replaced by a new one."""
SECONDS: Final = 3.0  # simulated time
SEEDS: Final = (1, 2, 3, 4, 5, 6)
"""Seeds of the runs with several stations, whose goodputs differ by up to 6 % between seeds."""
HE_LTF_NS: Final = {800: 7_200, 1600: 8_000, 3200: 16_000}
"""Duration of one HE-LTF, by guard interval in ns."""


def mcs_of(mode: WifiMode) -> int:
    """Return the number of a mode's modulation and coding scheme (MCS), from 0 for each number of streams.

    802.11n itself continues the numbers: 8 to 15 have two streams.
    """
    return int(mode.name.split("-mcs")[1].split("-")[0]) % (8 if mode.phy_format == "HT" else 100)


def ns3_options(mode: WifiMode) -> dict[str, object]:
    """Return the options of the ns-3 program for a mode."""
    prefix = {"HT": "Ht", "VHT": "Vht", "HE": "He"}[mode.phy_format]
    number = mcs_of(mode) + (8 * (mode.streams - 1) if mode.phy_format == "HT" else 0)
    return {
        "mode": f"{prefix}Mcs{number}",
        "width": mode.width_mhz,
        "streams": mode.streams,
        "guard": mode.guard_interval_ns,
        "band": f"BAND_{mode.band.name.replace(' ', '').replace('.', '_').upper()}",
    }


def all_modes() -> Iterator[WifiMode]:
    """Return the modes of all formats at 5 GHz."""
    for phy_format, widths_mhz in WIDTHS_MHZ.items():
        for width_mhz in widths_mhz:
            for streams in STREAMS:
                for guard_ns in guard_intervals_ns(phy_format):
                    yield from format_modes(phy_format, "5 GHz", width_mhz, streams, guard_ns)


def unexplained_ns(mode: WifiMode, size_bytes: int, ns3_ns: int) -> int:
    """Return the difference of an airtime from that of ns-3, without the differences listed above in this module."""
    airtime_ns = mode.airtime_ns(size_bytes)
    if mode.phy_format == "VHT":
        airtime_ns -= 4_000
    if mode.phy_format == "HE":
        airtime_ns += (8_000 - HE_LTF_NS[mode.guard_interval_ns]) * mode.streams
    difference_ns = airtime_ns - ns3_ns
    return 0 if 0 <= difference_ns < mode.granularity_ns else difference_ns


def airtime_differences(ns3: Ns3) -> dict[str, int]:
    """Return the largest unexplained difference of the airtimes of each mode, in ns."""
    differences = {}
    for mode in all_modes():
        lines = ns3(what="durations", **ns3_options(mode)).splitlines()
        pairs = [tuple(map(int, line.split())) for line in lines]
        differences[mode.name] = max((unexplained_ns(mode, *pair) for pair in pairs), key=abs)
    return differences


def error_curves(ns3: Ns3) -> dict[str, list[tuple[float, float, float]]]:
    """Return, for each mode with one stream in 40 MHz, points of the SNR in dB and both packet errors.

    The errors are those of ns-3 and of the radio model. Only modes with a guard interval of 800 ns are compared.
    """
    curves = {}
    for mode in all_modes():
        if mode.streams == 1 and mode.width_mhz == WIDTHS_MHZ["HT"][-1] and mode.guard_interval_ns == 800:
            lines = ns3(what="errors", payload=PAYLOAD_BYTES, **ns3_options(mode)).splitlines()
            points = [(float(ratio), float(error)) for ratio, error in (line.split() for line in lines)]
            curves[mode.name] = [(ratio, error, packet_error(mode, ratio, PAYLOAD_BYTES)) for ratio, error in points]
    return curves


def goodput_mbit_s(
    mode: WifiMode,
    ratio_db: float,
    stations: int,
    *,
    rts: bool = False,
    dscp: int | None = None,
    amsdu_max_bytes: int | None = None,
    seed: int = 1,
) -> float:
    """Return the goodput of saturated stations with A-MPDU in the radio model, all at one signal-to-noise ratio.

    Args:
        mode: Their mode.
        ratio_db: The ratio.
        stations: Number of stations.
        rts: True if they send RTS before each aggregate.
        dscp: DSCP of all packets, for stations with access categories; None for stations without.
        amsdu_max_bytes: Maximum size of A-MSDUs; None for none.
        seed: Seed of all random draws.
    """
    phy = PhyCapability(
        "n" if mode.phy_format == "HT" else "ac" if mode.phy_format == "VHT" else "ax",
        mode.band.name,
        mode.width_mhz,
        mode.streams,
        mode.guard_interval_ns,
        rts_threshold_bytes=0 if rts else None,
        access_categories=None if dscp is None else "linux",
        amsdu_max_bytes=amsdu_max_bytes,
    )
    names = [*(f"s{number}" for number in range(stations)), "receiver"]
    antennas = {name: Antenna("802.11n", TX_POWER_DBM, SENSITIVITY_DBM, phy) for name in names}
    channel = WorldChannel(1, antennas, RadioOptions(fading=False, noise_floor_dbm=NOISE_DBM, mode=mode.name))
    channel.use_losses(np.where(np.eye(len(names), dtype=bool), np.inf, _loss_db(ratio_db)))
    wifi: Wifi[str] = Wifi(channel, seed)
    lost: list[str] = []
    wifi.log_losses(lambda _now_ns, source, _receiver, _reason: lost.append(source))
    for name in names[:-1]:
        for _ in range(QUEUED):
            wifi.send(0, name, name, PAYLOAD_BYTES + 28, "receiver", dscp=dscp or 0)
    arrived = 0
    while (now_ns := wifi.next_event_ns()) is not None and now_ns < SECONDS * 1e9:
        sources = [source for _, _, _, source, _ in wifi.deliveries(now_ns)]
        arrived += len(sources)
        sources += lost  # a lost packet is replaced, too
        lost.clear()
        for source in sources:
            wifi.send(now_ns, source, source, PAYLOAD_BYTES + 28, "receiver", dscp=dscp or 0)
    return arrived * PAYLOAD_BYTES * 8 / SECONDS / 1e6


def _loss_db(ratio_db: float) -> float:
    """Return the path loss that gives a signal-to-noise ratio in 20 MHz."""
    return TX_POWER_DBM - NOISE_DBM - ratio_db


def _stations_text(stations: int) -> str:
    return f"{stations} station{'s' * (stations != 1)}"


def _compare(
    ns3: Ns3,
    name: str,
    options: dict[str, object],
    stations: int,
    *,
    ratio_db: float = 50.0,
    rts: bool = False,
    dscp: int | None = None,
    amsdu_max_bytes: int | None = None,
) -> Row:
    """Return the goodputs of ns-3 with `options` and of the radio model with the other arguments."""
    seeds = SEEDS if stations > 1 else SEEDS[:1]
    options = ns3_options(HT20_7) | {"loss": _loss_db(ratio_db), "ampdu": 65_535, "stations": stations} | options
    ns3_values = [float(ns3(seconds=SECONDS, payload=PAYLOAD_BYTES, RngRun=seed, **options)) for seed in seeds]
    own_values = [
        goodput_mbit_s(HT20_7, ratio_db, stations, rts=rts, dscp=dscp, amsdu_max_bytes=amsdu_max_bytes, seed=seed)
        for seed in seeds
    ]
    return f"{name}{_stations_text(stations)}", statistics.fmean(ns3_values), statistics.fmean(own_values)


def goodputs(ns3: Ns3) -> Iterator[Row]:
    """Yield goodputs in Mbit/s over the signal-to-noise ratio, and for contending stations."""
    for ratio_db, stations in (*((ratio_db, 1) for ratio_db in RATIOS_DB), *((50.0, count) for count in STATIONS)):
        yield _compare(ns3, f"{HT20_7.name}, {ratio_db} dB, ", {}, stations, ratio_db=ratio_db)
    bare: dict[str, object] = {"bare": 1}
    for stations in STATIONS:
        yield _compare(ns3, "bare, ", bare, stations)
        yield _compare(ns3, "bare, RTS, ", bare | {"rts": 0}, stations, rts=True)
    for stations in AMSDU_STATIONS:
        options = bare | {"amsdu": AMSDU_BYTES}
        yield _compare(ns3, "A-MSDU, bare, ", options, stations, amsdu_max_bytes=AMSDU_BYTES)
    for category, dscp in DSCPS.items():
        for stations in (1, 2):
            yield _compare(ns3, f"{category}, ", bare | {"classes": dscp << 2}, stations, dscp=dscp)


def main() -> None:
    """Run both and print the differences."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print single values as JSON")
    arguments = parser.parse_args()
    ns3 = build()
    differences, curves, rows = airtime_differences(ns3), error_curves(ns3), list(goodputs(ns3))
    if arguments.json:
        json.dump({"airtime_difference_ns": differences, "packet_error": curves, "goodput_mbit_s": rows}, sys.stdout)
        return
    largest_ns = max(differences.values(), key=abs)
    print(f"airtimes of {len(differences)} modes: largest unexplained difference {largest_ns} ns")
    print("packet error against ratio, largest shift at errors of 50, 10 and 1 % (dB):")
    print("  " + ", ".join(f"{name} {shift_db(curve):+.2f}" for name, curve in curves.items()))
    print(f"{'UDP goodput (Mbit/s)':44}{'ns-3':>9}{'ours':>9}")
    for what, ns3_value, own_value in rows:
        print(f"{what:44}{ns3_value:9.2f}{own_value:9.2f}")


if __name__ == "__main__":
    main()
