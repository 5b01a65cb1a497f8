"""The time line of one repeat on one axis: bars of steps, faults and moves, then flows, pings, radios, distance."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fieldkit.core.columns import prefixed
from fieldkit.core.model import Protocol, Role
from fieldkit.measure.evidence import ping
from fieldkit.measure.transfers.fates import Fates
from fieldkit.measure.transfers.transfer import Transfer
from fieldkit.report import flows, moments
from fieldkit.report.charts import Chart, Panel, Series, Span
from fieldkit.report.evidence import Evidence
from fieldkit.report.moments import Moments
from fieldkit.report.theme import Style

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
_TIME: Final = "time [s]"
_ROOM: Final = 0.01
"""Of the axis, at its right end."""


def charts(row: int, found: Evidence) -> Iterator[Chart]:
    """Yield the time line of the attempt in a row whose evidence is at hand, and its packets one by one.

    There is none if nothing of the evidence has times.
    """
    evidence, plan = found.attempt(row), found.plan(row)
    if evidence is None or plan is None:
        return
    known = moments.read(evidence, plan, found.repeats, row)
    if not known.happenings:
        return
    zero_ns = known.happenings[0].start_ns
    pings = [panel for name, role, said in known.pings for panel in _round_trips(name, role, said, known, zero_ns)]
    ends_s = [(each.stop_ns - zero_ns) / 1e9 for each in known.happenings]
    ends_s += [float(np.max(series.x)) for panel in pings for series in panel.series if len(series.x)]
    strips = [
        _bars(known, zero_ns),
        *flows.panels(evidence, plan, known, zero_ns),
        *pings,
        *_links(known, zero_ns),
        *_distance(known, zero_ns),
    ]
    reason = found.repeats.texts["reason"][row]
    ended = ": ".join(filter(None, (found.repeats.texts["status"][row], reason)))
    name = evidence.folder.name
    yield Chart(
        name="timeline",
        title=f"Time line of {name}",
        caption=f"Trial {plan.trial}, {ended}. {known.clocks}",
        panels=_stacked(strips, max(ends_s)),
        is_stacked=True,
    )
    if known.transfers:
        yield Chart(
            name="packets",
            title=f"Packets of {name}",
            caption="Where in the payload each packet begins, at both ends: a part of the time line, drawn larger.",
            panels=[_packets(transfer, one, zero_ns) for transfer, one in known.transfers],
        )


def _stacked(strips: Sequence[Panel], end_s: float) -> list[Panel]:
    """Return panels with one time axis, which the lowest names; what lies outside of it is left out."""
    last, right_s = len(strips) - 1, (1 + _ROOM) * end_s or 1.0
    return [
        replace(
            panel,
            is_strip=True,
            left=0.0,
            right=right_s,
            x_label=_TIME if index == last else "",
            series=[_within(series, right_s) for series in panel.series],
        )
        for index, panel in enumerate(strips)
    ]


def _within(series: Series, right_s: float) -> Series:
    """Return the points of a series from 0 to the end of the time axis."""
    x, y = (np.asarray(values, dtype=np.float64) for values in (series.x, series.y))
    if series.join == "steps":  # a value holds until the next one, and from before the beginning
        x = np.clip(x, 0.0, right_s)
        return replace(series, x=x, y=y)
    is_shown = (x >= 0) & (x <= right_s)
    return replace(series, x=x[is_shown], y=y[is_shown])


def _bars(known: Moments, zero_ns: int) -> Panel:
    """Return a lane for each thing that went on, the first on top; things of one name share it."""
    names = list(dict.fromkeys(each.name for each in known.happenings))
    last = len(names) - 1
    spans = [(each, (each.start_ns - zero_ns) / 1e9, (each.stop_ns - zero_ns) / 1e9) for each in known.happenings]
    least_s = _LEAST_BAR * max(stop for *_, stop in spans)
    return Panel(
        title="what went on",
        x_label=_TIME,
        y_label="",
        series=[],
        words="; ".join(f"{each.name} from {start:.3f} to {stop:.3f} s" for each, start, stop in spans),
        spans=[
            Span(last - names.index(each.name), start, max(stop, start + least_s), each.colour)
            for each, start, stop in spans
        ],
        lanes=list(reversed(names)),
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


def _round_trips(name: str, role: Role, said: ping.Ping, known: Moments, zero_ns: int) -> Iterator[Panel]:
    """Yield the time that each round trip took, and the requests without a reply, against time."""
    ahead_ns = known.ahead_ns[role]
    answered = [
        (reply.seq, reply.at_utc_ns - ahead_ns - zero_ns, reply.rtt_s)
        for reply in said.answers
        if reply.at_utc_ns is not None and reply.rtt_s is not None
    ]
    lost = np.array(said.gaps)
    seq, at_ns, rtt_s = np.array(answered).T if answered else np.empty((3, 0))
    series = [Series("round trip", _ROUND_TRIP, at_ns / 1e9, 1e3 * rtt_s)]
    if len(lost):
        lost_s = left_at(lost, seq, at_ns / 1e9) if answered else _by_job(lost, name, role, known, zero_ns)
        if lost_s is None:
            return
        series.append(Series("no reply", _MARK, np.maximum(lost_s, 0.0), np.zeros(len(lost))))
    elif not answered:
        return
    middle = f", median {1e3 * np.median(rtt_s):.2f} ms" if answered else ""
    yield Panel(
        title=f"round trips of {name}" if name else "round trips",
        x_label=_TIME,
        y_label="RTT [ms]",
        series=series,
        words=f"{len(answered)} round trips{middle}; {len(lost)} without a reply",
        top=None if answered else 1.0,
    )


def _by_job(
    number: NDArray[np.int64], name: str, role: Role, known: Moments, zero_ns: int
) -> NDArray[np.float64] | None:
    """Return about when requests left if none was answered: evenly while the job ran; None if that is not known."""
    if (span := known.jobs.get((role, prefixed(name, "ping")))) is None:
        return None
    start_s, stop_s = ((at_ns - zero_ns) / 1e9 for at_ns in span)
    at_s: NDArray[np.float64] = start_s + (stop_s - start_s) * (number - number.min()) / len(number)
    return at_s


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


def _links(known: Moments, zero_ns: int) -> Iterator[Panel]:
    """Yield what both radios said of their links, against time: the signal, and the rate that they sent at."""
    signals = {role: [(at_ns, one.signal_dbm) for at_ns, one in link_] for role, link_ in known.links.items()}
    rates = {
        role: [(at_ns, one.tx_rate_bit_s and one.tx_rate_bit_s / 1e6) for at_ns, one in link_]
        for role, link_ in known.links.items()
    }
    yield from _of_radios("signal", "[dBm]", signals, zero_ns, bottom=None)
    yield from _of_radios("PHY rate", "[Mbit/s]", rates, zero_ns, bottom=0.0)


def _of_radios(
    what: str,
    y_label: str,
    values: Mapping[Role, Sequence[tuple[int, float | None]]],
    zero_ns: int,
    *,
    bottom: float | None,
) -> Iterator[Panel]:
    """Yield what each radio said of one thing, against time, if any did; the one that sends comes first."""
    series, words = [], []
    for (role, samples), style in zip(values.items(), _LINKS, strict=True):
        points = [((at_ns - zero_ns) / 1e9, value) for at_ns, value in samples if value is not None]
        if points:
            at_s, heights = zip(*points, strict=True)
            series.append(Series(role, style, at_s, heights))
            words.append(f"{role} {min(heights):g} to {max(heights):g}")
    if series:
        yield Panel(
            title=f"{what} of the radios",
            x_label=_TIME,
            y_label=y_label,
            series=series,
            words=f"{what} {y_label}: {', '.join(words)}",
            bottom=bottom,
        )


def _distance(known: Moments, zero_ns: int) -> Iterator[Panel]:
    """Yield how far sender and receiver were apart, against time, if that changed."""
    changes = [(max(utc_ns - zero_ns, 0) / 1e9, metres) for utc_ns, metres in known.distances_m]
    known_m = [metres for _, metres in changes if metres is not None]
    if len(set(known_m)) < 2:
        return
    at_s, distance_m = zip(*((at, math.nan if metres is None else metres) for at, metres in changes), strict=True)
    yield Panel(
        title="distance between sender and receiver",
        x_label=_TIME,
        y_label="[m]",
        series=[Series("distance", _DISTANCE, at_s, distance_m, join="steps")],
        words=f"{min(known_m):.1f} to {max(known_m):.1f} m",
    )
