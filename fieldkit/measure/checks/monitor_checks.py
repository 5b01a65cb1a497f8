"""Contradictions between a capture on a monitor interface and the other sources of the same quantities.

The other sources are the counters, signals and rates of `iw station dump`, which a robot samples during an attempt;
the packets in the capture of IP packets; and the frames in the capture of the other robot.
"""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Final

import numpy as np

from fieldkit.core.model import LinkSample, StationSample
from fieldkit.core.units import format_count
from fieldkit.measure.captures.arrays import Ints, Mask
from fieldkit.measure.captures.packets import Packets
from fieldkit.measure.captures.radiotap import NO_SIGNAL, RadioFrames
from fieldkit.measure.checks.monitor_columns import own_addresses

READ_NS: Final = 500_000_000
"""Maximum time from the time of a sample, written before `iw` starts, until `iw` reads the driver's values."""

SIGNAL_DB: Final = 1.0
"""Permitted difference between signals, because a driver may round them differently."""

RATE_BIT_S: Final = 100_000
"""Permitted difference between rates: iw prints a decimal of a Mbit/s, and radiotap has units of 500 kbit/s."""


def link_contradictions(frames: RadioFrames, samples: Sequence[LinkSample]) -> Iterator[str]:
    """Yield each contradiction between the frames of a radio and the samples of its links by `iw`.

    Args:
        frames: All frames in the capture on the monitor interface, in the order of time.
        samples: Samples of the radio, in the order of time.
    """
    if not len(frames):
        return
    start_ns, end_ns = int(frames.time_ns[0]), int(frames.time_ns[-1])
    histories: dict[str, list[tuple[int, StationSample]]] = {}
    for sample in samples:
        if start_ns <= sample.utc_ns and sample.utc_ns + READ_NS <= end_ns:
            for station in sample.stations:
                histories.setdefault(station.station, []).append((sample.utc_ns, station))
    for name, history in histories.items():
        if (address := _address(name)) is not None:
            sent = frames.where(frames.is_sent & (frames.receiver == address))
            received = frames.where(~frames.is_sent & (frames.transmitter == address))
            yield from _counter_contradictions(name, history, sent, received)
            yield from _signal_contradictions(name, history, received)
            yield from _rate_contradictions(name, history, sent, received)


def packet_contradictions(frames: RadioFrames, packets: Packets, address: str) -> Iterator[str]:
    """Yield a reason if the robot received more packets on the radio interface than frames on its monitor interface.

    There is no such check of sent packets, because the kernel may discard a packet after tcpdump has received it.

    Args:
        frames: All frames in the capture on the monitor interface.
        packets: Packets in the capture on the radio interface at the same time.
        address: IP address of the robot.
    """
    received = frames.where(~frames.is_sent & frames.is_data & np.isin(frames.receiver, own_addresses(frames)))
    count = int(packets.are_to(address).sum())
    if count > len(received) and not received.has_many_packets.any():
        yield (
            f"{format_count(count, 'packet')} for the robot arrived at its radio interface, but only "
            f"{format_count(len(received), 'frame')} for it at its monitor interface"
        )


def peer_contradictions(sent: RadioFrames, received: RadioFrames) -> Iterator[str]:
    """Yield each contradiction between the frames that one radio sent, and those that another received from it.

    Received frames before the first and after the last one that is in both captures are ignored, because the
    captures do not start and end at the same time.

    Args:
        sent: All frames in the capture of the robot that sends.
        received: All frames in the capture of the robot that receives.
    """
    addresses = own_addresses(sent)
    sent = sent.where(sent.is_sent & sent.is_data & sent.is_unicast)
    received = received.where(
        ~received.is_sent & received.is_data & received.is_unicast & np.isin(received.transmitter, addresses)
    )
    sent_keys, received_keys = _keys(sent), _keys(received)
    matched = np.flatnonzero(np.isin(received_keys, sent_keys))
    if not len(matched):
        return
    inside = slice(int(matched[0]), int(matched[-1]) + 1)
    unsent = int((~np.isin(received_keys[inside], sent_keys)).sum())
    if unsent:
        yield f"{format_count(unsent, 'frame')} of the other robot are missing on its monitor interface"
    retried_keys = sent_keys[sent.retries != 0]
    has_wrong_flag: Mask = received.is_retry[matched] & ~np.isin(received_keys[matched], retried_keys)
    if has_wrong_flag.any():
        count = format_count(int(has_wrong_flag.sum()), "frame")
        yield f"{count} of the other robot have the retry flag, but were sent without a retransmission"


