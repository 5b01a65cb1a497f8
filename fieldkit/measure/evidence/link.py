"""The Wi-Fi links of sender and receiver over an attempt: columns out of samples.

A radio may know several others. An access point's link is the one with the most packets of the attempt; a station's
goes on from one access point to the next.
"""

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from statistics import median
from typing import Final

from fieldkit.core.columns import BACKGROUND, Column, Figure, Kind, Measured, Value, cell, columns
from fieldkit.core.model import LinkSample, Role, StationSample

_DBM: Final = (-300.0, 100.0)
_NOT_SAMPLED: Final = "nothing is known of its radio: it has no Wi-Fi, or no iw, or was joined to nobody"
_NOT_TOLD: Final = "its radio does not tell"
_LOST: Final = "its link was made anew, and what it had counted before was not looked at"
_COUNTERS: Final = {
    "radio_tx_packets": "tx_packets",
    "radio_rx_packets": "rx_packets",
    "tx_retries": "tx_retries",
    "tx_failures": "tx_failures",
    "beacon_losses": "beacon_losses",
}
"""By column."""
_UNSEEN_NS: Final = 2 * 10**9
"""So long before a link is made anew a radio may have counted unseen; the slowest shell looks once a second."""


def _declared(role: Role) -> tuple[Column, ...]:
    """Return the columns of the link of one robot."""
    return columns(
        150,
        (
            f"{role}_signal_median_dbm",
            "dBm",
            (
                f"Median over the repeat of the signal that the {role}'s radio receives from the station or access "
                "point that it exchanges the most packets with. This and the following are empty of a robot without "
                "Wi-Fi or iw, and where its driver does not tell."
            ),
            Figure(f"signal, {role}", Kind.MEDIAN, rank=BACKGROUND),
            _DBM,
        ),
        (f"{role}_signal_min_dbm", "dBm", "The weakest of these samples.", _DBM),
        (f"{role}_signal_last_dbm", "dBm", "The last of them.", _DBM),
        (f"{role}_noise_dbm", "dBm", f"Median over the repeat of the noise in the {role}'s channel.", _DBM),
        (
            f"{role}_busy_share",
            "share",
            f"Share of the time in which the {role} found its channel busy, by whomever, itself included.",
            Figure(f"channel busy, {role}", Kind.MEAN, rank=BACKGROUND + 3),
        ),
        (
            f"{role}_tx_rate_bit_s",
            "bit/s",
            f"Median over the samples of the rate at which the {role}'s radio last sent a frame to it.",
            Figure(f"PHY rate, {role}", Kind.MEDIAN, rank=BACKGROUND + 1),
        ),
        (f"{role}_rx_rate_bit_s", "bit/s", "Likewise of the rate of the last frame from it."),
        (f"{role}_radio_tx_packets", "count", f"Packets that the {role}'s radio sent to it, whoever they are of."),
        (f"{role}_radio_rx_packets", "count", "Packets that came from it."),
        (
            f"{role}_tx_retries",
            "count",
            "Frames that were sent again to it, because no acknowledgement came.",
            Figure(f"Wi-Fi retries, {role}", Kind.MEDIAN, rank=BACKGROUND + 2),
        ),
        (f"{role}_tx_failures", "count", "Packets to it that were given up after the last retry."),
        (f"{role}_beacon_losses", "count", "Times that its beacons stayed away."),
        (
            f"{role}_roams",
            "count",
            f"Times that the {role} went on to another access point; empty of one that is none's station.",
        ),
        (f"{role}_link_samples", "count", f"Samples of the {role}'s link."),
    )


ROLES: Final = (Role.SENDER, Role.RECEIVER)
"""Whose links are columns."""

_COLUMNS: Final = {role: _declared(role) for role in ROLES}
COLUMNS: Final = tuple(column for declared in _COLUMNS.values() for column in declared)


def measure(role: Role, samples: Sequence[LinkSample]) -> Measured:
    """Return the columns of one robot.

    Args:
        role: One of `ROLES`.
        samples: Of its radio, in the order of time.
    """
    if not samples:
        return Measured.nothing(_COLUMNS[role], _NOT_SAMPLED)
    link = line(samples)
    signals = _known(station.signal_dbm for _, station in link)
    counts, lost = _counts(link)
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
    found = Measured.of({f"{role}_{name}": value for name, value in values.items()}, _NOT_TOLD)
    if lost:
        found = found.without({f"{role}_{name}": _LOST for name, count in counts.items() if count is not None})
    # A table that has what no such column can hold would not be read again.
    return found.without(
        {column.name: _NOT_TOLD for column in _COLUMNS[role] if column.problem(cell(found.values.get(column.name)))}
    )


