"""The packets of one capture, each with its fate, as messages of an MCAP file."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fieldkit.export.mcap import Channel, Message
from fieldkit.export.schemas import time
from fieldkit.measure.captures.arrays import NO_TIME
from fieldkit.measure.captures.ip import address_text
from fieldkit.measure.captures.packets import NO_PORT, Packets

NOT_KNOWN: Final = -1
_SLICE: Final = 1 << 14
"""Number of packets that are converted to Python objects at a time."""

_LOST: Final[tuple[dict[str, bool], ...]] = ({"lost": False}, {"lost": True}, {})  # index -1 (NOT_KNOWN) is the last
_COPY: Final[tuple[dict[str, bool], ...]] = ({"copy": False}, {"copy": True}, {})


@dataclass(frozen=True, eq=False)
class MarkedPackets:
    """The packets captured by one robot, with their fates.

    Attributes:
        packets: The packets in the order of the file.
        lost: 1 if a packet that this robot sent was lost, 0 if not, `NOT_KNOWN` otherwise. Shape (n,).
        copy: 1 if a packet that it received is a duplicate, 0 if not, `NOT_KNOWN` otherwise. Shape (n,).
    """

    packets: Packets
    lost: NDArray[np.int8]
    copy: NDArray[np.int8]


def messages(channel: Channel, repeat: str, captured: MarkedPackets) -> Iterator[Message]:
    """Yield a message per packet whose time is known, in the order of time.

    Args:
        channel: The channel.
        repeat: Name of the repeat's folder.
        captured: The packets.
    """
    time_ns = captured.packets.time_ns
    order = np.argsort(time_ns, kind="stable")
    order = order[time_ns[order] != NO_TIME]
    for start in range(0, len(order), _SLICE):
        chosen = order[start : start + _SLICE]
        packets = captured.packets.where(chosen)
        fates = (captured.lost[chosen].tolist(), captured.copy[chosen].tolist())
        for t_ns, fields, lost, copy in zip(packets.time_ns.tolist(), _contents(packets), *fates, strict=True):
            fate = _LOST[lost] | _COPY[copy]
            yield Message(channel, t_ns, {"timestamp": time(t_ns), "repeat": repeat} | fields | fate)


def _contents(packets: Packets) -> Iterator[dict[str, object]]:
    """Yield the header fields of each packet."""
    columns = {
        "protocol": packets.protocol.tolist(),
        "source": [address_text(*halves) for halves in packets.src.tolist()],
        "destination": [address_text(*halves) for halves in packets.dst.tolist()],
        "source_port": packets.sport.tolist(),
        "destination_port": packets.dport.tolist(),
        "wire_bytes": packets.wire_bytes.tolist(),
        "payload_bytes": packets.ip_payload_bytes.tolist(),
        "fragment_offset": packets.fragment_offset.tolist(),
    }
    for values in zip(*columns.values(), strict=True):
        yield {name: value for name, value in zip(columns, values, strict=True) if value != NO_PORT}
