"""The Wi-Fi links of sender and receiver over an attempt: columns out of samples.

A radio may know several others. An access point's link is the one with the most packets of the attempt; a station's
goes on from one access point to the next.
"""

from collections.abc import Iterable, Sequence
from itertools import pairwise
from statistics import median
from typing import Final

from fieldkit.core.columns import BACKGROUND, Column, Figure, Kind, Measured, Value, cell, columns
from fieldkit.core.model import LinkSample, Role, StationSample

_DBM: Final = (-300.0, 100.0)
_NOT_SAMPLED: Final = "its radio was not sampled: it has no Wi-Fi, or no iw"
_NOT_TOLD: Final = "its radio does not tell"


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
            Figure(f"signal at the {role}", Kind.MEDIAN, rank=BACKGROUND),
            _DBM,
        ),
        (f"{role}_signal_min_dbm", "dBm", "The weakest of these samples.", _DBM),
        (f"{role}_signal_last_dbm", "dBm", "The last of them.", _DBM),
        (f"{role}_noise_dbm", "dBm", f"Median over the repeat of the noise in the {role}'s channel.", _DBM),
        (
            f"{role}_busy_share",
            "share",
            f"Share of the time in which the {role} found its channel busy, by whomever, itself included.",
            Figure(f"channel busy at the {role}", Kind.MEAN, rank=BACKGROUND + 3),
        ),
        (
            f"{role}_tx_rate_bit_s",
            "bit/s",
            f"Median over the samples of the rate at which the {role}'s radio last sent a frame to it.",
            Figure(f"rate that the {role} sends at", Kind.MEDIAN, rank=BACKGROUND + 1),
        ),
        (f"{role}_rx_rate_bit_s", "bit/s", "Likewise of the rate of the last frame from it."),
        (f"{role}_radio_tx_packets", "count", f"Packets that the {role}'s radio sent to it, whoever they are of."),
        (f"{role}_radio_rx_packets", "count", "Packets that came from it."),
        (
            f"{role}_tx_retries",
            "count",
            "Frames that were sent again to it, because no acknowledgement came.",
            Figure(f"frames the {role} sent again", Kind.MEDIAN, rank=BACKGROUND + 2),
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
    values: dict[str, Value | None] = {
        "signal_median_dbm": median(signals) if signals else None,
        "signal_min_dbm": min(signals, default=None),
        "signal_last_dbm": signals[-1] if signals else None,
        "noise_dbm": _median(sample.noise_dbm for sample in samples),
        "busy_share": busy_share(samples),
        "tx_rate_bit_s": _median(station.tx_rate_bit_s for _, station in link),
        "rx_rate_bit_s": _median(station.rx_rate_bit_s for _, station in link),
        "radio_tx_packets": _came(station.tx_packets for _, station in link),
        "radio_rx_packets": _came(station.rx_packets for _, station in link),
        "tx_retries": _came(station.tx_retries for _, station in link),
        "tx_failures": _came(station.tx_failures for _, station in link),
        "beacon_losses": _came(station.beacon_losses for _, station in link),
        "roams": _roams(samples),
        "link_samples": len(samples),
    }
    found = Measured.of({f"{role}_{name}": value for name, value in values.items()}, _NOT_TOLD)
    # A table that has what no such column can hold would not be read again.
    return found.without(
        {column.name: _NOT_TOLD for column in _COLUMNS[role] if column.problem(cell(found.values.get(column.name)))}
    )


def line(samples: Sequence[LinkSample]) -> list[tuple[int, StationSample]]:
    """Return what the samples say of one link, with their times in ns, in the order of time.

    Counters of a station that was joined anew go on from those before.
    """
    if any(one.cell for one in samples):
        chosen = {station.station for one in samples for station in one.stations}
    else:
        chosen = {_busiest(samples), ""}
    found = []
    for sample in samples:
        of_it = [station for station in sample.stations if station.station in chosen]
        # The kernel's own line has no name, and no more than a signal.
        of_it.sort(key=lambda station: station.station != "")
        if of_it:
            found.append((sample.utc_ns, of_it[-1]))
    return found


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
    cells = [sample.cell for sample in samples if sample.cell]
    return sum(before != after for before, after in pairwise(cells)) if cells else None


def _median(values: Iterable[float | None]) -> float | None:
    known = _known(values)
    return median(known) if known else None


def _known(values: Iterable[float | None]) -> list[float]:
    return [value for value in values if value is not None]
