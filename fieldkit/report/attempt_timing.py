"""Times and flows in one attempt.

The times are of packets, pings, jobs, faults and moves. Times of robots are converted to the clock of the first
transfer's sender, if the offset is known; times of moves are not converted. Flows are drawn as panels over time: the
payload rate that iperf3 measured, and the panels of steps that implement `DrawsPanels`.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Final, Protocol, runtime_checkable

import numpy as np

from fieldkit.analysis.repeats import Repeats
from fieldkit.core import model
from fieldkit.core.columns import plain_name, step_prefixed
from fieldkit.core.model import FaultKind, Role, StationSample
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.evidence import host, iperf3, link, outage, ping, recordings, track
from fieldkit.measure.evidence.recordings import RecordingContents
from fieldkit.measure.positions import position_columns
from fieldkit.measure.robot_clock import Offset
from fieldkit.measure.robot_state import exchanges
from fieldkit.measure.transfers import fates
from fieldkit.measure.transfers.fates import Fates
from fieldkit.measure.transfers.transfer_spec import Transfer
from fieldkit.report.charts import Panel, Series
from fieldkit.report.theme import Colour, Style
from fieldkit.telemetry import telemetry_samples
from fieldkit.trial import planned_evidence
from fieldkit.trial.plan import Plan
from fieldkit.trial.procedure import PlacedStep

_SHOWN_BY_EVIDENCE: Final = frozenset(("record", "send", "listen", "ping"))
"""Jobs whose evidence contains more accurate times than the start and end of the job."""
_RECOVERY_JOB_SUFFIX: Final = "-heals"
"""Suffix of the name of the job that waits until the robot has recovered from a fault."""
_LONGEST_PAUSE_NS: Final = 1_000_000_000
"""Longest time between two samples of a moving robot. A change of position over a longer time is not a motion."""


@dataclass(frozen=True)
class Activity:
    """An activity with start and end.

    Attributes:
        name: Its name.
        start_ns: Its start, in nanoseconds since 1970 UTC.
        stop_ns: Its end.
        colour: Colour of its bar.
    """

    name: str
    start_ns: int
    stop_ns: int
    colour: Colour


@dataclass(frozen=True, eq=False)
class AttemptTimes:
    """Times from the evidence of one attempt.

    Times of robots are converted to the clock of the first end. Times of moves are by the clock of the testbed's
    track.

    Attributes:
        bags: Contents of the bags that were sent, by file.
        transfers: Transfers with known fates of their packets.
        pings: Step name, role and output of each ping with an output.
        clock_offset_ns: Offset that is subtracted from the times of each role. For the second end, it is the offset
            of its clock relative to the first end; 0 if it is unknown and no packet gives an estimate, see
            `clock_note`. For the other robots, it is the difference of the measured offsets from the laptop's clock
            (`exchanges`); 0 if it is unknown, or not larger than its error.
        clock_note: Sentences about the source of the clock offsets.
        links: Samples of the radio link at each end.
        telemetry: Values from telemetry sources at each end by quantity (`telemetry_samples.series`).
        distances_m: Distances between the ends, with the start time of each; None in a gap of the positions; empty if
            unknown.
        ends: Roles of the first transfer's sender and receiver; `sender` and `receiver` without a transfer.
        jobs: Start and end of each job on a robot, by role and name.
        activities: Activities in the order of their starts.
    """

    bags: Mapping[str, RecordingContents]
    transfers: Sequence[tuple[Transfer, Fates]]
    pings: Sequence[tuple[str, Role, ping.Ping]]
    clock_offset_ns: Mapping[Role, int]
    clock_note: str
    links: Mapping[Role, Sequence[tuple[int, StationSample]]]
    telemetry: Mapping[Role, Mapping[str, Sequence[tuple[int, float]]]]
    distances_m: Sequence[tuple[int, float | None]]
    ends: tuple[Role, Role]
    jobs: Mapping[tuple[Role, str], tuple[int, int]]
    activities: Sequence[Activity] = ()


def read(evidence: AttemptEvidence, plan: Plan, repeats: Repeats, row: int) -> AttemptTimes:
    """Return the times from the evidence of the attempt in a row."""
    transfers = planned_evidence.transfers(plan, model.Protocol(repeats.texts["protocol"][row]))
    first_transfer = next(iter(transfers), None)
    ends = (first_transfer.source, first_transfer.destination) if first_transfer else (Role.SENDER, Role.RECEIVER)
    packets = [
        (transfer, packet_fates)
        for transfer in transfers
        if (packet_fates := fates.read(evidence, transfer)) is not None
    ]
    sent_bags = {
        transfer.sent_file: (transfer.source, evidence.read_or_none(recordings.read, transfer.sent_file))
        for transfer in transfers
    }
    outputs = [
        (source.name, source.role, evidence.read_or_none(ping.read, source.file))
        for source in planned_evidence.ping_sources(plan)
    ]
    offset_ns, clock_note = _clock_offset(
        transfers, packets, ends, {transfer.name: _offset_s(repeats, row, transfer) for transfer in transfers}
    )
    clock_offset_ns = dict.fromkeys((*plan.cast, *ends), 0) | {ends[1]: offset_ns}
    for role, offset in _other_offsets(evidence, plan.cast, ends):
        clock_offset_ns[role] = round(1e9 * offset.offset_s)
        clock_note += (
            f" Times of the {role} are corrected by {-1e3 * offset.offset_s:.3f} ms, with an error of up to "
            f"{1e3 * offset.error_s:.3f} ms."
        )
    links = {role: link.link_history(evidence.links(role)) for role in ends}
    times = AttemptTimes(
        bags={
            file: replace(contents, started_utc_ns=contents.started_utc_ns - clock_offset_ns[role])
            for file, (role, contents) in sent_bags.items()
            if contents
        },
        transfers=[
            (transfer, _correct_clocks(packet_fates, transfer, clock_offset_ns)) for transfer, packet_fates in packets
        ],
        pings=[(name, role, output) for name, role, output in outputs if output],
        clock_offset_ns=clock_offset_ns,
        clock_note=clock_note,
        links={
            role: [(at_ns - clock_offset_ns[role], sample) for at_ns, sample in history]
            for role, history in links.items()
        },
        telemetry={
            role: {
                quantity: [(at_ns - clock_offset_ns[role], value) for at_ns, value in values]
                for quantity, values in telemetry_samples.series(evidence, role, plan.cast[role].profile).items()
            }
            for role in ends
            if role in plan.cast
        },
        ends=ends,
        distances_m=position_columns.distances_m(evidence, ends),
        jobs={
            (role, name): (start_ns - clock_offset_ns[role], stop_ns - clock_offset_ns[role])
            for role in plan.cast
            for name, (start_ns, stop_ns) in (
                evidence.read_or_none(host.job_times_ns, host.after_file(role)) or {}
            ).items()
        },
    )
    activities = [
        *_activities_of_evidence(times),
        *_activities_of_jobs(times),
        *_activities_of_faults(times, evidence),
        *_activities_of_moves(evidence),
    ]
    return replace(times, activities=sorted(activities, key=lambda activity: activity.start_ns))


def _offset_s(repeats: Repeats, row: int, transfer: Transfer) -> float:
    """Return the offset of the clock at a transfer's destination relative to its source, or NaN if it is unknown."""
    column = repeats.numbers.get(step_prefixed(transfer.name, "clock_offset_s"))
    return math.nan if column is None else float(column[row])


