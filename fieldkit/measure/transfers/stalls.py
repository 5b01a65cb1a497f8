"""Stalls of a flow: times for which new payload was overdue at its receiver.

Payload is overdue from the delivery before it on; of a flow at a rate, from one sending interval after that. So time
in which the sender had nothing to send is no part of a stall. A stall is counted from `Delivery.least_s` on. Time
before the first payload, in which a connection is set up, and after the last one, while more was due, count only if
they are that long. A stall after the last payload had not ended when the flow did: it is right-censored.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from fieldkit.core.columns import Column, Figure, Kind, Measured, columns
from fieldkit.core.crosschecks import CheckOutcome, CrossCheck
from fieldkit.core.errors import EvidenceError
from fieldkit.measure.transfers.deliveries import Delivery

RANK: Final = 120
"""Of the columns in trial.csv: behind those of earlier versions."""


@dataclass(frozen=True)
class Stalls:
    """Stalls of one stream, or of several.

    Attributes:
        longest_s: Longest time for which payload was overdue, whether that is a stall or not.
        count: How many stalls there were.
        is_open: Whether one had not ended, so that `longest_s` is a lower bound.
    """

    longest_s: float
    count: int
    is_open: bool


def declared(flow: str, label: str, rank: int) -> tuple[Column, ...]:
    """Return the columns of a kind of flow.

    Args:
        flow: What their names begin with: `transfer`.
        label: Flow in their labels: `the transfer`.
        rank: Of their figures.
    """
    bound = f"{flow}_stall_at_least_s"
    return columns(
        RANK,
        (
            f"{flow}_stall_s",
            "s",
            (
                "Longest time for which new payload was overdue at the receiver; of several streams the longest. "
                "Empty when a stall had not ended, and without whole captures of both ends."
            ),
            Figure(f"longest stall of {label}", Kind.MEDIAN, rank=rank, at_least=bound),
        ),
        (
            f"{flow}_stalls",
            "count",
            (
                "Times for which it was overdue for more than 0.2 s, 2 round trips of TCP's handshake and 3 sending "
                "intervals, in all streams together."
            ),
            Figure(f"stalls of {label}", Kind.MEAN, rank=rank),
        ),
        (bound, "s", f"Lower bound of {flow}_stall_s where a stall had not ended, else empty."),
    )


def cross_checks(flow: str) -> tuple[CrossCheck, ...]:
    """Return the sources of the columns of a kind of flow, and the checks between them."""
    return (
        CrossCheck(
            quantity="time without new payload at the receiver",
            columns=(f"{flow}_stall_s", f"{flow}_stalls", f"{flow}_stall_at_least_s"),
            source="receiver's capture: times of the frames that deliver new payload",
            against=(
                "sender's capture: the same packets, and the clock that fits both",
                "`ROLE-before.txt` and `ROLE-after.txt`: a clock that was set",
            ),
            tolerance="packets may be 0.1 s out of order, as two processors hand them over",
            outcome=CheckOutcome.WITHHELD,
        ),
    )


def find(delivery: Delivery) -> Stalls:
    """Return the stalls of a stream.

    Raises:
        EvidenceError: It is a single packet, which shows no time.
    """
    at_ns, least_s = delivery.at_ns, delivery.least_s
    if not len(at_ns):
        return _nothing(delivery)
    overdue_s = np.maximum(np.diff(at_ns) / 1e9 - delivery.interval_s, 0.0)
    before_s = (int(at_ns[0]) - delivery.begin_ns) / 1e9
    after_s = 0.0
    if delivery.end_ns is not None:
        after_s = (delivery.end_ns - int(at_ns[-1])) / 1e9 - delivery.interval_s
    ends_s = [seconds for seconds in (before_s, after_s) if seconds > least_s]
    if not len(overdue_s) and not ends_s:
        raise EvidenceError("a single packet of it arrived, which shows no time")
    return Stalls(
        longest_s=max(float(overdue_s.max(initial=0.0)), *ends_s, 0.0),
        count=int((overdue_s > least_s).sum()) + len(ends_s),
        is_open=after_s > least_s,
    )


def _nothing(delivery: Delivery) -> Stalls:
    """Return the stall of a stream of which nothing arrived."""
    lasted_s = ((delivery.end_ns or delivery.begin_ns) - delivery.begin_ns) / 1e9
    if lasted_s <= 0:
        raise EvidenceError("nothing of it arrived, and its sender sent a single packet")
    return Stalls(lasted_s, 1, is_open=True)


def measure(flow: str, deliveries: Callable[[], Sequence[Delivery]]) -> Measured:
    """Return the columns of a flow.

    Args:
        flow: As for `declared`.
        deliveries: Returns those of each of its streams; raises `EvidenceError` where the evidence does not show.
    """
    own = declared(flow, flow, 0)
    try:
        streams = [find(delivery) for delivery in deliveries()]
    except EvidenceError as error:
        return Measured.nothing(own, error.what)
    if not streams:
        return Measured.nothing(own, "no packet of it is in a capture")
    longest_s, count = max(stream.longest_s for stream in streams), sum(stream.count for stream in streams)
    if any(stream.is_open for stream in streams):
        values = {f"{flow}_stall_at_least_s": longest_s, f"{flow}_stalls": count}
        return Measured(values, {f"{flow}_stall_s": "a stall had not ended when the flow did"})
    values = {f"{flow}_stall_s": longest_s, f"{flow}_stalls": count}
    return Measured(values, {f"{flow}_stall_at_least_s": "every stall ended"})
