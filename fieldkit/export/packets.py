"""The packets of one capture, each with what became of it, as messages of an MCAP file."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fieldkit.export.mcap import Channel, Message
from fieldkit.export.schemas import time
from fieldkit.measure.captures.arrays import NO_TIME
from fieldkit.measure.captures.ip import written
from fieldkit.measure.captures.packets import NO_PORT, Packets

NOT_KNOWN: Final = -1
_SLICE: Final = 1 << 14
"""How many packets are Python's objects at once."""

_LOST: Final[tuple[dict[str, bool], ...]] = ({"lost": False}, {"lost": True}, {})  # NOT_KNOWN is the last
_COPY: Final[tuple[dict[str, bool], ...]] = ({"copy": False}, {"copy": True}, {})


@dataclass(frozen=True, eq=False)
class MarkedPackets:
    """What one robot captured.

    Attributes:
        packets: They, in the order of the file.
        lost: Per packet 1, 0 or `NOT_KNOWN`: whether it was lost, of those that this robot sent. Shape (n,).
        copy: Likewise whether it is a further copy, of those that it received.
    """

    packets: Packets
    lost: NDArray[np.int8]
    copy: NDArray[np.int8]


def messages(channel: Channel, repeat: str, seen: MarkedPackets) -> Iterator[Message]:
    """Yield a message per packet whose time is known, in the order of time.

    Args:
        channel: Where they go.
        repeat: Name of the repeat's folder.
        seen: The packets.
    """
    time_ns = seen.packets.time_ns
    order = np.argsort(time_ns, kind="stable")
    order = order[time_ns[order] != NO_TIME]
    for start in range(0, len(order), _SLICE):
        chosen = order[start : start + _SLICE]
        packets = seen.packets.where(chosen)
        fates = (seen.lost[chosen].tolist(), seen.copy[chosen].tolist())
        for t_ns, said, lost, copy in zip(packets.time_ns.tolist(), _contents(packets), *fates, strict=True):
            fate = _LOST[lost] | _COPY[copy]
            yield Message(channel, t_ns, {"timestamp": time(t_ns), "repeat": repeat} | said | fate)


def _contents(packets: Packets) -> Iterator[dict[str, object]]:
    """Yield what the headers of each packet say."""
    columns = {
        "protocol": packets.protocol.tolist(),
        "source": [written(*halves) for halves in packets.src.tolist()],
        "destination": [written(*halves) for halves in packets.dst.tolist()],
        "source_port": packets.sport.tolist(),
        "destination_port": packets.dport.tolist(),
        "wire_bytes": packets.wire_bytes.tolist(),
        "payload_bytes": packets.ip_payload_bytes.tolist(),
        "fragment_offset": packets.fragment_offset.tolist(),
    }
    for values in zip(*columns.values(), strict=True):
        yield {name: value for name, value in zip(columns, values, strict=True) if value != NO_PORT}
