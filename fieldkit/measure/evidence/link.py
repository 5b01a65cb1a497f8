"""Columns of the Wi-Fi links of sender and receiver during an attempt, computed from samples.

A radio can have several peers. For an access point, the columns describe the link to the station with which it
exchanged the most packets. For a station, they describe its link to its access point, including the links after it
roamed to another one. As in the output of `iw`, a `StationSample` describes any peer, which may be an access point.
"""

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from statistics import median
from typing import Final

from fieldkit.core.columns import BACKGROUND, Column, Figure, Kind, Measured, Value, cell_text, columns
from fieldkit.core.model import LinkSample, Role, StationSample

_DBM: Final = (-300.0, 100.0)
"""Valid range of a signal or noise."""
_NOT_SAMPLED: Final = "the robot's radio was not sampled: the robot has no Wi-Fi or no iw, or was not associated"
_NOT_REPORTED: Final = "the robot's radio does not report it"
_RESET: Final = "the link was established again, and the last counts of the earlier link were not sampled"
_COUNTERS: Final = {
    "radio_tx_packets": "tx_packets",
    "radio_rx_packets": "rx_packets",
    "tx_retries": "tx_retries",
    "tx_failures": "tx_failures",
    "beacon_losses": "beacon_losses",
}
"""Attribute of `StationSample` by column."""
_MAX_UNSAMPLED_NS: Final = 2 * 10**9
"""If counters are reset, the counts since the last sample are lost. These counts are negligible if at most this time
is between the samples before and after the reset. Even a slow shell takes one sample per second.
"""


def _role_columns(role: Role) -> tuple[Column, ...]:
    """Return the columns of the link of one robot."""
    return columns(
        150,
        (
            f"{role}_signal_median_dbm",
            "dBm",
            (
                f"Median over the repeat of the signal that the {role}'s radio receives from its peer, the station "
                "or access point with which it exchanges the most packets. Columns of radios are empty for a robot "
                "without Wi-Fi or iw, and if the driver does not report the value."
            ),
            Figure(f"signal, {role}", Kind.MEDIAN, rank=BACKGROUND),
            _DBM,
        ),
        (f"{role}_signal_min_dbm", "dBm", f"Weakest signal that the {role}'s radio receives from its peer.", _DBM),
        (f"{role}_signal_last_dbm", "dBm", f"Last signal that the {role}'s radio receives from its peer.", _DBM),
        (f"{role}_noise_dbm", "dBm", f"Median over the repeat of the noise in the {role}'s channel.", _DBM),
        (
            f"{role}_busy_share",
            "share",
            f"Share of the time in which the channel of the {role}'s radio was busy, including its transmissions.",
            Figure(f"channel busy, {role}", Kind.MEAN, rank=BACKGROUND + 3),
        ),
        (
            f"{role}_tx_rate_bit_s",
            "bit/s",
            f"Median over the samples of the PHY rate of the {role}'s last frame to the peer.",
            Figure(f"PHY rate, {role}", Kind.MEDIAN, rank=BACKGROUND + 1),
        ),
        (f"{role}_rx_rate_bit_s", "bit/s", "Median over the samples of the PHY rate of the peer's last frame."),
        (f"{role}_radio_tx_packets", "count", f"Packets of all programs that the {role}'s radio sent to the peer."),
        (f"{role}_radio_rx_packets", "count", f"Packets that the {role}'s radio received from the peer."),
        (
            f"{role}_tx_retries",
            "count",
            f"Frames that the {role}'s radio retransmitted to the peer because no acknowledgement arrived.",
            Figure(f"Wi-Fi retries, {role}", Kind.MEDIAN, rank=BACKGROUND + 2),
        ),
        (
            f"{role}_tx_failures",
            "count",
            f"Packets to the peer that the {role}'s radio dropped after the last retry.",
        ),
        (f"{role}_beacon_losses", "count", f"Number of times that the {role}'s radio missed beacons of the peer."),
        (
            f"{role}_roams",
            "count",
            f"Number of times that the {role} roamed to another access point; empty if it is not a station.",
        ),
        (f"{role}_link_samples", "count", f"Samples of the {role}'s radio from which the columns are computed."),
    )


ROLES: Final = (Role.SENDER, Role.RECEIVER)
"""Roles whose links have columns."""

_COLUMNS: Final = {role: _role_columns(role) for role in ROLES}
COLUMNS: Final = tuple(column for role_columns in _COLUMNS.values() for column in role_columns)


def measure(role: Role, samples: Sequence[LinkSample]) -> Measured:
    """Return the columns of one robot.

    Args:
        role: One of `ROLES`.
        samples: Samples of its radio, in the order of time.
    """
    if not samples:
        return Measured.all_missing(_COLUMNS[role], _NOT_SAMPLED)
    link = link_history(samples)
    signals = _present(station.signal_dbm for _, station in link)
    counts, has_lost_counts = _counts(link)
    values: dict[str, Value | None] = {
        "signal_median_dbm": median(signals) if signals else None,
        "signal_min_dbm": min(signals, default=None),
        "signal_last_dbm": signals[-1] if signals else None,
        "noise_dbm": _median(sample.noise_dbm for sample in samples),
        "busy_share": busy_share(samples),
        "tx_rate_bit_s": _median(station.tx_rate_bit_s for _, station in link),
        "rx_rate_bit_s": _median(station.rx_rate_bit_s for _, station in link),
        **counts,
        "roams": _roams(samples),
        "link_samples": len(samples),
    }
    measured = Measured.from_optional({f"{role}_{name}": value for name, value in values.items()}, _NOT_REPORTED)
    if has_lost_counts:
        measured = measured.without({f"{role}_{name}": _RESET for name, count in counts.items() if count is not None})
    # Impossible values that a driver reports are removed, because a table with such values cannot be read again.
    impossible = (
        column.name
        for column in _COLUMNS[role]
        if column.invalid_value_reason(cell_text(measured.values.get(column.name)))
    )
    return measured.without(dict.fromkeys(impossible, _NOT_REPORTED))


