"""Evidence of a topic: the logs of its ends and the captures around it, and the contradictions between them."""

from collections.abc import Iterator, Mapping
from typing import Final

from fieldkit.core.columns import Measured
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Role
from fieldkit.core.units import format_count
from fieldkit.measure.checks import topic_captures, topic_checks
from fieldkit.measure.checks.topic_captures import Captured
from fieldkit.measure.checks.topic_checks import TopicPlan
from fieldkit.measure.transfers import sample_heads, topic_log
from fieldkit.measure.transfers.sample_heads import SampleFlow
from fieldkit.measure.transfers.topic_log import TopicLog
from fieldkit.measure.transfers.topics import first_arrivals
from fieldkit.ros.qos import History, Reliability
from fieldkit.steps.middlewares import Over
from fieldkit.steps.streams import StreamOptions
from fieldkit.steps.view import View, capture_around

_ENVELOPE_BYTES: Final = 12
_CDR_BYTES: Final = 16
_ROS1_QUEUE: Final = 1000
"""Samples that the agent has ROS 1 keep if the history keeps all (`fieldkit.agent.ros1`)."""
_LATE_S: Final = 0.1
"""A discovery is withheld if the first sample came this much later after it than the publisher waits."""


def plan(step: StreamOptions) -> TopicPlan:
    """Return what a step asks of its topic."""
    quality = step.qos.resolved()
    keeps_last = quality.history is not History.KEEP_ALL and quality.depth > 0
    depth = quality.depth if keeps_last else _ROS1_QUEUE if step.over is Over.ROS1 else None
    return TopicPlan(
        topic=step.topic,
        samples=round(step.duration * step.rate),
        size_bytes=round(step.bytes),
        envelope_bytes=_ENVELOPE_BYTES if step.over is Over.ROS1 else _CDR_BYTES,
        reliable=step.over in {Over.ROS1, Over.ZENOH} or quality.reliability is not Reliability.BEST_EFFORT,
        # Zenoh hands samples to its callback without a queue of its own.
        depth=None if step.over is Over.ZENOH else depth,
        in_order=step.over in {Over.DDS, Over.ROS1},
        on_ports=step.over is not Over.ROS2,
    )


def problems(step: StreamOptions, view: View, logs: Mapping[Role, TopicLog]) -> Iterator[str]:
    """Yield the contradictions between the logs of both ends, the procedure, the attempt and the captures.

    Args:
        step: The topic.
        view: The attempt.
        logs: Whole logs by role.
    """
    yield from topic_checks.of_window(logs, {role: view.attempt_window(role) for role in logs})
    if {step.sender, step.receiver} <= logs.keys():
        sent, came = logs[step.sender], logs[step.receiver]
        wanted = plan(step)
        reasons = list(topic_checks.of_logs(wanted, sent, came))
        yield from reasons
        # The same cause makes many contradictions with the captures, too.
        if not reasons:
            yield from topic_captures.of_captures(wanted, sent, came, captured(step, view))


def captured(step: StreamOptions, view: View) -> Captured:
    """Return the topic in the captures of both ends."""
    near, far = (_flow(step, view, role) for role in (step.sender, step.receiver))
    complete = near is not None and far is not None and topic_captures.is_complete(near, far)
    return Captured(near, far, complete)


def dropped(step: StreamOptions, view: View) -> str:
    """Return why columns that depend on the captures are withheld; empty if no packet was dropped before tcpdump."""
    counts = {role: view.dropped(role) for role in (step.sender, step.receiver)}
    return " and ".join(
        f"the capture of {role} lacks {format_count(count, 'packet')} that its kernel dropped"
        for role, count in counts.items()
        if count
    )


def _flow(step: StreamOptions, view: View, role: Role) -> SampleFlow | None:
    """Return the topic in the capture of one of its ends; None without a whole capture."""
    name = capture_around(view.within, role)
    capture = view.capture(role)
    if name is None or capture is None:
        return None
    found = view.evidence.read(sample_heads.find, name, round(step.bytes))
    address = view.scene.robot(role).address
    publishes = role == step.sender
    return sample_heads.flow(
        capture.packets,
        found,
        step.wire.data,
        round(step.bytes),
        lambda packets: packets.are_from(address) if publishes else ~packets.are_from(address),
    )


def checked(step: StreamOptions, view: View, logs: Mapping[Role, TopicLog], measured: Measured) -> Measured:
    """Return what was measured without the figures of time that the captures do not confirm."""
    if not {step.sender, step.receiver} <= logs.keys():
        return measured
    sent, arrived = logs[step.sender], first_arrivals(logs[step.receiver])
    reasons = topic_captures.withheld(
        measured.values, arrived, captured(step, view), reliable=plan(step).reliable, deadline_s=step.qos.deadline
    )
    if sent.matched_ns is not None and len(sent.samples):
        late_s = (int(sent.samples.sent_ns[0]) - sent.matched_ns - topic_checks.SETTLES_NS) / 1e9
        if late_s > _LATE_S:
            reasons["topic_discovery_s"] = f"the first sample was sent {late_s:.3f} s too late after the discovery"
    return measured.without(reasons)


def read(step: StreamOptions, view: View, files: Mapping[Role, str]) -> tuple[dict[Role, TopicLog], list[str]]:
    """Return the whole logs by role, and what is wrong with the others, a sentence each."""
    logs, wrong = dict[Role, TopicLog](), list[str]()
    for role, name in files.items():
        try:
            log = view.evidence.read(topic_log.read, name)
        except EvidenceError as error:
            wrong.append(f"{name}: {error.what}")
            continue
        if not log.whole:
            wrong.append(f"{name} has no end: the agent was ended")
        else:
            logs[role] = log
        if log.foreign:
            wrong.append(f"{name}: somebody else publishes {step.topic}, too: take another topic or domain")
    return logs, wrong
