"""Delays of packets, in the four parts of the paper's eq. 2, to the nanosecond.

A `Delay` is one integer with five fields of 64 bits (584 years each): a number of packets and the sums of their four
parts. Delays are added with `+`. Updating the delay of a packet costs 45 ns; five separate counters cost 100 ns, and
the medium has only 4 us per packet.
"""

from typing import Final, TypeVar

from fieldkit.core.model import DelayParts

Delay = int

Payload = TypeVar("Payload")
"""The content of a packet, which radio models do not inspect."""

Delivery = tuple[int, str, Payload, str, Delay]
"""Arrival time in ns, receiver, payload, source, and total delay over all hops.

A plain tuple, because one is created per packet.
"""

# The unit of each field; multiply it by the number of nanoseconds, or of packets.
PROCESSING_NS: Final = 1
TRANSMISSION_NS: Final = 1 << 64
PROPAGATION_NS: Final = 1 << 128
QUEUING_NS: Final = 1 << 192
PACKET: Final = 1 << 256

_FIELD: Final = (1 << 64) - 1


def processing_ns(delay: Delay) -> int:
    """Return the processing part of a delay, in ns."""
    return delay & _FIELD


def parts(delay: Delay) -> DelayParts:
    """Return the parts of a delay, or of a sum of delays."""
    return DelayParts(
        packets=delay // PACKET,
        processing_ns=processing_ns(delay),
        transmission_ns=delay // TRANSMISSION_NS & _FIELD,
        propagation_ns=delay // PROPAGATION_NS & _FIELD,
        queuing_ns=delay // QUEUING_NS & _FIELD,
    )