def _keys(frames: RadioFrames) -> Ints:
    """Return a key of each frame: sequence control and receiver, which a retransmission does not change."""
    return frames.sequence << 48 | frames.receiver


def _address(name: str) -> int | None:
    """Return the number of a MAC address, or None if the name is not an address."""
    digits = name.replace(":", "")
    return int(digits, 16) if len(digits) == 12 and set(digits) <= set("0123456789abcdef") else None


def _counter_contradictions(
    name: str, history: Sequence[tuple[int, StationSample]], sent: RadioFrames, received: RadioFrames
) -> Iterator[str]:
    """Yield a reason for each counter of `iw` that increased by less or more than the frames permit."""
    (start_ns, first), (end_ns, last) = history[0], history[-1]
    retries, ones = np.maximum(sent.retries, 0), np.ones(len(sent), dtype=np.int64)
    for label, attribute, times_ns, weights, weights_at_least in (
        ("packets sent", "tx_packets", sent.time_ns, ones, ones),
        ("retransmissions", "tx_retries", sent.time_ns, retries, retries),
        ("failed packets", "tx_failures", sent.time_ns, sent.is_failed, sent.is_failed),
        # Frames that are not data need not count as packets. In a mesh, Linux 6.1 counts each of them twice. Retried
        # frames may be repetitions, which do not count.
        (
            "packets received",
            "rx_packets",
            received.time_ns,
            np.where(received.is_data, 1, 2),
            received.is_data & received.is_unicast & ~received.is_retry,
        ),
    ):
        counts = [getattr(station, attribute) for _, station in history]
        if len(counts) < 2 or None in counts or any(after < before for before, after in pairwise(counts)):
            continue
        increment = getattr(last, attribute) - getattr(first, attribute)
        at_least = int(weights_at_least[(times_ns > start_ns + READ_NS) & (times_ns < end_ns)].sum())
        at_most = int(weights[(times_ns > start_ns) & (times_ns <= end_ns + READ_NS)].sum())
        if not at_least <= increment <= at_most:
            yield (
                f"iw counted {increment} {label} with {name}, but its monitor interface has {at_least} to {at_most}"
            )


def _signal_contradictions(
    name: str, history: Sequence[tuple[int, StationSample]], received: RadioFrames
) -> Iterator[str]:
    """Yield a reason if a signal in the samples is not that of a frame around the time of the sample."""
    received = received.where(received.signal_dbm != NO_SIGNAL)
    for at_ns, station in history:
        signals = received.signal_dbm[_around(received.time_ns, at_ns)]
        if station.signal_dbm is None or not len(signals):
            continue
        if not (np.abs(signals - station.signal_dbm) <= SIGNAL_DB).any():
            yield (
                f"iw printed the signal {station.signal_dbm:g} dBm of {name}, but frames at that time have "
                f"{signals.min()} to {signals.max()} dBm"
            )
            return


def _rate_contradictions(
    name: str, history: Sequence[tuple[int, StationSample]], sent: RadioFrames, received: RadioFrames
) -> Iterator[str]:
    """Yield a reason if a rate in the samples is not that of a frame around the time of the sample.

    A sent frame has the rate of its first attempt, and iw may print that of its last one. So a time with
    retransmissions is not checked. iw prints only rates of data.
    """
    for direction, all_frames in (("sent", sent), ("received", received)):
        frames = all_frames.where(all_frames.is_data & all_frames.is_unicast)
        for at_ns, station in history:
            rate_bit_s = station.tx_rate_bit_s if direction == "sent" else station.rx_rate_bit_s
            near = frames.where(_around(frames.time_ns, at_ns))
            if rate_bit_s is None or not len(near) or (near.rate_bit_s == 0).any() or (near.retries > 0).any():
                continue
            if not (np.abs(near.rate_bit_s - rate_bit_s) <= RATE_BIT_S).any():
                rates = " to ".join(f"{rate / 1e6:g}" for rate in (near.rate_bit_s.min(), near.rate_bit_s.max()))
                yield (
                    f"iw printed {rate_bit_s / 1e6:g} Mbit/s for frames {direction} with {name}, but those at that "
                    f"time have {rates} Mbit/s"
                )
                return


def _around(times_ns: Ints, at_ns: int) -> slice:
    """Return the frames during which `iw` may have read the driver: the last one before a sample, and later ones."""
    first = int(np.searchsorted(times_ns, at_ns, side="right")) - 1
    stop = int(np.searchsorted(times_ns, at_ns + READ_NS, side="right"))
    return slice(first, stop) if first >= 0 else slice(0, 0)
