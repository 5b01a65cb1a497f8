"""Recovery of a flow after a fault: from the end of its cause until the flow's first new payload.

The laptop notes begin and end of the cause by its clock. Exchanges of the time show how far the receiver's clock is
ahead of it, and how wrong that can be.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from fieldkit.core.columns import Column, Figure, Kind, Measured, columns, of_fault
from fieldkit.core.crosschecks import CheckOutcome, CrossCheck
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import FaultKind, Role
from fieldkit.measure.transfers import stalls
from fieldkit.measure.transfers.deliveries import Delivery
from fieldkit.measure.transfers.fault_times import FaultTimes

FLOWS: Final = ("transfer", "iperf3", "soak", "topic")
"""Kinds of flow that run across faults."""

CROSS_CHECKS: Final = (
    CrossCheck(
        quantity="time from the end of a fault to new payload of a flow, and the longest time without any around it",
        columns=tuple(f"{flow}_*_{what}_*" for flow in FLOWS for what in ("recovery", "outage")),
        source="receiver's capture, of a topic the subscriber's log: deliveries; `fault-KIND-times.txt`: the fault",
        against=(
            "`fault-KIND-times.txt`: exchanges of the time with the receiver",
            "both captures: the fitting clock",
        ),
        tolerance="the receiver's clock may be known to 0.1 s, the interval of the fault's own ping",
        outcome=CheckOutcome.WITHHELD,
    ),
)

LARGEST_ERROR_S: Final = 0.1
"""What the receiver's clock can be wrong by at most: the interval at which a fault's own ping observes."""


@dataclass(frozen=True)
class FaultRecovery:
    """Effect of a fault on one stream.

    Attributes:
        outage_s: Longest time without new payload, of those that overlap the fault.
        outage_open: Whether that had not ended when the stream did, so that it is a lower bound.
        recovery_s: From the end of the cause to the first new payload; None if it was not observed.
        recovery_open: Whether there was none, so that it is a lower bound.
    """

    outage_s: float
    outage_open: bool
    recovery_s: float | None
    recovery_open: bool


def declared(flow: str, kind: FaultKind) -> tuple[Column, ...]:
    """Return the columns of a kind of flow and a kind of fault."""
    recovery, outage = (f"{flow}_{of_fault(kind, what)}" for what in ("recovery", "outage"))
    place = list(FaultKind).index(kind)
    return columns(
        stalls.RANK,
        (
            f"{outage}_s",
            "s",
            f"Longest time without new payload of the {flow} that overlaps the fault {kind}; empty without an end.",
            Figure(f"{flow} outage around {kind}", Kind.MEDIAN, rank=80 + place, at_least=f"{outage}_at_least_s"),
        ),
        (
            f"{recovery}_s",
            "s",
            (
                f"From the end of the cause of {kind} to the first new payload of the {flow} at its receiver; of "
                "several streams the longest. Empty when there was none, when the end of the cause is unknown, "
                f"and when the receiver's clock can be wrong by more than {LARGEST_ERROR_S:g} s."
            ),
            Figure(f"{flow} recovery after {kind}", Kind.MEDIAN, rank=80 + place, at_least=f"{recovery}_at_least_s"),
        ),
        (f"{outage}_at_least_s", "s", f"Lower bound of {outage}_s where the outage had not ended, else empty."),
        (f"{recovery}_at_least_s", "s", f"Lower bound of {recovery}_s where no new payload came, else empty."),
    )


def find(delivery: Delivery, began_ns: int, ended_ns: int | None) -> FaultRecovery:
    """Return the effect of a fault on a stream; times are those of the receiver's clock.

    Raises:
        EvidenceError: The stream did not run across the fault, or nothing of it arrived.
    """
    at_ns, over_ns = delivery.at_ns, began_ns if ended_ns is None else max(began_ns, ended_ns)
    if not len(at_ns):
        raise EvidenceError("nothing of it arrived")
    if delivery.begin_ns > over_ns:
        raise EvidenceError("it began after the fault")
    last_ns = int(at_ns[-1]) if delivery.end_ns is None else max(delivery.end_ns, int(at_ns[-1]))
    if last_ns <= began_ns:
        raise EvidenceError("it was over before the fault")
    before, after = (int(np.searchsorted(at_ns, moment, side="right")) for moment in (began_ns, over_ns))
    came = after < len(at_ns)
    if not came and delivery.end_ns is None:
        raise EvidenceError("all of it had arrived before the cause was over")
    within_s = float(np.diff(at_ns[max(before - 1, 0) : after + 1]).max(initial=0)) / 1e9
    first_s = 0.0 if before else (int(at_ns[0]) - delivery.begin_ns) / 1e9
    open_s = 0.0 if came else (last_ns - int(at_ns[-1])) / 1e9
    recovery_ns = int(at_ns[after]) - over_ns if came else last_ns - over_ns
    observed = ended_ns is not None and (came or recovery_ns > 0)
    return FaultRecovery(
        outage_s=max(within_s, first_s, open_s),
        outage_open=not came,
        recovery_s=recovery_ns / 1e9 if observed else None,
        recovery_open=not came,
    )


def measure(
    flow: str, kind: FaultKind, deliveries: Callable[[], Sequence[Delivery]], times: FaultTimes | None, role: Role
) -> Measured:
    """Return the columns of a flow and a fault.

    Args:
        flow: Kind of flow.
        kind: Kind of fault.
        deliveries: Returns those of each of its streams; raises `EvidenceError` where the evidence does not show.
        times: When the fault was; None if that was not noted.
        role: Whose robot receives.
    """
    own = declared(flow, kind)
    try:
        began_ns, ended_ns = _at(times, role)
        streams = [find(delivery, began_ns, ended_ns) for delivery in deliveries()]
    except EvidenceError as error:
        return Measured.nothing(own, error.what)
    if not streams:
        return Measured.nothing(own, "no packet of it is in a capture")
    recovery, outage = (f"{flow}_{of_fault(kind, what)}" for what in ("recovery", "outage"))
    values = {_name(outage, any(one.outage_open for one in streams)): max(one.outage_s for one in streams)}
    recoveries_s = [one.recovery_s for one in streams if one.recovery_s is not None]
    if recoveries_s and len(recoveries_s) == len(streams):
        values[_name(recovery, any(one.recovery_open for one in streams))] = max(recoveries_s)
    reason = "the end of the cause is unknown, or the value is in the other column: it did or did not recover"
    return Measured(values, {column.name: reason for column in own if column.name not in values})


def _name(column: str, is_open: bool) -> str:
    return f"{column}_at_least_s" if is_open else f"{column}_s"


def _at(times: FaultTimes | None, role: Role) -> tuple[int, int | None]:
    """Return begin and end of a fault by the clock of a robot."""
    if times is None:
        raise EvidenceError("when the fault began is not known")
    ahead = times.ahead.get(role)
    if ahead is None:
        raise EvidenceError(f"how far the clock of the {role} is ahead is not known")
    if ahead.error_s > LARGEST_ERROR_S:
        raise EvidenceError(f"the clock of the {role} is known to {ahead.error_s:.3f} s only")
    ahead_ns = round(1e9 * ahead.offset_s)
    return times.began_ns + ahead_ns, None if times.ended_ns is None else times.ended_ns + ahead_ns
