"""The time line of one attempt: bars of steps, faults and moves, then flows, pings, radios and distance."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fieldkit.core.columns import step_prefixed
from fieldkit.core.model import Protocol, Role
from fieldkit.core.units import format_count
from fieldkit.measure.evidence import ping
from fieldkit.measure.transfers.fates import Fates
from fieldkit.measure.transfers.transfer_spec import Transfer
from fieldkit.report import attempt_timing
from fieldkit.report.attempt_timing import AttemptTimes
from fieldkit.report.charts import Chart, Panel, Series, Span
from fieldkit.report.theme import Style
from fieldkit.report.trial_folders import Evidence

MAX_PACKETS: Final = 1500
"""Maximum number of packets of each kind in a panel. If there are more, every k-th is drawn."""

_MARK_WORDS: Final = {Protocol.UDP: "lost", Protocol.TCP: "retransmitted"}
_SENT_STYLE: Final = Style("blue", "o", "none")
_RECEIVED_STYLE: Final = Style("green", "^", "none")
_MARK_STYLE: Final = Style("lost", "x", "none")
_ROUND_TRIP_STYLE: Final = Style("pink", "D", "none")
_DISTANCE_STYLE: Final = Style("orange", line="solid")
_LINK_STYLES: Final = (Style("blue", line="solid"), Style("green", line="dashed"))
"""Styles of the sending robot and of the other robot."""
_DEFAULT_PING_INTERVAL_S: Final = 1.0
_MIN_BAR_SHARE: Final = 0.004
"""Minimum length of a bar, as a share of the axis; a shorter one would be invisible."""
_TIME_LABEL: Final = "time [s]"
_MARGIN_SHARE: Final = 0.01
"""Margin at the right end of the axis, as a share of the axis."""


def charts(row: int, data: Evidence) -> Iterator[Chart]:
    """Yield the time line of the attempt in a row, and a chart of its packets if it has transfers.

    Yield nothing if the evidence of the attempt is not available, or contains no times.
    """
    evidence, plan = data.attempt(row), data.plan(row)
    if evidence is None or plan is None:
        return
    times = attempt_timing.read(evidence, plan, data.repeats, row)
    if not times.activities:
        return
    zero_ns = times.activities[0].start_ns
    pings = [
        panel for name, role, output in times.pings for panel in _round_trips(name, role, output, times, zero_ns)
    ]
    stops_s = [(activity.stop_ns - zero_ns) / 1e9 for activity in times.activities]
    stops_s += [float(np.max(series.x)) for panel in pings for series in panel.series if len(series.x)]
    panels = [
        _bars(times, zero_ns),
        *attempt_timing.flow_panels(evidence, plan, times, zero_ns),
        *pings,
        *_links(times, zero_ns),
        *_distance(times, zero_ns),
    ]
    reason = data.repeats.texts["reason"][row]
    outcome = ": ".join(filter(None, (data.repeats.texts["status"][row], reason)))
    name = evidence.folder.name
    yield Chart(
        name="timeline",
        title=f"Time line of {name}",
        caption=f"Trial {plan.trial}, {outcome}. {times.clock_note}",
        panels=_stack(panels, max(stops_s)),
        is_stacked=True,
    )
    if times.transfers:
        yield Chart(
            name="packets",
            title=f"Packets of {name}",
            caption="Offset of each packet in the payload over time, at both ends: an enlarged part of the time "
            "line.",
            panels=[_packets(transfer, fates, zero_ns) for transfer, fates in times.transfers],
        )


def _stack(panels: Sequence[Panel], end_s: float) -> list[Panel]:
    """Return panels with a shared time axis, which has a label in the lowest panel.

    Points outside of the axis are removed; those of step functions are moved to its nearest end.
    """
    last_index, right_s = len(panels) - 1, (1 + _MARGIN_SHARE) * end_s or 1.0
    return [
        replace(
            panel,
            is_strip=True,
            left=0.0,
            right=right_s,
            x_label=_TIME_LABEL if index == last_index else "",
            series=[_clip_series(series, right_s) for series in panel.series],
        )
        for index, panel in enumerate(panels)
    ]


def _clip_series(series: Series, right_s: float) -> Series:
    """Return a series without the points outside of the time axis; those of a step function are moved to its end."""
    x, y = (np.asarray(values, dtype=np.float64) for values in (series.x, series.y))
    if series.join == "steps":  # a value holds until the next one, so an early value applies from the start
        x = np.clip(x, 0.0, right_s)
        return replace(series, x=x, y=y)
    is_shown = (x >= 0) & (x <= right_s)
    return replace(series, x=x[is_shown], y=y[is_shown])


def _bars(times: AttemptTimes, zero_ns: int) -> Panel:
    """Return a panel with a lane per activity name, the first at the top."""
    names = list(dict.fromkeys(activity.name for activity in times.activities))
    last_index = len(names) - 1
    spans = [
        (activity, (activity.start_ns - zero_ns) / 1e9, (activity.stop_ns - zero_ns) / 1e9)
        for activity in times.activities
    ]
    min_length_s = _MIN_BAR_SHARE * max(stop for *_, stop in spans)
    return Panel(
        title="activities",
        x_label=_TIME_LABEL,
        y_label="",
        series=[],
        description="; ".join(f"{activity.name} from {start:.3f} to {stop:.3f} s" for activity, start, stop in spans),
        spans=[
            Span(last_index - names.index(activity.name), start, max(stop, start + min_length_s), activity.colour)
            for activity, start, stop in spans
        ],
        lanes=list(reversed(names)),
    )


def _packets(transfer: Transfer, fates: Fates, zero_ns: int) -> Panel:
    """Return the offset of each packet in the payload over time, at both ends."""
    first_sent_ns = int(fates.sent_ns.min())
    marked_text = _MARK_WORDS[transfer.protocol]
    kinds = (
        (
            "sent",
            _SENT_STYLE,
            fates.sent_ns[~fates.lost_or_repeated],
            fates.sent_offset_bytes[~fates.lost_or_repeated],
        ),
        ("received", _RECEIVED_STYLE, fates.received_ns, fates.received_offset_bytes),
        (
            marked_text,
            _MARK_STYLE,
            fates.sent_ns[fates.lost_or_repeated],
            fates.sent_offset_bytes[fates.lost_or_repeated],
        ),
    )
    series = []
    for label, style, at_ns, at_bytes in kinds:
        every_kth = slice(None, None, max(1, math.ceil(len(at_ns) / MAX_PACKETS)))
        series.append(Series(label, style, (at_ns[every_kth] - first_sent_ns) / 1e6, at_bytes[every_kth] / 1e3))
    return Panel(
        title=f"packets of {transfer.name or 'the transfer'}",
        x_label=f"time [ms] after {(first_sent_ns - zero_ns) / 1e9:.3f} s",
        y_label="offset in the payload [kB]",
        series=series,
        description=f"{format_count(len(fates.sent_ns), 'packet')} sent, {fates.lost_or_repeated.sum()} of them "
        f"{marked_text}, {len(fates.received_ns)} received",
    )


def _round_trips(name: str, role: Role, output: ping.Ping, times: AttemptTimes, zero_ns: int) -> Iterator[Panel]:
    """Yield a panel of round-trip times and of requests without a reply.

    Round-trip times are placed at the times of the replies. Requests without a reply are placed at estimated times;
    nothing is yielded if these times are unknown, or if there is neither a reply nor a request without one.
    """
    clock_offset_ns = times.clock_offset_ns[role]
    answered_requests = [
        (reply.seq, reply.at_utc_ns - clock_offset_ns - zero_ns, reply.rtt_s)
        for reply in output.answers
        if reply.at_utc_ns is not None and reply.rtt_s is not None
    ]
    lost_numbers = np.array(output.unanswered_seqs)
    seq, at_ns, rtt_s = np.array(answered_requests).T if answered_requests else np.empty((3, 0))
    series = [Series("round trip", _ROUND_TRIP_STYLE, at_ns / 1e9, 1e3 * rtt_s)]
    if len(lost_numbers):
        lost_s = (
            estimate_send_times(lost_numbers, seq, at_ns / 1e9)
            if answered_requests
            else _spread_over_job(lost_numbers, name, role, times, zero_ns)
        )
        if lost_s is None:
            return
        series.append(Series("no reply", _MARK_STYLE, np.maximum(lost_s, 0.0), np.zeros(len(lost_numbers))))
    elif not answered_requests:
        return
    median_text = f", median {1e3 * np.median(rtt_s):.2f} ms" if answered_requests else ""
    yield Panel(
        title=f"round trips of {name}" if name else "round trips",
        x_label=_TIME_LABEL,
        y_label="RTT [ms]",
        series=series,
        description=f"{format_count(len(answered_requests), 'round trip')}{median_text}; {len(lost_numbers)} without "
        "a reply",
        top=None if answered_requests else 1.0,
    )


def _spread_over_job(
    lost_numbers: NDArray[np.int64], name: str, role: Role, times: AttemptTimes, zero_ns: int
) -> NDArray[np.float64] | None:
    """Return approximate send times of requests if none was answered, evenly over the job; None without its times."""
    if (span := times.jobs.get((role, step_prefixed(name, "ping")))) is None:
        return None
    start_s, stop_s = ((at_ns - zero_ns) / 1e9 for at_ns in span)
    at_s: NDArray[np.float64] = start_s + (stop_s - start_s) * (lost_numbers - lost_numbers.min()) / len(lost_numbers)
    return at_s


def estimate_send_times(
    lost_numbers: NDArray[np.int64], answered_numbers: NDArray[np.float64], at_s: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return approximate send times of requests without a reply, interpolated by sequence number.

    Before the first and after the last answered request, the mean interval is used, or 1 s if only one was answered.
    The times are those of replies, so they are later than the true ones by about a round-trip time.

    Args:
        lost_numbers: Sequence numbers of the requests without a reply.
        answered_numbers: Sequence numbers of answered requests, ascending.
        at_s: Times of the replies to the answered requests.
    """
    step_s = (
        (at_s[-1] - at_s[0]) / (answered_numbers[-1] - answered_numbers[0])
        if len(answered_numbers) > 1
        else _DEFAULT_PING_INTERVAL_S
    )
    interpolated: NDArray[np.float64] = np.interp(lost_numbers, answered_numbers, at_s)
    steps_outside: NDArray[np.float64] = np.minimum(lost_numbers - answered_numbers[0], 0) + np.maximum(
        lost_numbers - answered_numbers[-1], 0
    )
    return interpolated + step_s * steps_outside


