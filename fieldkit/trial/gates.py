"""Evidence gates: the reasons for which a repeat's evidence is not whole, so that the repeat is void."""

from collections.abc import Iterator
from pathlib import Path
from typing import Final

from fieldkit.errors import EvidenceError
from fieldkit.measure import bag, capture, evidence, pcap
from fieldkit.model import Role
from fieldkit.procedures import Procedure, steps_of
from fieldkit.steps.capture import Capture
from fieldkit.steps.ping import Ping
from fieldkit.steps.record import Record
from fieldkit.steps.transfer import Transfer
from fieldkit.trial.plan import Plan

# A recorder needs up to a second to subscribe, more on a small computer under load; beyond that, half the asked
# time means that something broke.
SUBSCRIBE_S: Final = 1.0
MIN_RECORDED_SHARE: Final = 0.5

_CAPTURES: Final = {
    Role.SENDER: (evidence.SENDER_CAPTURE, evidence.SENDER_CAPTURE_LOG),
    Role.RECEIVER: (evidence.RECEIVER_CAPTURE, evidence.RECEIVER_CAPTURE_LOG),
}


def problems(plan: Plan, folder: Path) -> tuple[str, ...]:
    """Return one sentence per reason for which the evidence in `folder` is not whole."""
    procedure = plan.procedure
    found: list[str] = []
    for record in steps_of(procedure, Record):
        found += _bag_problems(record, folder / record.bag(plan.robots()[record.robot]))
    for step in steps_of(procedure, Capture):
        for role in step.robots:
            found += _capture_problems(role, folder)
    found += [f"{name} is missing" for name in _other_files(procedure) if not (folder / name).is_file()]
    return tuple(found)


def _other_files(procedure: Procedure) -> Iterator[str]:
    yield from (step.into for step in steps_of(procedure, Transfer))
    yield from (evidence.PING for _ in steps_of(procedure, Ping))


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
        log = capture.read(folder / log_name)
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
