"""Flows over time in one attempt: the rate of iperf3, the samples of topics, the payload of transfers."""

import math
from collections.abc import Iterator
from typing import Final

import numpy as np

from fieldkit.core.model import Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.evidence import iperf3
from fieldkit.measure.transfers import topic_log
from fieldkit.report.charts import Panel, Series
from fieldkit.report.moments import Moments
from fieldkit.report.theme import Style
from fieldkit.trial.plan import Plan
from fieldkit.trial.procedure import PlacedStep

MOST_SAMPLES: Final = 1500
"""Most samples of each kind in a panel; of more samples, every k-th is drawn."""
_TIME: Final = "time [s]"
_ENDS: Final = (Style("blue", line="solid"), Style("green", line="dashed"))
_RECEIVED: Final = Style("green", "^", "none")
_LOST: Final = Style("lost", "x", "none")


def panels(evidence: AttemptEvidence, plan: Plan, times: Moments, zero_ns: int) -> Iterator[Panel]:
    """Yield a panel for each test of iperf3 and each topic whose evidence has times.

    Args:
        evidence: Evidence of the attempt.
        plan: Plan of its trial.
        times: Times of the attempt.
        zero_ns: Start of the time axis, in nanoseconds since 1970 UTC.
    """
    for placed in plan.procedure.walk():
        if placed.kind == "iperf3":
            yield from _iperf3(placed, evidence, times, zero_ns)
        elif placed.kind == "topics":
            yield from _topic(placed, evidence, times, zero_ns)


def _iperf3(placed: PlacedStep, evidence: AttemptEvidence, times: Moments, zero_ns: int) -> Iterator[Panel]:
    """Yield the payload rate that each end counted per second. The first second starts with the client."""
    step = placed.step
    client = next((span for (_, job), span in times.jobs.items() if job == step.prefixed_name("iperf3-client")), None)
    if client is None:
        return
    start_s = (client[0] - zero_ns) / 1e9
    series, words = [], []
    for role, style in zip((Role.SENDER, Role.RECEIVER), _ENDS, strict=True):
        test = evidence.read_or_none(iperf3.read, step.prefixed_name(iperf3.json_file(role)))
        if test and test.intervals:
            at_s = start_s + np.cumsum([0.0, *(interval.lasted_s for interval in test.intervals)])
            rates = [interval.bit_s / 1e6 for interval in test.intervals]
            series.append(Series(role, style, at_s, [*rates, rates[-1]], join="steps"))
            words.append(f"{role} {min(rates):.2f} to {max(rates):.2f}")
    if series:
        yield Panel(
            title=f"payload of {step.prefixed_name('iperf3')}",
            x_label=_TIME,
            y_label="[Mbit/s]",
            series=series,
            words=f"Mbit/s of payload each second: {', '.join(words)}",
        )


def _topic(placed: PlacedStep, evidence: AttemptEvidence, times: Moments, zero_ns: int) -> Iterator[Panel]:
    """Yield the delays of received samples, and the lost samples, by the time of sending."""
    step = placed.step
    logs = {
        role: evidence.read_or_none(topic_log.read, step.prefixed_name(f"{role}-topic.bin"))
        for verb in ("publish", "subscribe")
        for role, job in times.jobs
        if job == step.prefixed_name(verb)
    }
    complete = [log for log in logs.values() if log]
    if len(complete) != 2:
        return
    publisher, _ = logs
    sent, received = (log.samples for log in complete)
    if not len(sent.sequence):
        return
    is_lost = ~np.isin(sent.sequence, received.sequence)
    lost_s = (sent.at_ns[is_lost] - times.ahead_ns[publisher] - zero_ns) / 1e9
    took_ms = (
        received.at_ns - received.sent_ns
    ) / 1e6  # measured with two clocks, so only differences are meaningful
    excess_ms = took_ms - took_ms.min(initial=math.inf) if len(took_ms) else took_ms
    received_s = (received.sent_ns - times.ahead_ns[publisher] - zero_ns) / 1e9
    kinds = (
        ("sample received", _RECEIVED, received_s, excess_ms),
        ("sample lost", _LOST, lost_s, np.zeros(len(lost_s))),
    )
    series = []
    for label, style, at_s, heights in kinds:
        every_kth = slice(None, None, max(1, -(-len(at_s) // MOST_SAMPLES)))
        series.append(Series(label, style, at_s[every_kth], heights[every_kth]))
    yield Panel(
        title=f"delay of {step.name or 'the topic'} beyond its fastest sample",
        x_label=_TIME,
        y_label="[ms]",
        series=series,
        words=f"{len(sent.sequence)} samples sent, {int(is_lost.sum())} lost, {len(received.sequence)} received",
        top=None if len(excess_ms) else 1.0,
    )
