"""Recovery of a flow after a fault: time from the end of the fault's cause to the first new payload of the flow.

The laptop records start and end of the cause by its clock. The offset of the receiver's clock and its maximum error
are computed from exchanges of time stamps.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from fieldkit.core import laptop_files
from fieldkit.core.columns import Column, Figure, Kind, Measured, columns, fault_column_name
from fieldkit.core.crosschecks import CheckOutcome, CrossCheck
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import FaultKind, Role
from fieldkit.measure.evidence import reading
from fieldkit.measure.robot_clock import Offset
from fieldkit.measure.transfers import stalls
from fieldkit.measure.transfers.deliveries import StreamDeliveries

_SECONDS: Final = r"-?[0-9]{1,12}\.[0-9]{9}"
_FAULT_FILE: Final = re.compile(
    r"began_utc_ns (?P<began>[0-9]{1,19})\nended_utc_ns (?P<ended>[0-9]{1,19}|unknown)\n"
    rf"(?P<ahead>(?:ahead_s [a-z0-9_]{{1,40}} {_SECONDS} {_SECONDS}\n)*)\Z"
)


def fault_times_file(kind: FaultKind) -> str:
    """Return the name of the file with the times of a fault."""
    return laptop_files.fault_times_file(kind)


@dataclass(frozen=True)
class FaultTimes:
    """Times of a fault.

    Attributes:
        began_ns: Start of the cause, nanoseconds since 1970 UTC by the laptop's clock.
        ended_ns: End of the cause; None if unknown.
        clock_offsets: Offset of each robot's clock from the laptop's, by role.
    """

    began_ns: int
    ended_ns: int | None
    clock_offsets: Mapping[Role, Offset]


def fault_times_text(times: FaultTimes) -> str:
    """Return the content of a file with the times of a fault, as `read_fault_times` reads it."""
    end_text = "unknown" if times.ended_ns is None else str(times.ended_ns)
    lines = (
        f"ahead_s {role} {offset.offset_s:.9f} {offset.error_s:.9f}\n" for role, offset in times.clock_offsets.items()
    )
    return f"began_utc_ns {times.began_ns}\nended_utc_ns {end_text}\n{''.join(lines)}"


def read_fault_times(path: Path) -> FaultTimes:
    """Return the times in a file.

    Raises:
        EvidenceError: The file is missing or incomplete.
    """
    try:
        return parse_fault_times(reading.text(path))
    except EvidenceError as error:
        raise EvidenceError(error.what, where=str(path)) from error


def parse_fault_times(content: str) -> FaultTimes:
    """Return the times in the content of a file.

    Raises:
        EvidenceError: The content is incomplete.
    """
    match = _FAULT_FILE.match(content)
    if match is None:
        raise EvidenceError("does not contain the start and end of the fault")
    words = (line.split() for line in match["ahead"].splitlines())
    offsets = {Role(role): Offset(float(offset_s), float(error_s)) for _, role, offset_s, error_s in words}
    return FaultTimes(int(match["began"]), None if match["ended"] == "unknown" else int(match["ended"]), offsets)


FLOWS: Final = ("transfer", "iperf3", "soak", "topic")
"""Kinds of flow that can be active during a fault."""

CROSS_CHECKS: Final = (
    CrossCheck(
        quantity="time from the end of a fault to new payload of a flow, and longest time without payload around it",
        columns=tuple(f"{flow}_*_{part}_*" for flow in FLOWS for part in ("recovery", "outage")),
        source="deliveries in the receiver's capture (topics: in the subscriber's log); `fault-KIND-times.txt`",
        against=(
            "`fault-KIND-times.txt`: exchanges of time stamps with the receiver",
            "both captures: the clock offset",
        ),
        tolerance="the offset of the receiver's clock must be known to 0.1 s, the interval of the fault's ping",
        outcome=CheckOutcome.WITHHELD,
    ),
)

MAX_ERROR_S: Final = 0.1
"""Maximum error of the receiver's clock offset: the interval of the fault's ping."""


@dataclass(frozen=True)
class FaultRecovery:
    """Effect of a fault on one stream.

    Attributes:
        outage_s: Longest time without new payload that overlaps the fault.
        outage_open: True if the outage had not ended when the stream did, so that `outage_s` is a lower bound.
        recovery_s: Time from the end of the cause to the first new payload; None if the end of the cause is unknown,
            or if the stream ended before it without new payload.
        recovery_open: True if no new payload arrived after the cause, so that `recovery_s` is a lower bound.
    """

    outage_s: float
    outage_open: bool
    recovery_s: float | None
    recovery_open: bool


def declare_columns(flow: str, kind: FaultKind) -> tuple[Column, ...]:
    """Return the columns for a kind of flow and a kind of fault."""
    recovery, outage = (f"{flow}_{fault_column_name(kind, part)}" for part in ("recovery", "outage"))
    index = list(FaultKind).index(kind)
    return columns(
        stalls.RANK,
        (
            f"{outage}_s",
            "s",
            (
                f"Longest time without new payload of the {flow} that overlaps the fault {kind}; empty if the "
                f"outage had not ended when the {flow} ended."
            ),
            Figure(f"{flow} outage around {kind}", Kind.MEDIAN, rank=80 + index, at_least=f"{outage}_at_least_s"),
        ),
        (
            f"{recovery}_s",
            "s",
            (
                f"Time from the end of the cause of {kind} to the first new payload of the {flow} at its receiver; "
                "with several streams, the longest of their times. Empty if no new payload arrived, if the end of "
                f"the cause is unknown, and if the error of the receiver's clock can be above {MAX_ERROR_S:g} s."
            ),
            Figure(f"{flow} recovery after {kind}", Kind.MEDIAN, rank=80 + index, at_least=f"{recovery}_at_least_s"),
        ),
        (f"{outage}_at_least_s", "s", f"Lower bound of {outage}_s if the outage had not ended; otherwise empty."),
        (f"{recovery}_at_least_s", "s", f"Lower bound of {recovery}_s if no new payload arrived; otherwise empty."),
    )


def find_recovery(stream: StreamDeliveries, began_ns: int, ended_ns: int | None) -> FaultRecovery:
    """Return the effect of a fault on a stream; times are by the receiver's clock.

    Raises:
        EvidenceError: The stream was not active during the fault, or no packet of it arrived.
    """
    at_ns, cause_end_ns = stream.at_ns, began_ns if ended_ns is None else max(began_ns, ended_ns)
    if not len(at_ns):
        raise EvidenceError("no packet of the flow arrived")
    if stream.begin_ns > cause_end_ns:
        raise EvidenceError("the flow started after the fault")
    last_ns = int(at_ns[-1]) if stream.end_ns is None else max(stream.end_ns, int(at_ns[-1]))
    if last_ns <= began_ns:
        raise EvidenceError("the flow ended before the fault")
    count_before, first_after = (
        int(np.searchsorted(at_ns, time_ns, side="right")) for time_ns in (began_ns, cause_end_ns)
    )
    has_recovered = first_after < len(at_ns)
    if not has_recovered and stream.end_ns is None:
        raise EvidenceError("all payload of the flow arrived before the end of the cause")
    # From the last delivery before the fault to the first one after the end of the cause.
    longest_gap_s = float(np.diff(at_ns[max(count_before - 1, 0) : first_after + 1]).max(initial=0)) / 1e9
    before_first_s = 0.0 if count_before else (int(at_ns[0]) - stream.begin_ns) / 1e9
    after_last_s = 0.0 if has_recovered else (last_ns - int(at_ns[-1])) / 1e9
    recovery_ns = int(at_ns[first_after]) - cause_end_ns if has_recovered else last_ns - cause_end_ns
    is_observed = ended_ns is not None and (has_recovered or recovery_ns > 0)
    return FaultRecovery(
        outage_s=max(longest_gap_s, before_first_s, after_last_s),
        outage_open=not has_recovered,
        recovery_s=recovery_ns / 1e9 if is_observed else None,
        recovery_open=not has_recovered,
    )


def measure(
    flow: str,
    kind: FaultKind,
    deliveries: Callable[[], Sequence[StreamDeliveries]],
    times: FaultTimes | None,
    role: Role,
) -> Measured:
    """Return the columns for a flow and a fault.

    Args:
        flow: Kind of flow.
        kind: Kind of fault.
        deliveries: Function that returns the deliveries of each stream; raises `EvidenceError` if they are unknown.
        times: Times of the fault; None if they were not recorded.
        role: Role of the receiving robot.
    """
    declared_columns = declare_columns(flow, kind)
    try:
        began_ns, ended_ns = _fault_times_at(times, role)
        streams = [find_recovery(stream, began_ns, ended_ns) for stream in deliveries()]
    except EvidenceError as error:
        return Measured.all_missing(declared_columns, error.what)
    if not streams:
        return Measured.all_missing(declared_columns, "no packet of the flow is in a capture")
    recovery, outage = (f"{flow}_{fault_column_name(kind, part)}" for part in ("recovery", "outage"))
    values = {
        _column_name(outage, any(stream.outage_open for stream in streams)): max(
            stream.outage_s for stream in streams
        )
    }
    recoveries_s = [stream.recovery_s for stream in streams if stream.recovery_s is not None]
    if recoveries_s and len(recoveries_s) == len(streams):
        values[_column_name(recovery, any(stream.recovery_open for stream in streams))] = max(recoveries_s)
    reason = "the end of the cause is unknown, or the value is in the other column of the pair *_s and *_at_least_s"
    return Measured(values, {column.name: reason for column in declared_columns if column.name not in values})


def _column_name(column: str, is_open: bool) -> str:
    return f"{column}_at_least_s" if is_open else f"{column}_s"


def _fault_times_at(times: FaultTimes | None, role: Role) -> tuple[int, int | None]:
    """Return start and end of a fault by the clock of a robot; the end is None if unknown.

    Raises:
        EvidenceError: The start is unknown, or the offset of the robot's clock is unknown or not accurate enough.
    """
    if times is None:
        raise EvidenceError("the start of the fault is unknown")
    clock_offset = times.clock_offsets.get(role)
    if clock_offset is None:
        raise EvidenceError(f"the clock offset of the {role} is unknown")
    if clock_offset.error_s > MAX_ERROR_S:
        raise EvidenceError(f"the clock offset of the {role} has an error of up to {clock_offset.error_s:.3f} s")
    offset_ns = round(1e9 * clock_offset.offset_s)
    return times.began_ns + offset_ns, None if times.ended_ns is None else times.ended_ns + offset_ns
