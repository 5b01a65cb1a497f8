"""Columns of the outages that faults cause; every table of trials has them."""

from typing import Final

from fieldkit.core.columns import Column, Figure, Kind, columns, fault_column_name
from fieldkit.core.model import FaultKind

_KINDS_IN_ORDER: Final = (FaultKind.LINK_DOWN, FaultKind.OUT_OF_RANGE, FaultKind.REBOOT, FaultKind.KILL)
"""Kinds of faults in the order of their columns."""


def _recovered_state(kind: FaultKind) -> str:
    """Return the state of a robot or process that has recovered, as used in labels."""
    return "process runs" if kind is FaultKind.KILL else "reachable"


def _observer(kind: FaultKind) -> str:
    """Return the name of the observer of an outage: `process` for a killed process, otherwise `ping`."""
    return "process" if kind is FaultKind.KILL else "ping"


def fault_columns(kind: FaultKind) -> tuple[Column, ...]:
    """Return the columns of a kind of fault."""
    outage_column = fault_column_name(kind, "outage_s")
    target, missing_text = (
        ("process", "without a running process") if kind is FaultKind.KILL else ("robot", "without a reply")
    )
    outage_meaning = f"Longest time {missing_text} around the fault {kind}; empty if the {target} did not recover."
    recovery_meaning = f"Part of {outage_column} after the end of the cause of {kind}; empty if either is unknown."
    recovered_meaning = f"True if the {target} recovered from the fault {kind} within the time limit."
    bound_meaning = (
        f"Lower bound of the recovery time if the {target} did not recover from {kind} and the end of its cause is "
        "known; otherwise empty."
    )
    index, bound = list(FaultKind).index(kind), fault_column_name(kind, "recovery_at_least_s")
    recovered = Figure(f"{_recovered_state(kind)} after {kind}", Kind.FLAG, rank=70 + index)
    recovery = Figure(f"{_observer(kind)} recovery after {kind}", Kind.MEDIAN, rank=80 + index, at_least=bound)
    times = columns(
        90,
        (outage_column, "s", outage_meaning),
        (fault_column_name(kind, "recovery_s"), "s", recovery_meaning, recovery),
        (fault_column_name(kind, "recovered"), "bool", recovered_meaning, recovered),
    )
    return (*times, *columns(110, (bound, "s", bound_meaning)))


COLUMNS: Final = tuple(column for kind in _KINDS_IN_ORDER for column in fault_columns(kind))
