"""Delays of packets, in the four parts of the paper's eq. 2, to the nanosecond.

A `Delay` is one integer that holds a number of packets and their parts, summed, in fields of 64 bits (584 years). So
delays add up by `+`, and accounting for a packet costs 45 ns; five counters cost 100 ns, of the 4 us that the medium
has for it.
"""

from typing import Final, TypeVar

from fieldkit.core.model import DelayParts

Delay = int

Payload = TypeVar("Payload")
"""Whatever a packet carries; models do not look at it."""

Delivery = tuple[int, str, Payload, str, Delay]
"""When a packet arrived, in ns, at whom, what it carries, from whom, and what it was delayed by on all its hops.

A bare tuple: one is made per packet.
"""

# One of each, to be multiplied by how many.
PROCESSING_NS: Final = 1
TRANSMISSION_NS: Final = 1 << 64
PROPAGATION_NS: Final = 1 << 128
QUEUING_NS: Final = 1 << 192
PACKET: Final = 1 << 256

_FIELD: Final = (1 << 64) - 1


def processing_ns(delay: Delay) -> int:
    """Return that part of a delay."""
    return delay & _FIELD


def parts(delay: Delay) -> DelayParts:
    """Return what a delay, or a sum of delays, consists of."""
    return DelayParts(
        packets=delay // PACKET,
        processing_ns=processing_ns(delay),
        transmission_ns=delay // TRANSMISSION_NS & _FIELD,
        propagation_ns=delay // PROPAGATION_NS & _FIELD,
        queuing_ns=delay // QUEUING_NS & _FIELD,
    )