def _clock_offset(
    transfers: Sequence[Transfer],
    packets: Sequence[tuple[Transfer, Fates]],
    ends: tuple[Role, Role],
    offsets_s: Mapping[str, float],
) -> tuple[int, str]:
    """Return the clock offset of the second end relative to the first in ns, and a sentence about its source."""
    signs = {ends: 1, ends[::-1]: -1}
    for transfer in transfers:
        if (sign := signs.get((transfer.source, transfer.destination))) and not math.isnan(offsets_s[transfer.name]):
            offset_s = sign * offsets_s[transfer.name]
            return round(1e9 * offset_s), f"Times of the {ends[1]} are corrected by {-1e3 * offset_s:.3f} ms."
    offset_ns = next(
        (
            sign * int(packet_fates.received_ns.min() - packet_fates.sent_ns.min())
            for transfer, packet_fates in packets
            if (sign := signs.get((transfer.source, transfer.destination))) and len(packet_fates.received_ns)
        ),
        None,
    )
    unknown_text = f"The offset between the clocks of {ends[0]} and {ends[1]} is not known"
    if offset_ns is None:
        return 0, f"{unknown_text}: the times of each robot are from its own clock."
    return offset_ns, f"{unknown_text}: here the delay of the first packet is assumed to be 0."


def _other_offsets(
    evidence: AttemptEvidence, roles: Iterable[Role], ends: tuple[Role, Role]
) -> Iterator[tuple[Role, Offset]]:
    """Yield the role of each robot except the ends, and the offset of its clock relative to the first end.

    The offset is the difference of two offsets from the laptop's clock. Robots are omitted if one of them is unknown,
    or if the difference may be 0.
    """
    first = exchanges.laptop_offset(evidence, ends[0])
    for role in roles:
        other = None if role in ends else exchanges.laptop_offset(evidence, role)
        if first is not None and other is not None:
            offset = Offset(other.offset_s - first.offset_s, other.error_s + first.error_s)
            if abs(offset.offset_s) > offset.error_s:
                yield role, offset


