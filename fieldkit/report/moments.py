"""Times in one attempt by one clock, that of the robot that sends first: packets, pings, jobs, faults, moves."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Final

from fieldkit.analysis.repeats import Repeats
from fieldkit.core.columns import plain_name, prefixed
from fieldkit.core.model import FaultKind, Protocol, Role, StationSample
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.evidence import bag, host, link, ping, recovery, track
from fieldkit.measure.positions import where
from fieldkit.measure.transfers import fates
from fieldkit.measure.transfers.fates import Fates
from fieldkit.measure.transfers.transfer import Transfer
from fieldkit.report.theme import Colour
from fieldkit.trial.plan import Plan

_SHOWN_BY_EVIDENCE: Final = frozenset(("record", "send", "listen", "ping"))
"""Jobs whose own evidence says more exactly when they did something."""
_HEALS: Final = "-heals"
_LONGEST_PAUSE_NS: Final = 1_000_000_000
"""A robot whose place changes more often than this is moving."""


@dataclass(frozen=True)
class Happening:
    """Something that went on for a time.

    Attributes:
        name: What.
        start_ns: From when on, in nanoseconds since 1970 UTC.
        stop_ns: Until when.
        colour: Of its bar.
    """

    name: str
    start_ns: int
    stop_ns: int
    colour: Colour


@dataclass(frozen=True, eq=False)
class Moments:
    """What the evidence of one attempt says of times, all of them by the clock of the first robot that sends.

    Attributes:
        recorded: The bags that were sent, by file.
        transfers: The transfers whose packets' fates are known.
        pings: Of each ping whose output is there the name of its step, who asked, and what ping said.
        ahead_ns: By role its clock less that of the first that sends; 0 if that is unknown.
        clocks: How that is known, in a sentence.
        links: What the radio of each end said of its link.
        distances_m: How far those ends were apart, and from when on; empty if that is unknown.
        ends: Who sends first and who receives that.
        jobs: When each job on a robot ran, by role and name.
        happenings: What went on, in the order of time.
    """

    recorded: Mapping[str, bag.Bag]
    transfers: Sequence[tuple[Transfer, Fates]]
    pings: Sequence[tuple[str, Role, ping.Ping]]
    ahead_ns: Mapping[Role, int]
    clocks: str
    links: Mapping[Role, Sequence[tuple[int, StationSample]]]
    distances_m: Sequence[tuple[int, float | None]]
    ends: tuple[Role, Role]
    jobs: Mapping[tuple[Role, str], tuple[int, int]]
    happenings: Sequence[Happening] = ()


def read(evidence: AttemptEvidence, plan: Plan, repeats: Repeats, row: int) -> Moments:
    """Return what the evidence of the attempt in a row says of times."""
    transfers = plan.transfers(Protocol(repeats.texts["protocol"][row]))
    first = next(iter(transfers), None)
    ends = (first.source, first.destination) if first else (Role.SENDER, Role.RECEIVER)
    seen = [(transfer, one) for transfer in transfers if (one := fates.read(evidence, transfer)) is not None]
    bags = {transfer.sent_file: evidence.read_or_none(bag.read, transfer.sent_file) for transfer in transfers}
    said = [(one.name, one.role, evidence.read_or_none(ping.read, one.file)) for one in plan.pingings()]
    apart_ns, clocks = _apart(transfers, seen, ends, {one.name: _offset_s(repeats, row, one) for one in transfers})
    ahead_ns = dict.fromkeys((*plan.cast, *ends), 0) | {ends[1]: apart_ns}
    links = {role: link.line(evidence.links(role)) for role in ends}
    found = Moments(
        recorded={file: one for file, one in bags.items() if one},
        transfers=[(transfer, _shifted(one, transfer, ahead_ns)) for transfer, one in seen],
        pings=[(name, role, one) for name, role, one in said if one],
        ahead_ns=ahead_ns,
        clocks=clocks,
        links={role: [(at_ns - ahead_ns[role], one) for at_ns, one in line] for role, line in links.items()},
        ends=ends,
        distances_m=where.distances_m(evidence, ends),
        jobs={
            (role, name): (start_ns - ahead_ns[role], stop_ns - ahead_ns[role])
            for role in plan.cast
            for name, (start_ns, stop_ns) in (
                evidence.read_or_none(host.job_times_ns, host.after(role)) or {}
            ).items()
        },
    )
    happenings = [*_of_evidence(found), *_of_jobs(found), *_of_faults(found, evidence), *_of_moves(evidence)]
    return replace(found, happenings=sorted(happenings, key=lambda each: each.start_ns))


def _offset_s(repeats: Repeats, row: int, transfer: Transfer) -> float:
    """Return how far the clock of a transfer's destination is ahead of its source's, NaN where that is not known."""
    column = repeats.numbers.get(prefixed(transfer.name, "clock_offset_s"))
    return math.nan if column is None else float(column[row])


def _apart(
    transfers: Sequence[Transfer],
    seen: Sequence[tuple[Transfer, Fates]],
    ends: tuple[Role, Role],
    offsets_s: Mapping[str, float],
) -> tuple[int, str]:
    """Return how far the clock of the second end is ahead of the first's, by any transfer between them, and how."""
    ways = {ends: 1, ends[::-1]: -1}
    for one in transfers:
        if (way := ways.get((one.source, one.destination))) and not math.isnan(offsets_s[one.name]):
            offset_s = way * offsets_s[one.name]
            return round(1e9 * offset_s), f"Times of the {ends[1]} are corrected by {-1e3 * offset_s:.3f} ms."
    apart_ns = next(
        (
            way * int(of.received_ns.min() - of.sent_ns.min())
            for one, of in seen
            if (way := ways.get((one.source, one.destination))) and len(of.received_ns)
        ),
        None,
    )
    unknown = f"The offset between the clocks of {ends[0]} and {ends[1]} is not known"
    if apart_ns is None:
        return 0, f"{unknown}: each time is by the clock of its robot."
    return apart_ns, f"{unknown}: here the first packet takes no time."


