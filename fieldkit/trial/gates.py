"""Evidence gates: the reasons for which a repeat's evidence is not whole, so that the repeat is void."""

from collections.abc import Iterator
from pathlib import Path
from typing import Final

from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import FaultKind, Role
from fieldkit.measure.captures import pcap
from fieldkit.measure.evidence import bag, lateness, ping, reading, recovery, tcpdump_log, track
from fieldkit.steps.capture import Capture
from fieldkit.steps.fault import Fault
from fieldkit.steps.ping import Ping
from fieldkit.steps.record import Record
from fieldkit.steps.transfer import Transfer
from fieldkit.trial.plan import Plan
from fieldkit.trial.procedure import steps_of

# A recorder needs up to a second to subscribe, more on a small computer under load; beyond that, half the asked
# time means that something broke.
SUBSCRIBE_S: Final = 1.0
MIN_RECORDED_SHARE: Final = 0.5

_CAPTURES: Final = {
    Role.SENDER: (reading.SENDER_CAPTURE, reading.SENDER_CAPTURE_LOG),
    Role.RECEIVER: (reading.RECEIVER_CAPTURE, reading.RECEIVER_CAPTURE_LOG),
}


def problems(plan: Plan, folder: Path) -> tuple[str, ...]:
    """Return one sentence per reason for which the evidence in `folder` is not whole."""
    procedure = plan.procedure
    found: list[str] = []
    for record in steps_of(procedure, Record, undisturbed=True):
        found += _bag_problems(record, folder / record.bag(plan.robots()[record.robot]))
    for capture_step in steps_of(procedure, Capture, undisturbed=True):
        for role in capture_step.robots:
            found += _capture_problems(role, folder)
    transfers = steps_of(procedure, Transfer, undisturbed=True)
    found += [f"{one.into} is missing" for one in transfers if not (folder / one.into).is_file()]
    for ping_step in steps_of(procedure, Ping, undisturbed=True):
        found += _ping_problems(ping_step, folder / reading.PING)
    for fault in steps_of(procedure, Fault, undisturbed=True):
        found += _fault_problems(fault.kind, folder)
    found += _lateness_problems(folder / reading.LATENESS)
    found += _track_problems(folder / reading.TRACK)
    return tuple(found)


def _fault_problems(kind: FaultKind, folder: Path) -> Iterator[str]:
    try:
        recovery.read(folder, kind)
    except EvidenceError as error:
        yield f"{Path(error.where).name}: {error.what}"


def _lateness_problems(path: Path) -> Iterator[str]:
    if not path.exists():
        return  # the air is real
    try:
        found = lateness.read(path)
    except EvidenceError as error:
        yield f"{path.name}: {error.what}"
        return
    late_ns = lateness.quantile_ns(found, 1.0)
    if late_ns is not None and late_ns > found.bound_ns:
        late = f"{lateness.too_late(found)} packets were handed over late, by up to {late_ns / 1e6:.3g} ms"
        yield f"{path.name}: {late}; the bound is {found.bound_ns / 1e6:g} ms"


def _track_problems(path: Path) -> Iterator[str]:
    if not path.exists():
        return  # nobody knows where the robots were
    try:
        track.read(path)
    except EvidenceError as error:
        yield f"{path.name}: {error.what}"


def _ping_problems(step: Ping, path: Path) -> Iterator[str]:
    try:
        found = ping.read(path)
    except EvidenceError:
        yield f"{path.name} is missing"
        return
    if found.transmitted is None:
        yield f"{path.name}: ping was cut short, its summary is missing"
    elif found.transmitted < step.count:
        yield f"{path.name}: ping sent {found.transmitted} of {step.count} requests"


def _bag_problems(record: Record, path: Path) -> Iterator[str]:
    try:
        content = bag.read(path)
    except EvidenceError as error:
        yield f"{path.name}: {error.what}"
        return
    silent = [topic for topic in record.topics if not content.messages_by_topic.get(topic)]
    if silent:
        yield f"{path.name}: no message of {', '.join(silent)}"
    if content.duration_s + SUBSCRIBE_S < MIN_RECORDED_SHARE * record.duration:
        yield f"{path.name}: spans {content.duration_s:.1f} s of the {record.duration:g} s asked for"


def _capture_problems(role: Role, folder: Path) -> Iterator[str]:
    name, log_name = _CAPTURES[role]
    try:
        log = tcpdump_log.read(folder / log_name)
        read = pcap.read(folder / name)
    except EvidenceError as error:
        yield f"{role} capture: {error.what}"
        return
    if not log.listening:
        yield f"{role} capture: tcpdump was not listening"
    if log.captured is None:
        yield f"{role} capture: tcpdump ended without its counters"
        return
    if log.dropped_by_kernel or log.dropped_by_interface:
        yield f"{role} capture: dropped {log.dropped_by_kernel} packets, its interface {log.dropped_by_interface}"
    if log.received_by_filter != log.captured:
        yield f"{role} capture: {log.received_by_filter} packets matched, {log.captured} were written"
    if read.damage is not None:
        yield f"{role} capture: {read.damage}"
    elif read.frames != log.captured:
        yield f"{role} capture: the file holds {read.frames} packets, tcpdump counted {log.captured}"
