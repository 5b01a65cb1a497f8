"""The time line of one repeat: what went on when, each packet at both ends, each round trip, the robots' distance."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fieldkit.core.model import Protocol, Role, StationSample
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.evidence import bag, link, ping
from fieldkit.measure.positions import where
from fieldkit.measure.transfers import fates
from fieldkit.measure.transfers.fates import Fates
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
    offset_s = float(found.repeats.numbers["clock_offset_s"][row])
    told = _read(evidence, plan, Protocol(found.repeats.texts["protocol"][row]), offset_s)
    spans = list(_spans(told))
    if not spans:
        return
    zero_ns = min(span[1] for span in spans)
    panels = [
        _phases(spans, zero_ns),
        *_packets(told, zero_ns),
        *_round_trips(told, zero_ns),
        *_links(told, zero_ns),
        *_distance(told, zero_ns),
    ]
    clocks = (
        "How far the clocks of sender and receiver are apart is not known: here the first packet takes no time."
        if np.isnan(offset_s)
        else f"Times of the receiver are less its clock's offset, {1e3 * offset_s:.3f} ms."
    )
    reason = found.repeats.texts["reason"][row]
    ended = ": ".join(filter(None, (found.repeats.texts["status"][row], reason)))
    yield Chart(
        name="timeline",
        title=f"Time line of {evidence.folder.name}",
        caption=f"Trial {plan.trial}, {ended}. {clocks}",
        panels=panels,
    )


@dataclass(frozen=True, eq=False)
class _Told:
    """What the evidence of one attempt tells of times, each None where it does not.

    Attributes:
        protocol: Of the transfer.
        recorded: The bag that was sent.
        packets: The transfer's packets; the receiver's times by the sender's clock.
        pings: What ping said.
        ping_ahead_ns: The clock that it went by, less the sender's.
        links: What the radio of each end told of its link, with times by the sender's clock.
        distances_m: How far sender and receiver were apart, and from when on; empty where nobody knows.
        ends: Who sends and who receives.
    """

    protocol: Protocol
    recorded: bag.Bag | None
    packets: Fates | None
    pings: ping.Ping | None
    ping_ahead_ns: int
    links: Mapping[Role, Sequence[tuple[int, StationSample]]]
    distances_m: Sequence[tuple[int, float | None]]
    ends: tuple[Role, Role]


def _read(evidence: AttemptEvidence, plan: Plan, protocol: Protocol, offset_s: float) -> _Told:
    transfer, pinging = plan.transfer(protocol), plan.pinging
    packets = fates.read(evidence, transfer) if transfer else None
    ahead_ns = 0 if np.isnan(offset_s) else round(1e9 * offset_s)
    if packets and np.isnan(offset_s) and len(packets.received_ns):
        ahead_ns = int(packets.received_ns.min() - packets.sent_ns.min())
    ends = (transfer.source, transfer.destination) if transfer else (Role.SENDER, Role.RECEIVER)
    return _Told(
        protocol=protocol,
        recorded=evidence.known(bag.read, transfer.sent_file) if transfer else None,
        packets=replace(packets, received_ns=packets.received_ns - ahead_ns) if packets else None,
        pings=evidence.known(ping.read, pinging.file) if pinging else None,
        ping_ahead_ns=ahead_ns if transfer and pinging and pinging.role == transfer.destination else 0,
        links={
            role: [(at_ns - ahead_ns * (role == ends[1]), one) for at_ns, one in link.line(evidence.links(role))]
            for role in ends
        },
        ends=ends,
        distances_m=where.distances_m(evidence, ends),
    )


def _spans(told: _Told) -> Iterator[tuple[str, int, int, Colour]]:
    """Yield what went on, from when until when, in nanoseconds since 1970 UTC."""
    if one := told.recorded:
        yield "record", one.started_utc_ns, one.started_utc_ns + round(one.duration_s * 1e9), "sky"
    if packets := told.packets:
        yield "send", int(packets.sent_ns.min()), int(packets.sent_ns.max()), _SENT.colour
        if len(packets.received_ns):
            yield "receive", int(packets.received_ns.min()), int(packets.received_ns.max()), _RECEIVED.colour
    if len(at_ns := _replied(told)):
        yield "ping", int(at_ns.min()), int(at_ns.max()), _ROUND_TRIP.colour


def _replied(told: _Told) -> NDArray[np.int64]:
    """Return when replies came, of those with a stamp."""
    stamps = [reply.at_utc_ns for reply in told.pings.answers if reply.at_utc_ns is not None] if told.pings else []
    return np.array(stamps, dtype=np.int64) - told.ping_ahead_ns


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


def _packets(told: _Told, zero_ns: int) -> Iterator[Panel]:
    """Yield where in the payload each packet begins, against time, at both ends."""
    if (one := told.packets) is None:
        return
    begins_ns = int(one.sent_ns.min())
    what = _MARKED[told.protocol]
    kinds = (
        ("sent", _SENT, one.sent_ns[~one.marked], one.sent_bytes[~one.marked]),
        ("received", _RECEIVED, one.received_ns, one.received_bytes),
        (what, _MARK, one.sent_ns[one.marked], one.sent_bytes[one.marked]),
    )
    series = []
    for label, style, at_ns, at_bytes in kinds:
        some = slice(None, None, max(1, -(-len(at_ns) // MOST_PACKETS)))
        series.append(Series(label, style, (at_ns[some] - begins_ns) / 1e6, at_bytes[some] / 1e3))
    yield Panel(
        title="packets of the transfer",
        x_label=f"time [ms] after {(begins_ns - zero_ns) / 1e9:.3f} s",
        y_label="place in the payload [kB]",
        series=series,
        words=f"{len(one.sent_ns)} packets sent, {one.marked.sum()} of them {what}, {len(one.received_ns)} received",
    )


def _round_trips(told: _Told, zero_ns: int) -> Iterator[Panel]:
    """Yield the time that each round trip took, and the requests without a reply, against time."""
    if told.pings is None:
        return
    answered = [
        (reply.seq, reply.at_utc_ns - told.ping_ahead_ns - zero_ns, reply.rtt_s)
        for reply in told.pings.answers
        if reply.at_utc_ns is not None and reply.rtt_s is not None
    ]
    if not answered:
        return
    seq, at_ns, rtt_s = np.array(answered).T
    at_s = at_ns / 1e9
    series = [Series("round trip", _ROUND_TRIP, at_s, 1e3 * rtt_s)]
    gaps = np.array(told.pings.gaps)
    if len(gaps):
        series.append(Series("no reply", _MARK, left_at(gaps, seq, at_s), np.zeros(len(gaps))))
    yield Panel(
        title="round trips",
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