def _links(times: AttemptTimes, zero_ns: int) -> Iterator[Panel]:
    """Yield a panel each for the signal, the PHY rate and the SINR of both radios over time.

    Values of telemetry sources replace the values of `iw`, as in the columns (`telemetry_columns`).
    """
    signals: dict[Role, Sequence[tuple[int, float | None]]] = {}
    rates: dict[Role, Sequence[tuple[int, float | None]]] = {}
    ratios: dict[Role, Sequence[tuple[int, float | None]]] = {}
    for role, history in times.links.items():
        telemetry = times.telemetry.get(role, {})
        signals[role] = telemetry.get("signal_dbm", [(at_ns, sample.signal_dbm) for at_ns, sample in history])
        rates_bit_s = telemetry.get("tx_rate_bit_s", [(at_ns, sample.tx_rate_bit_s) for at_ns, sample in history])
        rates[role] = [(at_ns, rate_bit_s and rate_bit_s / 1e6) for at_ns, rate_bit_s in rates_bit_s]
        ratios[role] = telemetry.get("sinr_db", ())
    yield from _radio_panel("signal", "[dBm]", signals, zero_ns, bottom=None)
    yield from _radio_panel("PHY rate", "[Mbit/s]", rates, zero_ns, bottom=0.0)
    yield from _radio_panel("SINR", "[dB]", ratios, zero_ns, bottom=None)


