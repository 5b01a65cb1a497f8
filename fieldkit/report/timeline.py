"""The time line of one repeat: what went on when, each packet at both ends, each round trip, the robots' distance."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fieldkit.analysis.repeats import Repeats
from fieldkit.core.columns import prefixed
from fieldkit.core.model import Protocol, Role, StationSample
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.evidence import bag, link, ping
from fieldkit.measure.positions import where
from fieldkit.measure.transfers import fates
from fieldkit.measure.transfers.fates import Fates
from fieldkit.measure.transfers.transfer import Transfer
from fieldkit.report.charts import Chart, Panel, Series, Span
from fieldkit.report.evidence import Evidence
from fieldkit.report.theme import Colour, Style
from fieldkit.trial.plan import Plan

MOST_PACKETS: Final = 1500
"""Of each kind in a panel; of more, every k-th is drawn."""

_MARKED: Final = {Protocol.UDP: "lost", Protocol.TCP: "sent again"}
_SENT: Final = Style("blue", "o", "none")
_RECEIVED: Final = Style("green", "^", "none")
_MARK: Final = Style("lost", "x", "none")
_ROUND_TRIP: Final = Style("pink", "D", "none")
_DISTANCE: Final = Style("orange", line="solid")
_LINKS: Final = (Style("blue", line="solid"), Style("green", line="dashed"))
"""Of the one that sends, and of the other."""
_LEAST_BAR: Final = 0.004
"""Of the axis: what is shorter would not be seen."""


def charts(row: int, found: Evidence) -> Iterator[Chart]:
    """Yield the time line of the attempt in a row whose evidence is at hand; none when nothing of it has times."""
    evidence, plan = found.attempt(row), found.plan(row)
    if evidence is None or plan is None:
        return
    told = _read(evidence, plan, found.repeats, row)
    spans = list(_spans(told))
    if not spans:
        return
    zero_ns = min(span[1] for span in spans)
    panels = [
        _phases(spans, zero_ns),
        *(_packets(transfer, one, zero_ns) for transfer, one in told.transfers),
        *(panel for one in told.pings for panel in _round_trips(*one, zero_ns + told.ahead_ns[one[1]])),
        *_links(told, zero_ns),
        *_distance(told, zero_ns),
    ]
    reason = found.repeats.texts["reason"][row]
    ended = ": ".join(filter(None, (found.repeats.texts["status"][row], reason)))
    yield Chart(
        name="timeline",
        title=f"Time line of {evidence.folder.name}",
        caption=f"Trial {plan.trial}, {ended}. {told.clocks}",
        panels=panels,
    )


@dataclass(frozen=True, eq=False)
class _Told:
    """What the evidence of one attempt tells of times, all of them by the clock of the first that sends.

    Attributes:
        recorded: The bags that were sent, by file.
        transfers: The transfers whose packets' fates are known.
        pings: Of each ping whose output is there the name of its step, who asked, and what ping said.
        ahead_ns: By role its clock less that of the first that sends; 0 where nobody knows.
        clocks: How that is known, in a sentence.
        links: What the radio of each end told of its link.
        distances_m: How far those ends were apart, and from when on; empty where nobody knows.
        ends: Who sends first and who receives that.
    """

    recorded: Mapping[str, bag.Bag]
    transfers: Sequence[tuple[Transfer, Fates]]
    pings: Sequence[tuple[str, Role, ping.Ping]]
    ahead_ns: Mapping[Role, int]
    clocks: str
    links: Mapping[Role, Sequence[tuple[int, StationSample]]]
    distances_m: Sequence[tuple[int, float | None]]
    ends: tuple[Role, Role]


def _read(evidence: AttemptEvidence, plan: Plan, repeats: Repeats, row: int) -> _Told:
    transfers = plan.transfers(Protocol(repeats.texts["protocol"][row]))
    first = next(iter(transfers), None)
    ends = (first.source, first.destination) if first else (Role.SENDER, Role.RECEIVER)
    seen = [(transfer, one) for transfer in transfers if (one := fates.read(evidence, transfer)) is not None]
    bags = {transfer.sent_file: evidence.known(bag.read, transfer.sent_file) for transfer in transfers}
    said = [(one.name, one.role, evidence.known(ping.read, one.file)) for one in plan.pingings()]
    apart_ns, clocks = _apart(transfers, seen, ends, {one.name: _offset_s(repeats, row, one) for one in transfers})
    ahead_ns = dict.fromkeys((*plan.cast, *ends), 0) | {ends[1]: apart_ns}
    links = {role: link.line(evidence.links(role)) for role in ends}
    return _Told(
        recorded={file: one for file, one in bags.items() if one},
        transfers=[(transfer, _shifted(one, transfer, ahead_ns)) for transfer, one in seen],
        pings=[(name, role, one) for name, role, one in said if one],
        ahead_ns=ahead_ns,
        clocks=clocks,
        links={role: [(at_ns - ahead_ns[role], one) for at_ns, one in line] for role, line in links.items()},
        ends=ends,
        distances_m=where.distances_m(evidence, ends),
    )


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
            said = f"Times of the {ends[1]} are less its clock's offset, {1e3 * offset_s:.3f} ms."
            return round(1e9 * offset_s), said
    apart_ns = next(
        (
            way * int(of.received_ns.min() - of.sent_ns.min())
            for one, of in seen
            if (way := ways.get((one.source, one.destination))) and len(of.received_ns)
        ),
        0,
    )
    apart = f"How far the clocks of {ends[0]} and {ends[1]} are apart is not known"
    return apart_ns, f"{apart}: here the first packet takes no time."


def _shifted(one: Fates, transfer: Transfer, ahead_ns: Mapping[Role, int]) -> Fates:
    return replace(
        one,
        sent_ns=one.sent_ns - ahead_ns[transfer.source],
        received_ns=one.received_ns - ahead_ns[transfer.destination],
    )


def _spans(told: _Told) -> Iterator[tuple[str, int, int, Colour]]:
    """Yield what went on, from when until when, in nanoseconds since 1970 UTC."""
    for file, one in told.recorded.items():
        what = _called("record", Path(file).stem if len(told.recorded) > 1 else "")
        yield what, one.started_utc_ns, one.started_utc_ns + round(one.duration_s * 1e9), "sky"
    for transfer, packets in told.transfers:
        sent_ns, received_ns = packets.sent_ns, packets.received_ns
        yield _called("send", transfer.name), int(sent_ns.min()), int(sent_ns.max()), _SENT.colour
        if len(received_ns):
            what = _called("receive", transfer.name)
            yield what, int(received_ns.min()), int(received_ns.max()), _RECEIVED.colour
    for name, role, pings in told.pings:
        stamps_ns = [reply.at_utc_ns for reply in pings.answers if reply.at_utc_ns is not None]
        if stamps_ns:
            first_ns, last_ns = (end - told.ahead_ns[role] for end in (min(stamps_ns), max(stamps_ns)))
            yield _called("ping", name), first_ns, last_ns, _ROUND_TRIP.colour


def _called(what: str, name: str) -> str:
    """Return what is called so of a step: `send up`, `send` of one without a name."""
    return f"{what} {name}".rstrip()


def _phases(spans: Sequence[tuple[str, int, int, Colour]], zero_ns: int) -> Panel:
    """Return a lane for each thing that went on, the first on top."""
    last = len(spans) - 1
    at_s = {name: ((start - zero_ns) / 1e9, (stop - zero_ns) / 1e9) for name, start, stop, _ in spans}
    least_s = _LEAST_BAR * max(stop for _, stop in at_s.values())
    return Panel(
        title="what went on",
        x_label="time [s]",
        y_label="",
        series=[],
        words="; ".join(f"{name} from {start:.3f} to {stop:.3f} s" for name, (start, stop) in at_s.items()),
        spans=[
            Span(last - lane, at_s[name][0], max(at_s[name][1], at_s[name][0] + least_s), colour)
            for lane, (name, _, _, colour) in enumerate(spans)
        ],
        lanes=[name for name, *_ in reversed(spans)],
    )


def _packets(transfer: Transfer, one: Fates, zero_ns: int) -> Panel:
    """Return where in the payload each packet begins, against time, at both ends."""
    begins_ns = int(one.sent_ns.min())
    what = _MARKED[transfer.protocol]
    kinds = (
        ("sent", _SENT, one.sent_ns[~one.marked], one.sent_bytes[~one.marked]),
        ("received", _RECEIVED, one.received_ns, one.received_bytes),
        (what, _MARK, one.sent_ns[one.marked], one.sent_bytes[one.marked]),
    )
    series = []
    for label, style, at_ns, at_bytes in kinds:
        some = slice(None, None, max(1, -(-len(at_ns) // MOST_PACKETS)))
        series.append(Series(label, style, (at_ns[some] - begins_ns) / 1e6, at_bytes[some] / 1e3))
    return Panel(
        title=f"packets of {transfer.name or 'the transfer'}",
        x_label=f"time [ms] after {(begins_ns - zero_ns) / 1e9:.3f} s",
        y_label="place in the payload [kB]",
        series=series,
        words=f"{len(one.sent_ns)} packets sent, {one.marked.sum()} of them {what}, {len(one.received_ns)} received",
    )


def _round_trips(name: str, _role: Role, pings: ping.Ping, zero_ns: int) -> Iterator[Panel]:
    """Yield the time that each round trip took, and the requests without a reply, against time by its own clock."""
    answered = [
        (reply.seq, reply.at_utc_ns - zero_ns, reply.rtt_s)
        for reply in pings.answers
        if reply.at_utc_ns is not None and reply.rtt_s is not None
    ]
    if not answered:
        return
    seq, at_ns, rtt_s = np.array(answered).T
    at_s = at_ns / 1e9
    series = [Series("round trip", _ROUND_TRIP, at_s, 1e3 * rtt_s)]
    gaps = np.array(pings.gaps)
    if len(gaps):
        series.append(Series("no reply", _MARK, left_at(gaps, seq, at_s), np.zeros(len(gaps))))
    yield Panel(
        title=f"round trips of {name}" if name else "round trips",
        x_label="time [s]",
        y_label="round-trip time [ms]",
        series=series,
        words=f"{len(answered)} round trips, median {1e3 * np.median(rtt_s):.2f} ms; {len(gaps)} without a reply",
    )


def left_at(number: NDArray[np.int64], known: NDArray[np.float64], at_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return about when requests left that were never answered, which nobody says: by number among the others.

    Args:
        number: Of those requests.
        known: Of the others, rising.
        at_s: When the replies to those came.
    """
    step_s = (at_s[-1] - at_s[0]) / (known[-1] - known[0]) if len(known) > 1 else 1.0  # ping's own default
    among: NDArray[np.float64] = np.interp(number, known, at_s)
    beyond: NDArray[np.float64] = np.minimum(number - known[0], 0) + np.maximum(number - known[-1], 0)
    return among + step_s * beyond


