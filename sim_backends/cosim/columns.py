"""What became of the packets of a run, as arrays: a column each, named as in the recorded Parquet file."""

from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sim_backends.cosim.programs.pings import REPLY
from sim_backends.cosim.run import Fate, Run

NEVER: Final = -1
"""Stands for a time that there is not."""

_INTEGERS: Final[dict[str, Callable[[Fate], int | None]]] = {
    "number": lambda fate: fate.packet.identity[1],
    "size_bytes": lambda fate: fate.packet.size_bytes,
    "sent_ns": lambda fate: fate.packet.sent_ns,
    "enters_ns": lambda fate: fate.packet.enters_ns,
    "arrived_ns": lambda fate: fate.arrived_ns,
    "counted_ns": lambda fate: fate.counted_ns,
    "late_ns": lambda fate: fate.late_ns,
}
_TEXTS: Final[dict[str, Callable[[Fate], str]]] = {
    "flow": lambda fate: fate.packet.identity[0],
    "source": lambda fate: fate.packet.source,
    "destination": lambda fate: fate.packet.destination,
    "protocol": lambda fate: fate.packet.protocol,
    "reason": lambda fate: fate.reason,
}


def columns(run: Run) -> dict[str, NDArray[Any]]:
    """Return one array per column, one row per packet in the order in which the network got them.

    `flow`, `source`, `destination`, `protocol` and `reason` (why it never arrived; empty if it did, or is under way)
    are texts. `number`, `size_bytes` and, in nanoseconds of simulated time, `sent_ns`, `enters_ns`, `arrived_ns`,
    `counted_ns` and `late_ns`, are 64-bit integers, `NEVER` where there is none.
    """
    fates = list(run.fates.values())
    texts = {name: np.array([text(fate) for fate in fates], dtype=np.str_) for name, text in _TEXTS.items()}
    numbers = {
        name: np.array([NEVER if (value := number(fate)) is None else value for fate in fates], dtype=np.int64)
        for name, number in _INTEGERS.items()
    }
    return texts | numbers


def round_trips_s(run: Run, flow: str) -> NDArray[np.float64]:
    """Return the round-trip time of each request of a ping in order, nan for those without an answer.

    Args:
        run: The run.
        flow: The flow of the requests; that of their answers is `FLOW/reply`.
    """
    requests = {number: fate.packet.sent_ns for (name, number), fate in run.fates.items() if name == flow}
    trips_s = np.full(len(requests), np.nan)
    for row, (number, sent_ns) in enumerate(sorted(requests.items())):
        answer = run.fates.get((flow + REPLY, number))
        if answer is not None and answer.counted_ns is not None:
            trips_s[row] = (answer.counted_ns - sent_ns) / 1e9
    return trips_s
