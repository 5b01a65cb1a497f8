"""Reasons why the capture of a robot cannot be used."""

from collections.abc import Iterator
from typing import Final

import numpy as np

from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Role
from fieldkit.core.units import format_count
from fieldkit.measure.captures import pcap
from fieldkit.measure.captures.arrays import NO_TIME
from fieldkit.measure.captures.pcap import Capture
from fieldkit.measure.evidence import host, tcpdump_log
from fieldkit.measure.transfers import altered_packets
from fieldkit.steps.view import View

BACK_S: Final = 0.1
"""Permitted step backwards between time stamps: packets received by two processors may be recorded out of order."""

STAMP_NS: Final = 1_000
"""Resolution of time stamps: tcpdump truncates them to microseconds."""


def find(role: Role, file: str, view: View, *, needs_all: bool) -> Iterator[str]:
    """Yield the reasons why a robot's capture cannot be used; with `needs_all`, also if packets were dropped."""
    try:
        log = view.evidence.read(tcpdump_log.read, tcpdump_log.capture_log_file(file))
        capture = view.evidence.read(pcap.read, file)
    except EvidenceError as error:
        yield error.what
        return
    if not log.listening:
        yield "tcpdump was not listening"
    if log.captured is None:
        yield "tcpdump ended without its counters"
        return
    if needs_all and (log.dropped_by_kernel or log.dropped_by_interface):
        dropped_text = format_count(log.dropped_by_kernel or 0, "packet")
        yield f"its kernel dropped {dropped_text}, its interface {log.dropped_by_interface or 0}"
    # The filter may have matched more packets than were written: see `CaptureLog.received_by_filter`.
    if log.received_by_filter is not None and log.received_by_filter < log.captured:
        yield f"{format_count(log.received_by_filter, 'packet')} matched the filter, but tcpdump wrote {log.captured}"
    if capture.damage is not None:
        yield capture.damage
    elif capture.frames != log.captured:
        yield f"the file has {format_count(capture.frames, 'packet')}, but tcpdump counted {log.captured}"
    else:
        if problem := altered_packets.header_problem(capture.packets):
            yield problem
        yield from _time_problems(role, capture, view)


def _time_problems(role: Role, capture: Capture, view: View) -> Iterator[str]:
    """Yield a reason for packet times that run backwards, or that the robot's clock excludes.

    The clock is read before and after the attempt, so no packet can be earlier or later.
    """
    times_ns = capture.packets.time_ns[capture.packets.time_ns != NO_TIME]
    if not len(times_ns):
        return
    back_s = float(-np.diff(times_ns).min(initial=0)) / 1e9
    if back_s > BACK_S:
        yield f"a packet is {back_s:.3f} s earlier than the one before it: the clock was set back"
    before, after = (
        view.evidence.read_or_none(host.read_state, file(role)) for file in (host.before_file, host.after_file)
    )
    if before and before.clock and times_ns.min() < before.clock.first_ns - STAMP_NS:
        early_s = (before.clock.first_ns - int(times_ns.min())) / 1e9
        yield f"has a packet from {early_s:.3f} s before the start of the attempt, by the robot's clock"
    if after and after.clock and times_ns.max() > after.clock.last_ns + STAMP_NS:
        late_s = (int(times_ns.max()) - after.clock.last_ns) / 1e9
        yield f"has a packet from {late_s:.3f} s after the end of the attempt, by the robot's clock"