def line(samples: Sequence[LinkSample]) -> list[tuple[int, StationSample]]:
    """Return what the samples say of one link, with their times in ns, in the order of time.

    A station is joined to one at a time, though it may know others.
    """
    joined = next((one.cell for one in samples if one.cell), "")
    if any(one.cell for one in samples):
        chosen = {station.station for one in samples for station in one.stations}
    else:
        chosen = {_busiest(samples), ""}
    found = []
    for sample in samples:
        joined = sample.cell or joined
        of_it = [station for station in sample.stations if station.station in chosen]
        # The kernel's own line has no name, and no more than a signal.
        of_it.sort(key=lambda station: (station.station != "", station.station == joined))
        if of_it:
            found.append((sample.utc_ns, of_it[-1]))
    return found


def _counts(link: Sequence[tuple[int, StationSample]]) -> tuple[Mapping[str, int | None], bool]:
    """Return by column what came to a link's counters, None where not told twice, and whether some of it got lost.

    A link that is made anew, to the same other or to the next, counts from 0.
    """
    told = [(at_ns, one) for at_ns, one in link if any(count is not None for count in _told(one))]
    links: list[list[StationSample]] = [[one for _, one in told[:1]]]
    lost = False
    for (before_ns, before), (at_ns, one) in pairwise(told):
        if _is_anew(before, one):
            links.append([])
            lost = lost or at_ns - before_ns > _UNSEEN_NS
        links[-1].append(one)
    return {column: _came_to(counter, links) for column, counter in _COUNTERS.items()}, lost


def _told(one: StationSample) -> tuple[int | None, ...]:
    return tuple(getattr(one, counter) for counter in _COUNTERS.values())


def _is_anew(before: StationSample, after: StationSample) -> bool:
    pairs = zip(_told(before), _told(after), strict=True)
    went_back = any(one is not None and other is not None and other < one for one, other in pairs)
    return after.station != before.station or went_back


def _came_to(counter: str, links: Sequence[Sequence[StationSample]]) -> int | None:
    known: list[list[int]] = [
        [count for one in link if (count := getattr(one, counter)) is not None] for link in links
    ]
    if sum(map(len, known)) < 2:
        return None
    return sum(counts[-1] for counts in known if counts) - (known[0][0] if known[0] else 0)


def _busiest(samples: Sequence[LinkSample]) -> str:
    """Return the station with which the most packets were exchanged, the first of equals."""
    names = dict.fromkeys(station.station for sample in samples for station in sample.stations)

    def packets(name: str) -> int:
        seen = [station for sample in samples for station in sample.stations if station.station == name]
        return sum(_came(counts) or 0 for counts in ([s.tx_packets for s in seen], [s.rx_packets for s in seen]))

    return max(names, key=packets, default="")


def busy_share(samples: Sequence[LinkSample]) -> float | None:
    """Return the share of the time in which the channel was busy; None where its counters are not told twice."""
    told = [
        (sample.active_ns, sample.busy_ns)
        for sample in samples
        if sample.active_ns is not None and sample.busy_ns is not None
    ]
    active_ns = _came(active for active, _ in told)
    busy_ns = _came(busy for _, busy in told)
    return min(busy_ns / active_ns, 1.0) if active_ns and busy_ns is not None else None


def _came(counts: Iterable[int | None]) -> int | None:
    """Return what came to a counter; one that went back began anew from 0. None where it was not told twice."""
    known = [count for count in counts if count is not None]
    if len(known) < 2:
        return None
    return sum(after - before if after >= before else after for before, after in pairwise(known))


def _roams(samples: Sequence[LinkSample]) -> int | None:
    if not any(one.cell for one in samples):
        return None
    # Whoever asks for its stations is told of its access point as well, and may be so alone.
    names = [{station.station for station in one.stations if station.station} for one in samples]
    cells = [
        one.cell or ("".join(known) if len(known) == 1 else "") for one, known in zip(samples, names, strict=True)
    ]
    return sum(one != other for one, other in pairwise(filter(None, cells)))


def _median(values: Iterable[float | None]) -> float | None:
    known = _known(values)
    return median(known) if known else None


def _known(values: Iterable[float | None]) -> list[float]:
    return [value for value in values if value is not None]