def _links(told: _Told, zero_ns: int) -> Iterator[Panel]:
    """Yield what both radios told of their links, against time: the signal, and the rate that they sent at."""
    signals = {role: [(at_ns, one.signal_dbm) for at_ns, one in link_] for role, link_ in told.links.items()}
    rates = {
        role: [(at_ns, one.tx_rate_bit_s and one.tx_rate_bit_s / 1e6) for at_ns, one in link_]
        for role, link_ in told.links.items()
    }
    yield from _of_radios("signal", "signal [dBm]", signals, zero_ns, bottom=None)
    yield from _of_radios("rate", "rate sent at [Mbit/s]", rates, zero_ns, bottom=0.0)


def _of_radios(
    what: str,
    y_label: str,
    values: Mapping[Role, Sequence[tuple[int, float | None]]],
    zero_ns: int,
    *,
    bottom: float | None,
) -> Iterator[Panel]:
    """Yield what each radio told of one thing, against time, if any did; the one that sends comes first."""
    series, words = [], []
    for (role, told), style in zip(values.items(), _LINKS, strict=True):
        known = [((at_ns - zero_ns) / 1e9, value) for at_ns, value in told if value is not None]
        if known:
            at_s, heights = zip(*known, strict=True)
            series.append(Series(role, style, at_s, heights))
            words.append(f"{role} {min(heights):g} to {max(heights):g}")
    if series:
        yield Panel(
            title=f"{what} of the radios",
            x_label="time [s]",
            y_label=y_label,
            series=series,
            words=f"{y_label}: {', '.join(words)}",
            bottom=bottom,
        )


def _distance(told: _Told, zero_ns: int) -> Iterator[Panel]:
    """Yield how far sender and receiver were apart, against time, if that changed."""
    changes = [(max(utc_ns - zero_ns, 0) / 1e9, metres) for utc_ns, metres in told.distances_m]
    known_m = [metres for _, metres in changes if metres is not None]
    if len(set(known_m)) < 2:
        return
    at_s, distance_m = zip(*((at, math.nan if metres is None else metres) for at, metres in changes), strict=True)
    yield Panel(
        title="distance between sender and receiver",
        x_label="time [s]",
        y_label="distance [m]",
        series=[Series("distance", _DISTANCE, at_s, distance_m, join="steps")],
        words=f"{min(known_m):.1f} to {max(known_m):.1f} m",
    )
