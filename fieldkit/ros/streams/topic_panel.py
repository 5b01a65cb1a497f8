"""The delays and losses of a topic over time, as a panel of the time line of an attempt."""

import math
from collections.abc import Iterator
from typing import Final

import numpy as np

from fieldkit.core.units import format_count
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.report.attempt_timing import TIME_LABEL, AttemptTimes
from fieldkit.report.charts import Panel, Series
from fieldkit.report.theme import Style
from fieldkit.ros.streams import topic_samples
from fieldkit.steps.base import Step

MAX_SAMPLES: Final = 1500
"""Maximum number of samples of each kind in a panel; if there are more, every k-th sample is drawn."""
_RECEIVED: Final = Style("green", "^", "none")
_LOST: Final = Style("lost", "x", "none")


def panels(step: Step, evidence: AttemptEvidence, times: AttemptTimes, zero_ns: int) -> Iterator[Panel]:
    """Yield a panel with the delays of received samples, and with lost samples, by the time of sending.

    Each delay is shown relative to the delay of the fastest sample. Nothing is yielded if a log cannot be read or
    nothing was sent. See `DrawsPanels.panels`.
    """
    logs = {
        role: evidence.read_or_none(topic_samples.read_log, step.prefixed_name(f"{role}-topic.bin"))
        for verb in ("publish", "subscribe")
        for role, job in times.jobs
        if job == step.prefixed_name(verb)
    }
    readable_logs = [log for log in logs.values() if log]
    if len(readable_logs) != 2:
        return
    publisher, _ = logs
    sent_samples, received_samples = (log.samples for log in readable_logs)
    if not len(sent_samples.sequence):
        return
    is_lost = ~np.isin(sent_samples.sequence, received_samples.sequence)
    lost_s = (sent_samples.at_ns[is_lost] - times.clock_offset_ns[publisher] - zero_ns) / 1e9
    # The times of sending and arrival are from two clocks, so only differences between the delays are meaningful.
    delay_ms = (received_samples.at_ns - received_samples.sent_ns) / 1e6
    excess_ms = delay_ms - delay_ms.min(initial=math.inf) if len(delay_ms) else delay_ms
    received_s = (received_samples.sent_ns - times.clock_offset_ns[publisher] - zero_ns) / 1e9
    kinds = (
        ("sample received", _RECEIVED, received_s, excess_ms),
        ("sample lost", _LOST, lost_s, np.zeros(len(lost_s))),
    )
    series = []
    for label, style, at_s, heights in kinds:
        every_kth = slice(None, None, max(1, -(-len(at_s) // MAX_SAMPLES)))
        series.append(Series(label, style, at_s[every_kth], heights[every_kth]))
    yield Panel(
        title=f"delay of {step.name or 'the topic'} beyond its fastest sample",
        x_label=TIME_LABEL,
        y_label="[ms]",
        series=series,
        description=(
            f"{format_count(len(sent_samples.sequence), 'sample')} sent, {int(is_lost.sum())} lost, "
            f"{len(received_samples.sequence)} received"
        ),
        top=None if len(excess_ms) else 1.0,  # without delays the y axis has no automatic end
    )