def link_history(samples: Sequence[LinkSample]) -> list[tuple[int, StationSample]]:
    """Return the times in ns and the statistics of a radio's link, in the order of time.

    A station is associated with one access point at a time, although its samples can contain others.
    """
    associated = next((sample.cell for sample in samples if sample.cell), "")
    if any(sample.cell for sample in samples):  # the radio is a station
        station_names = {station.station for sample in samples for station in sample.stations}
    else:
        station_names = {_busiest_peer(samples), ""}
    link = []
    for sample in samples:
        associated = sample.cell or associated
        candidates = [station for station in sample.stations if station.station in station_names]
        # The last candidate is used: the associated peer or, without it, another one. A sample of /proc/net/wireless
        # has no name of a peer, and is used only if it is the only candidate.
        candidates.sort(key=lambda station: (station.station != "", station.station == associated))
        if candidates:
            link.append((sample.utc_ns, candidates[-1]))
    return link


def _counts(link: Sequence[tuple[int, StationSample]]) -> tuple[Mapping[str, int | None], bool]:
    """Return the increments of a link's counters by column, and True if some counts were lost.

    An increment is None if the counter was not reported at least twice. The counters start from 0 when a link is
    established again, to the same peer or to another.
    """
    samples = [(at_ns, station) for at_ns, station in link if any(count is not None for count in _counters(station))]
    links: list[list[StationSample]] = [[station for _, station in samples[:1]]]
    has_lost_counts = False
    for (previous_ns, previous), (at_ns, station) in pairwise(samples):
        if _is_new_link(previous, station):
            links.append([])
            has_lost_counts = has_lost_counts or at_ns - previous_ns > _MAX_UNSAMPLED_NS
        links[-1].append(station)
    return {column: _total_increment(counter, links) for column, counter in _COUNTERS.items()}, has_lost_counts


def _counters(station: StationSample) -> tuple[int | None, ...]:
    return tuple(getattr(station, counter) for counter in _COUNTERS.values())


def _is_new_link(before: StationSample, after: StationSample) -> bool:
    pairs = zip(_counters(before), _counters(after), strict=True)
    has_decreased = any(old is not None and new is not None and new < old for old, new in pairs)
    return after.station != before.station or has_decreased


def _total_increment(counter: str, links: Sequence[Sequence[StationSample]]) -> int | None:
    """Return the increment of a counter over successive links; None if it was not reported at least twice.

    Only the first link may start from a count above 0.
    """
    counts_by_link: list[list[int]] = [
        [count for station in link if (count := getattr(station, counter)) is not None] for link in links
    ]
    if sum(map(len, counts_by_link)) < 2:
        return None
    return sum(counts[-1] for counts in counts_by_link if counts) - (counts_by_link[0][0] if counts_by_link[0] else 0)


def _busiest_peer(samples: Sequence[LinkSample]) -> str:
    """Return the name of the peer with which the most packets were exchanged, or the first of several such peers.

    Empty if no sample has a peer.
    """
    names = dict.fromkeys(station.station for sample in samples for station in sample.stations)

    def packets(name: str) -> int:
        peer_samples = [station for sample in samples for station in sample.stations if station.station == name]
        return sum(
            _increment(counts) or 0
            for counts in (
                [sample.tx_packets for sample in peer_samples],
                [sample.rx_packets for sample in peer_samples],
            )
        )

    return max(names, key=packets, default="")


def busy_share(samples: Sequence[LinkSample]) -> float | None:
    """Return the share of the time in which the channel was busy.

    None without two reports of the channel's counters, or if its active time did not increase.
    """
    counters = [
        (sample.active_ns, sample.busy_ns)
        for sample in samples
        if sample.active_ns is not None and sample.busy_ns is not None
    ]
    active_ns = _increment(active for active, _ in counters)
    busy_ns = _increment(busy for _, busy in counters)
    return min(busy_ns / active_ns, 1.0) if active_ns and busy_ns is not None else None


def _increment(counts: Iterable[int | None]) -> int | None:
    """Return the increment of a counter, or None without two reports. A counter that decreases restarted from 0."""
    present = [count for count in counts if count is not None]
    if len(present) < 2:
        return None
    return sum(after - before if after >= before else after for before, after in pairwise(present))


def access_points(samples: Sequence[LinkSample]) -> list[tuple[int, str]]:
    """Return the times in ns at which a robot was associated as a station, each with its access point.

    Empty if the robot was never associated as a station.
    """
    if not any(sample.cell for sample in samples):
        return []
    # A station dump also contains the access point, and may be the only sample of an association.
    peers_by_sample = [{station.station for station in sample.stations if station.station} for sample in samples]
    cells = [
        sample.cell or ("".join(peers) if len(peers) == 1 else "")
        for sample, peers in zip(samples, peers_by_sample, strict=True)
    ]
    return [(sample.utc_ns, cell) for sample, cell in zip(samples, cells, strict=True) if cell]


def _roams(samples: Sequence[LinkSample]) -> int | None:
    associated = access_points(samples)
    return sum(before != after for (_, before), (_, after) in pairwise(associated)) if associated else None


def _median(values: Iterable[float | None]) -> float | None:
    present = _present(values)
    return median(present) if present else None


def _present(values: Iterable[float | None]) -> list[float]:
    return [value for value in values if value is not None]