def _correct_clocks(packet_fates: Fates, transfer: Transfer, clock_offset_ns: Mapping[Role, int]) -> Fates:
    """Return the packets with corrected times; `clock_offset_ns` is described in `AttemptTimes`."""
    return replace(
        packet_fates,
        sent_ns=packet_fates.sent_ns - clock_offset_ns[transfer.source],
        received_ns=packet_fates.received_ns - clock_offset_ns[transfer.destination],
    )


def _activities_of_evidence(times: AttemptTimes) -> Iterator[Activity]:
    """Yield recordings, transfers and pings, whose evidence contains times."""
    for file, recording in times.bags.items():
        label = _step_label("record", Path(file).stem if len(times.bags) > 1 else "")
        yield Activity(
            label, recording.started_utc_ns, recording.started_utc_ns + round(recording.duration_s * 1e9), "sky"
        )
    for transfer, packets in times.transfers:
        sent_ns, received_ns = packets.sent_ns, packets.received_ns
        yield Activity(_step_label("send", transfer.name), int(sent_ns.min()), int(sent_ns.max()), "blue")
        if len(received_ns):
            label = _step_label("receive", transfer.name)
            yield Activity(label, int(received_ns.min()), int(received_ns.max()), "green")
    for name, role, pings in times.pings:
        stamps_ns = [
            reply.at_utc_ns - times.clock_offset_ns[role] for reply in pings.answers if reply.at_utc_ns is not None
        ]
        # The time of the job includes requests without a reply, for which ping prints no time.
        if times_ns := [*stamps_ns, *times.jobs.get((role, step_prefixed(name, "ping")), ())]:
            yield Activity(_step_label("ping", name), min(times_ns), max(times_ns), "pink")


def _step_label(what: str, name: str) -> str:
    """Return the label of an activity of a step: `send up`, or `send` for a step without a name."""
    return f"{what} {name}".rstrip()


def _activities_of_jobs(times: AttemptTimes) -> Iterator[Activity]:
    """Yield the jobs that no other evidence shows. Jobs of the same name on several robots are combined."""
    names_with_evidence = {activity.name.partition(" ")[0] for activity in _activities_of_evidence(times)}
    names = dict.fromkeys(name for _, name in times.jobs)
    for name in names:
        what = plain_name(name)
        # The activity of the job `listen` is named `receive`. If it exists, the evidence shows the other jobs, too.
        if what.startswith("fault-") or (what in _SHOWN_BY_EVIDENCE and {what, "receive"} & names_with_evidence):
            continue
        spans = [span for (_, job), span in times.jobs.items() if job == name]
        step = name.rpartition(".")[0]
        yield Activity(
            _step_label(what, step), min(start for start, _ in spans), max(stop for _, stop in spans), "sky"
        )


def _activities_of_faults(times: AttemptTimes, evidence: AttemptEvidence) -> Iterator[Activity]:
    """Yield each fault from its start to its end, at which the job that waits for recovery starts."""
    for (role, name), (recovery_ns, _) in times.jobs.items():
        step, _, what = name.rpartition(".")
        kind = what.removeprefix("fault-").removesuffix(_RECOVERY_JOB_SUFFIX)
        if (
            what.startswith("fault-")
            and what.endswith(_RECOVERY_JOB_SUFFIX)
            and kind in {str(fault) for fault in FaultKind}
        ):
            note = step_prefixed(step, outage.note_file(FaultKind(kind)))
            lasted_s = evidence.read_or_none(outage.cause_duration_s, note) or 0.0
            yield Activity(
                f"fault {_step_label(kind, step)}", recovery_ns - round(lasted_s * 1e9), recovery_ns, "lost"
            )
            yield from _outage(times, evidence, role, FaultKind(kind), step)


