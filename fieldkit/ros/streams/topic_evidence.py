"""Evidence of a topic: the logs of publisher and subscriber, the captures, and contradictions between them."""

from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Final

from fieldkit.core.columns import Measured
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Role
from fieldkit.core.units import format_count
from fieldkit.ros.interfaces.qos import History, Reliability
from fieldkit.ros.middlewares.middleware import MiddlewareName
from fieldkit.ros.streams import read_checks, topic_captures, topic_checks, topic_samples
from fieldkit.ros.streams.stream_options import StreamOptions
from fieldkit.ros.streams.topic_captures import CapturedTopic
from fieldkit.ros.streams.topic_checks import TopicPlan
from fieldkit.ros.streams.topic_columns import first_arrivals
from fieldkit.ros.streams.topic_samples import SampleFlow, TopicLog
from fieldkit.steps.view import View, capture_around

_ENVELOPE_BYTES: Final = MappingProxyType(
    {(False, True): 12, (False, False): 16, (True, True): 48, (True, False): 52}
)
"""Bytes that serialization adds to the data. The first element of a key is True for images, the second is True for
the serialization of ROS 1 and False for CDR."""
_ROS1_QUEUE_SIZE: Final = 1000
"""Queue size in samples that the agent sets in ROS 1 for the history `keep_all` (`fieldkit.agent.messaging.ros1`)."""
_MAX_START_DELAY_S: Final = 0.1
"""If the first sample is sent more than this time after the end of the publisher's wait, which follows the discovery,
the column of the discovery time is empty."""


def plan(step: StreamOptions) -> TopicPlan:
    """Return the plan of a step's topic, with which its logs are compared."""
    quality = step.qos.resolved()
    keeps_last = quality.history is not History.KEEP_ALL and quality.depth > 0
    depth = quality.depth if keeps_last else _ROS1_QUEUE_SIZE if step.over is MiddlewareName.ROS1 else None
    return TopicPlan(
        topic=step.topic,
        samples=round(step.duration * step.rate),
        size_bytes=step.size_bytes,
        envelope_bytes=_ENVELOPE_BYTES[bool(step.image), step.over is MiddlewareName.ROS1],
        reliable=step.over in {MiddlewareName.ROS1, MiddlewareName.ZENOH}
        or quality.reliability is not Reliability.BEST_EFFORT,
        # Zenoh passes samples to the callback without a queue.
        depth=None if step.over is MiddlewareName.ZENOH else depth,
        in_order=step.over in {MiddlewareName.DDS, MiddlewareName.ROS1},
        uses_expected_ports=step.over is not MiddlewareName.ROS2,
    )


def problems(step: StreamOptions, view: View, logs: Mapping[Role, TopicLog]) -> Iterator[str]:
    """Yield the contradictions between the logs of both ends, the procedure, the attempt and the captures.

    Args:
        step: The topic.
        view: The attempt.
        logs: Complete logs by role.
    """
    yield from topic_checks.check_times(logs, {role: view.attempt_window(role) for role in logs})
    if {step.sender, step.receiver} <= logs.keys():
        ends = logs[step.sender], logs[step.receiver]
        topic_plan = plan(step)
        reasons = [*topic_checks.check_logs(topic_plan, *ends), *read_checks.check_reads(ends[1])]
        yield from reasons
        # The same cause would also lead to contradictions with the captures.
        if not reasons:
            yield from topic_captures.check_captures(topic_plan, *ends, captured_topic(step, view))


def captured_topic(step: StreamOptions, view: View) -> CapturedTopic:
    """Return the samples of the topic in the captures of sender and receiver."""
    publisher, subscriber = (_flow(step, view, role) for role in (step.sender, step.receiver))
    complete = publisher is not None and subscriber is not None and topic_captures.is_complete(publisher, subscriber)
    return CapturedTopic(publisher, subscriber, complete)


def dropped_reason(step: StreamOptions, view: View) -> str:
    """Return the reason why columns that need captures are empty; an empty string if the kernel dropped no packet."""
    counts = {role: view.dropped_packets(role) for role in (step.sender, step.receiver)}
    return " and ".join(
        f"the capture of {role} lacks {format_count(count, 'packet')} that its kernel dropped"
        for role, count in counts.items()
        if count
    )


def _flow(step: StreamOptions, view: View, role: Role) -> SampleFlow | None:
    """Return the samples of the topic in the capture of a robot; None without a complete capture."""
    name = capture_around(view.within, role)
    capture = view.capture(role)
    if name is None or capture is None:
        return None
    heads = view.evidence.read(topic_samples.find_heads, name, step.size_bytes, step.width)
    address = view.scene.robot(role).address
    publishes = role == step.sender
    return topic_samples.sample_flow(
        capture.packets,
        heads,
        step.wire_ports.data,
        step.size_bytes,
        lambda packets: packets.are_from(address) if publishes else ~packets.are_from(address),
        width=step.width,
    )


def without_contradicted_times(
    step: StreamOptions, view: View, logs: Mapping[Role, TopicLog], measured: Measured
) -> Measured:
    """Return the measurements without times that the captures contradict, or without a wrong discovery time."""
    if not {step.sender, step.receiver} <= logs.keys():
        return measured
    publisher_log, arrivals = logs[step.sender], first_arrivals(logs[step.receiver])
    reasons = topic_captures.withheld_columns(
        measured.values,
        arrivals,
        captured_topic(step, view),
        reliable=plan(step).reliable,
        deadline_s=step.qos.deadline,
    )
    if publisher_log.matched_ns is not None and len(publisher_log.samples):
        late_s = (int(publisher_log.samples.sent_ns[0]) - publisher_log.matched_ns - topic_checks.SETTLING_NS) / 1e9
        if late_s > _MAX_START_DELAY_S:
            reasons["topic_discovery_s"] = f"the first sample was sent {late_s:.3f} s too late after the discovery"
    return measured.without(reasons)


def read(step: StreamOptions, view: View, files: Mapping[Role, str]) -> tuple[dict[Role, TopicLog], list[str]]:
    """Return the complete logs by role, and error messages.

    There is a message for each log that is incomplete or unreadable, and for each log with samples of other programs.
    """
    logs, errors = read_logs(view, files)
    for name in files.values():
        log = view.evidence.read_or_none(topic_samples.read_log, name)
        if log is not None and log.foreign:
            errors.append(f"{name}: another program also publishes {step.topic}: use another topic or domain")
    return logs, errors


def read_logs(view: View, files: Mapping[Role, str]) -> tuple[dict[Role, TopicLog], list[str]]:
    """Return the complete logs by role, and an error message for each log that is incomplete or unreadable."""
    logs, errors = dict[Role, TopicLog](), list[str]()
    for role, name in files.items():
        try:
            log = view.evidence.read(topic_samples.read_log, name)
        except EvidenceError as error:
            errors.append(f"{name}: {error.what}")
            continue
        if not log.is_complete:
            errors.append(f"{name} is incomplete: the agent was stopped")
        else:
            logs[role] = log
    return logs, errors