def _shifted(one: Fates, transfer: Transfer, ahead_ns: Mapping[Role, int]) -> Fates:
    return replace(
        one,
        sent_ns=one.sent_ns - ahead_ns[transfer.source],
        received_ns=one.received_ns - ahead_ns[transfer.destination],
    )


def _of_evidence(found: Moments) -> Iterator[Happening]:
    """Yield recordings, transfers and pings, whose evidence has times."""
    for file, one in found.recorded.items():
        what = _called("record", Path(file).stem if len(found.recorded) > 1 else "")
        yield Happening(what, one.started_utc_ns, one.started_utc_ns + round(one.duration_s * 1e9), "sky")
    for transfer, packets in found.transfers:
        sent_ns, received_ns = packets.sent_ns, packets.received_ns
        yield Happening(_called("send", transfer.name), int(sent_ns.min()), int(sent_ns.max()), "blue")
        if len(received_ns):
            what = _called("receive", transfer.name)
            yield Happening(what, int(received_ns.min()), int(received_ns.max()), "green")
    for name, role, pings in found.pings:
        stamps_ns = [reply.at_utc_ns - found.ahead_ns[role] for reply in pings.answers if reply.at_utc_ns is not None]
        # The job also covers requests without a reply, of which ping prints no time.
        if times_ns := [*stamps_ns, *found.jobs.get((role, prefixed(name, "ping")), ())]:
            yield Happening(_called("ping", name), min(times_ns), max(times_ns), "pink")


def _called(what: str, name: str) -> str:
    """Return what is called so of a step: `send up`, `send` of one without a name."""
    return f"{what} {name}".rstrip()


def _of_jobs(found: Moments) -> Iterator[Happening]:
    """Yield the jobs that no other evidence shows, those of one name on several robots together."""
    seen = {each.name.partition(" ")[0] for each in _of_evidence(found)}
    names = dict.fromkeys(name for _, name in found.jobs)
    for name in names:
        what = plain_name(name)
        if what.startswith("fault-") or (what in _SHOWN_BY_EVIDENCE and {what, "receive"} & seen):
            continue
        times = [span for (_, job), span in found.jobs.items() if job == name]
        step = name.rpartition(".")[0]
        yield Happening(_called(what, step), min(start for start, _ in times), max(stop for _, stop in times), "sky")


def _of_faults(found: Moments, evidence: AttemptEvidence) -> Iterator[Happening]:
    """Yield each fault from its beginning until its cause was over, which starts the job that waits for recovery."""
    for (role, name), (heals_ns, _) in found.jobs.items():
        step, _, what = name.rpartition(".")
        kind = what.removeprefix("fault-").removesuffix(_HEALS)
        if what.startswith("fault-") and what.endswith(_HEALS) and kind in {str(one) for one in FaultKind}:
            note = prefixed(step, recovery.note_file(FaultKind(kind)))
            lasted_s = evidence.read_or_none(recovery.cause_lasted_s, note) or 0.0
            yield Happening(f"fault {_called(kind, step)}", heals_ns - round(lasted_s * 1e9), heals_ns, "lost")
            yield from _outage(found, evidence, role, FaultKind(kind), step)


def _outage(found: Moments, evidence: AttemptEvidence, role: Role, kind: FaultKind, step: str) -> Iterator[Happening]:
    """Yield the longest time without an answer to the observer's pings, to their end if none came any more."""
    said = evidence.read_or_none(ping.read, prefixed(step, recovery.observed_file(kind)))
    stamps_ns = sorted(reply.at_utc_ns for reply in said.answers if reply.at_utc_ns is not None) if said else []
    if not stamps_ns or kind is FaultKind.KILL:
        return
    end_ns = found.jobs.get((role, prefixed(step, f"fault-{kind}")), (0, 0))[1]
    times_ns = [stamp_ns - found.ahead_ns[role] for stamp_ns in stamps_ns]
    gaps = list(pairwise([*times_ns, max(end_ns, times_ns[-1])]))
    start_ns, stop_ns = max(gaps, key=lambda gap: gap[1] - gap[0])
    yield Happening(f"no answer {_called(kind, step)}", start_ns, stop_ns, "void")


def _of_moves(evidence: AttemptEvidence) -> Iterator[Happening]:
    """Yield the time in which a robot moved during the attempt, by what the testbed knows."""
    places = evidence.read_or_none(track.read, track.FILE) or ()
    for role in dict.fromkeys(each.role for each in places):
        mine = [each for each in places if each.role == role]
        changes = [
            (before.utc_ns, after.utc_ns)
            for before, after in pairwise(mine)
            if before.position_m != after.position_m and after.utc_ns - before.utc_ns < _LONGEST_PAUSE_NS
        ]
        if changes:
            yield Happening(f"move {role}", changes[0][0], changes[-1][1], "orange")