def _outage(
    times: AttemptTimes, evidence: AttemptEvidence, role: Role, kind: FaultKind, step: str
) -> Iterator[Activity]:
    """Yield the longest time without an answer to the observer's pings, up to the end if no more answers came."""
    output = evidence.read_or_none(ping.read, step_prefixed(step, outage.observed_file(kind)))
    stamps_ns = sorted(reply.at_utc_ns for reply in output.answers if reply.at_utc_ns is not None) if output else []
    if not stamps_ns or kind is FaultKind.KILL:
        return
    end_ns = times.jobs.get((role, step_prefixed(step, f"fault-{kind}")), (0, 0))[1]
    times_ns = [stamp_ns - times.clock_offset_ns[role] for stamp_ns in stamps_ns]
    gaps = list(pairwise([*times_ns, max(end_ns, times_ns[-1])]))
    start_ns, stop_ns = max(gaps, key=lambda gap: gap[1] - gap[0])
    yield Activity(f"no answer {_step_label(kind, step)}", start_ns, stop_ns, "void")


def _activities_of_moves(evidence: AttemptEvidence) -> Iterator[Activity]:
    """Yield the period in which each robot moved during the attempt, according to the testbed's track."""
    samples = evidence.read_or_none(track.read, track.FILE) or ()
    for role in dict.fromkeys(sample.role for sample in samples):
        track_points = [sample for sample in samples if sample.role == role]
        changes = [
            (before.utc_ns, after.utc_ns)
            for before, after in pairwise(track_points)
            if before.position_m != after.position_m and after.utc_ns - before.utc_ns < _LONGEST_PAUSE_NS
        ]
        if changes:
            yield Activity(f"move {role}", changes[0][0], changes[-1][1], "orange")


@runtime_checkable
class DrawsPanels(Protocol):
    """A step whose evidence is drawn over time, in panels of the time line of an attempt."""

    def panels(self, evidence: AttemptEvidence, times: AttemptTimes, zero_ns: int) -> Iterator[Panel]:
        """Yield the panels; there are none without evidence.

        Args:
            evidence: Evidence of the attempt.
            times: Times of the attempt.
            zero_ns: Start of the time axis, in nanoseconds since 1970 UTC.
        """
        ...


TIME_LABEL: Final = "time [s]"
"""Label of the time axis of the panels."""
_ENDS: Final = (Style("blue", line="solid"), Style("green", line="dashed"))
"""Styles of the sender and of the receiver."""


def flow_panels(evidence: AttemptEvidence, plan: Plan, times: AttemptTimes, zero_ns: int) -> Iterator[Panel]:
    """Yield the panels of steps whose evidence has times: iperf3 tests, and steps that implement `DrawsPanels`.

    Args:
        evidence: Evidence of the attempt.
        plan: Plan of its trial.
        times: Times of the attempt.
        zero_ns: Start of the time axis, in nanoseconds since 1970 UTC.
    """
    for placed_step in plan.procedure.walk():
        if placed_step.kind == "iperf3":
            yield from _iperf3(placed_step, evidence, times, zero_ns)
        elif isinstance(placed_step.step, DrawsPanels):
            yield from placed_step.step.panels(evidence, times, zero_ns)


def _iperf3(placed_step: PlacedStep, evidence: AttemptEvidence, times: AttemptTimes, zero_ns: int) -> Iterator[Panel]:
    """Yield the payload rate that each end counted per second. The first second begins when the client starts."""
    step = placed_step.step
    client = next((span for (_, job), span in times.jobs.items() if job == step.prefixed_name("iperf3-client")), None)
    if client is None:
        return
    start_s = (client[0] - zero_ns) / 1e9
    series, ranges = [], []
    for role, style in zip((Role.SENDER, Role.RECEIVER), _ENDS, strict=True):
        test = evidence.read_or_none(iperf3.read, step.prefixed_name(iperf3.json_file(role)))
        if test and test.intervals:
            at_s = start_s + np.cumsum([0.0, *(interval.duration_s for interval in test.intervals)])
            rates = [interval.bit_s / 1e6 for interval in test.intervals]
            series.append(Series(role, style, at_s, [*rates, rates[-1]], join="steps"))
            ranges.append(f"{role} {min(rates):.2f} to {max(rates):.2f}")
    if series:
        yield Panel(
            title=f"payload of {step.prefixed_name('iperf3')}",
            x_label=TIME_LABEL,
            y_label="[Mbit/s]",
            series=series,
            description=f"Mbit/s of payload each second: {', '.join(ranges)}",
        )