def _radio_panel(
    what: str,
    y_label: str,
    values: Mapping[Role, Sequence[tuple[int, float | None]]],
    zero_ns: int,
    *,
    bottom: float | None,
) -> Iterator[Panel]:
    """Yield a panel of one quantity of both radios over time, the sending radio first, if any radio has values."""
    series, ranges = [], []
    for (role, samples), style in zip(values.items(), _LINK_STYLES, strict=True):
        points = [((at_ns - zero_ns) / 1e9, value) for at_ns, value in samples if value is not None]
        if points:
            at_s, heights = zip(*points, strict=True)
            series.append(Series(role, style, at_s, heights))
            ranges.append(f"{role} {min(heights):g} to {max(heights):g}")
    if series:
        yield Panel(
            title=f"{what} of the radios",
            x_label=_TIME_LABEL,
            y_label=y_label,
            series=series,
            description=f"{what} {y_label}: {', '.join(ranges)}",
            bottom=bottom,
        )


def _distance(times: AttemptTimes, zero_ns: int) -> Iterator[Panel]:
    """Yield a panel of the distance between sender and receiver over time, if it changed."""
    changes = [(max(utc_ns - zero_ns, 0) / 1e9, metres) for utc_ns, metres in times.distances_m]
    known_distances_m = [metres for _, metres in changes if metres is not None]
    if len(set(known_distances_m)) < 2:
        return
    at_s, distance_m = zip(*((at, math.nan if metres is None else metres) for at, metres in changes), strict=True)
    yield Panel(
        title="distance between sender and receiver",
        x_label=_TIME_LABEL,
        y_label="[m]",
        series=[Series("distance", _DISTANCE_STYLE, at_s, distance_m, join="steps")],
        description=f"{min(known_distances_m):.1f} to {max(known_distances_m):.1f} m",
    )
