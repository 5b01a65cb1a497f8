"""Converts the packets of a run to arrays: one per column, named as in the recorded Parquet file."""

from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sim_backends.cosim.programs.senders import REPLY
from sim_backends.cosim.run_record import Fate, Run

NEVER: Final = -1
"""Value of a time that does not exist, for example the arrival time of a lost packet."""

_INTEGERS: Final[dict[str, Callable[[Fate], int | None]]] = {
    "number": lambda fate: fate.packet.identity[1],
    "size_bytes": lambda fate: fate.packet.size_bytes,
    "sent_ns": lambda fate: fate.packet.sent_ns,
    "enters_ns": lambda fate: fate.packet.enters_ns,
    "arrived_ns": lambda fate: fate.arrived_ns,
    "counted_ns": lambda fate: fate.counted_ns,
    "late_ns": lambda fate: fate.late_ns,
}
"""Functions that return the integers of a packet, by column."""
_TEXTS: Final[dict[str, Callable[[Fate], str]]] = {
    "flow": lambda fate: fate.packet.identity[0],
    "source": lambda fate: fate.packet.source,
    "destination": lambda fate: fate.packet.destination,
    "protocol": lambda fate: fate.packet.protocol,
    "reason": lambda fate: fate.reason,
}
"""Functions that return the texts of a packet, by column."""


def columns(run: Run) -> dict[str, NDArray[Any]]:
    """Return one array per column, with one value per packet in the order in which the packets entered the network.

    `flow`, `source`, `destination`, `protocol` and `reason` are texts; `reason` is the reason why the packet never
    arrived, and is empty if it arrived or is under way. `number`, `size_bytes` and the times `sent_ns`, `enters_ns`,
    `arrived_ns`, `counted_ns` and `late_ns`, in nanoseconds of simulated time, are 64-bit integers; a missing time is
    `NEVER`. `arrived_ns` is the time at which the network delivers the packet. `counted_ns` is the earliest time at
    which the receiver can read the packet; it is later than `arrived_ns` if the policy defers arrivals to the end of
    a window. If the receiver has already been simulated beyond `counted_ns` when it gets the packet, `late_ns` is the
    difference; otherwise it is 0.
    """
    fates = list(run.fates.values())
    texts = {name: np.array([value_of(fate) for fate in fates], dtype=np.str_) for name, value_of in _TEXTS.items()}
    integers = {
        name: np.array([NEVER if (value := value_of(fate)) is None else value for fate in fates], dtype=np.int64)
        for name, value_of in _INTEGERS.items()
    }
    return texts | integers


def round_trips_s(run: Run, flow: str) -> NDArray[np.float64]:
    """Return the round-trip time of each request of a ping in the order of requests; nan for a missing reply.

    Args:
        run: The run.
        flow: Name of the flow of requests; their replies are the flow `FLOW/reply`.
    """
    requests = {number: fate.packet.sent_ns for (name, number), fate in run.fates.items() if name == flow}
    trips_s = np.full(len(requests), np.nan)
    for row, (number, sent_ns) in enumerate(sorted(requests.items())):
        reply = run.fates.get((flow + REPLY, number))
        if reply is not None and reply.counted_ns is not None:
            trips_s[row] = (reply.counted_ns - sent_ns) / 1e9
    return trips_s
