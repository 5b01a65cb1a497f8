"""Stream samples of a topic from one robot to another over a middleware, and measure what arrives, and when."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from typing import TYPE_CHECKING, ClassVar, Final, Self

from typing_extensions import override

from fieldkit.backends.protocols import Testbed
from fieldkit.core.columns import Column, Measured, Value
from fieldkit.core.model import Protocol, Role, in_order
from fieldkit.core.threads import together
from fieldkit.measure.checks import topic_sources
from fieldkit.measure.transfers import stalls
from fieldkit.remote import agent, jobs
from fieldkit.remote.command import with_environment
from fieldkit.remote.jobs import Job
from fieldkit.steps import streams
from fieldkit.steps.along import AlongStep
from fieldkit.steps.middlewares import Discovery, Over
from fieldkit.steps.scene import (
    BY_FIELDKIT,
    BY_ITSELF,
    Announce,
    Flow,
    ListeningPort,
    Need,
    Planned,
    Scene,
    fragments,
)
from fieldkit.steps.streams import LONGEST_S, StreamOptions
from fieldkit.steps.view import View

if TYPE_CHECKING:
    from fieldkit.measure.captures.packets import Packets
    from fieldkit.measure.transfers.deliveries import Delivery, FlowSchedule
    from fieldkit.measure.transfers.topic_log import TopicLog
    from fieldkit.measure.transfers.topics import TopicTraffic


MASTER: Final = "rosmaster"
"""ROS's own."""

KEPT_BYTES: Final = 256
"""A capture must show the head of each sample: it ends 138 bytes behind an Ethernet header over DDS, 154 if DDS names
the reader, and at about 190 over Zenoh, whose attachment and key expression come first."""

BUFFER_KIB: Final = 32_768
"""Kernel buffer of a capture around a topic. In immediate mode a frame takes about 400 bytes of it with `KEPT_BYTES`
kept, so 4 MiB hold 10,000 packets. Fast DDS sent 60,000 per second where it asked again for lost fragments."""

_GRACE_S: Final = 5
_ENDS_S: Final = 10.0
"""Starting Python and the middleware, and what the publisher waits at its end."""
_RECORD_BYTES: Final = 32
"""What an end writes down of a sample."""
_ENVELOPE_BYTES: Final = 100
"""About what a middleware and IP add to a sample."""


class TopicsStep(StreamOptions, AlongStep):
    """Streams samples of a topic from one robot to another over a middleware.

    The program is part of fieldkit; both robots need the middleware for Python. See [topics](topics.md), also for the
    columns. Inside a `capture` its traffic is counted, and delays are measured if there are packets in both
    directions. Leaves `ROLE-topic.bin` and `ROLE-topic.log`, and `ROLE-serve.log` of a router or a master.
    """

    cross_checks = (*topic_sources.CROSS_CHECKS, *stalls.cross_checks("topic"))
    kept_bytes = KEPT_BYTES
    capture_buffer_kib = BUFFER_KIB
    needs_complete_capture = False
    flow_kind: ClassVar[str] = "topic"

    @override
    def lasting(self, seconds: float) -> Self:
        return self.model_copy(update={"duration": min(seconds, LONGEST_S)})

    @override
    def jobs(self, scene: Scene) -> Iterator[Planned]:
        if self.serves:
            yield self._serve(scene, self.serves)
        yield self._end(scene, self.receiver, "subscribe")
        yield self._end(scene, self.sender, "publish")

    def _end(self, scene: Scene, role: Role, verb: str) -> Planned:
        robot = scene.robot(role)
        publishes = role == self.sender
        lasts_s = self.patience + self.duration + _ENDS_S
        job = Job(
            folder=scene.folder,
            name=self.own_name(verb),
            argv=streams.agent_command(
                robot, verb, self.told(scene, role), self._file(role), environment=self.environment(robot)
            ),
            # A subscriber never ends before its publisher.
            limit_s=lasts_s if publishes else 2 * lasts_s,
            log=self._log(role),
            ready=None if publishes else "log:up,",
        )
        setup, program = streams.setup(robot), robot.profile.tools.python
        return Planned(role, job, program=program, setup=setup, ends=BY_ITSELF if publishes else BY_FIELDKIT)

    def _serve(self, scene: Scene, role: Role) -> Planned:
        """Return what routes for others, or is ROS's master."""
        robot = scene.robot(role)
        routes = self.way is Discovery.ROUTER
        setup = streams.setup(robot)
        if routes:
            told = streams.compact({"network": self.network(scene, role)})
            argv, program = streams.agent_command(robot, "route", told), robot.profile.tools.python
        else:
            # A master listens where its node is said to be, which setup files often say is the robot itself alone.
            where = {"ROS_IP": robot.address, "ROS_HOSTNAME": robot.address}
            command = (MASTER, "--core", "-p", str(self.served_on))
            argv, program = with_environment(command, setup=setup, environment=where), MASTER
        job = Job(
            folder=scene.folder,
            name=self.own_name("serve"),
            argv=argv,
            limit_s=3 * (self.patience + self.duration + _ENDS_S),
            log=self.own_name(f"{role}-serve.log"),
            ready="log:up," if routes else jobs.bound(Protocol.TCP, self.served_on),
        )
        return Planned(role, job, program=program, setup=setup, ends=BY_FIELDKIT)

    @override
    def prepare(self, scene: Scene, testbed: Testbed) -> Callable[[Announce], None]:
        """The agent is there, and all but the publisher is up."""
        members = in_order(self.members)
        together(lambda role: agent.install(testbed.shells[role]), members)
        *before, publish = self.jobs(scene)
        for planned in before:
            jobs.start(testbed.shells[planned.role], planned.job)
        return partial(self._stream, scene, testbed, before, publish)

    @override
    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        self.prepare(scene, testbed)(announce)

    def _stream(
        self, scene: Scene, testbed: Testbed, before: list[Planned], publish: Planned, announce: Announce
    ) -> None:
        announce("topics", self.expected_s(scene.protocol))
        with ExitStack() as silent:
            for role in self.members:
                silent.enter_context(testbed.shells[role].silence(publish.job.limit_s))
            code = jobs.run(testbed.shells[publish.role], publish.job)
        stopped = [
            (planned, jobs.stop(testbed.shells[planned.role], planned.job, grace_s=_GRACE_S))
            for planned in reversed(before)
        ]
        for planned, left in ((publish, code), *stopped):
            if left != 0:
                raise scene.failure(planned, f"{planned.job.name} ended with exit code {left}")

    @override
    def roles(self) -> frozenset[Role]:
        return self.members

    @override
    def expected_s(self, protocol: Protocol) -> float:
        return self.duration + 3.0

    @override
    def listens(self) -> tuple[ListeningPort, ...]:
        """Each domain has ports of its own."""
        if not self.served_on:  # of DDS, whose participants take the next ports that are free
            return (ListeningPort(self.receiver, min(self.wire.data), self.sender, by="domain", shared=True),)
        listeners = {(self.receiver, self.sender), (self.sender, self.receiver)}
        if self.serves:
            # Clients of a router have none of their own.
            listeners = listeners if self.over is Over.ROS1 else set()
            listeners |= {(self.serves, self.sender if self.serves != self.sender else self.receiver)}
        found = (ListeningPort(role, self.served_on, peer, by="domain") for role, peer in listeners)
        return tuple(sorted(found, key=lambda one: (one.role, one.peer)))

    @override
    def needs(self, scene: Scene) -> Iterator[Need]:
        """The middleware's Python package."""
        # A master needs none of it.
        for role in in_order(self.members - ({self.serves} if self.way is Discovery.MASTER else set())):
            yield self.need(role, scene.robot(role))

    @override
    def exclusive_resources(self) -> tuple[str, ...]:
        return ("topics",)

    @override
    def files(self) -> tuple[str, ...]:
        ends = [name for role in (self.receiver, self.sender) for name in (self._file(role), self._log(role))]
        return (*ends, *([self.own_name(f"{self.serves}-serve.log")] if self.serves else []))

    def _file(self, role: Role) -> str:
        return self.own_name(f"{role}-topic.bin")

    def _log(self, role: Role) -> str:
        return self.own_name(f"{role}-topic.log")

    @override
    def flows(self, scene: Scene) -> Iterator[Flow]:
        frames = 2 * self._samples * fragments(round(self.bytes) + _ENVELOPE_BYTES)
        ends = (self.sender, self.receiver)
        pairs = [ends, *((end, self.serves) for end in ends if self.serves and end != self.serves)]
        for source, destination in dict.fromkeys(pairs):
            for port in sorted(self.wire.data | self.wire.discovery):
                yield Flow(source, destination, port, frames, group=self.wire.group)
                frames = 0.0  # all of them have been counted

    @property
    def _samples(self) -> float:
        return self.rate * self.duration

    @override
    def bytes_left(self, scene: Scene, role: Role) -> float:
        return _RECORD_BYTES * self._samples if role in {self.sender, self.receiver} else 0.0

    @override
    def output_columns(self) -> tuple[Column, ...]:
        """A trial without topics has no columns for them."""
        from fieldkit.measure.transfers import topic_stalls, topics  # noqa: PLC0415 (only where there are any)

        return (*topics.COLUMNS, *topic_stalls.COLUMNS)

    @override
    def check(self, view: View) -> Iterator[str]:
        """Both logs are whole, and agree with each other, the attempt and the captures."""
        from fieldkit.steps import topic_evidence  # noqa: PLC0415 (as above)

        logs, wrong = topic_evidence.read(self, view, self._logs)
        yield from wrong
        yield from topic_evidence.problems(self, view, logs)

    @property
    def _logs(self) -> Mapping[Role, str]:
        return {role: self._file(role) for role in (self.sender, self.receiver)}

    @override
    def measure(self, view: View) -> Measured:
        from fieldkit.measure.transfers import topic_stalls, topics  # noqa: PLC0415 (as above)
        from fieldkit.steps import topic_evidence  # noqa: PLC0415 (as above)

        logs, _ = topic_evidence.read(self, view, self._logs)
        ends = logs.get(self.sender), logs.get(self.receiver)
        flow, captured = self._traffic(view), self._captured(view)
        stalled = topic_stalls.measure(flow, ends, captured, self._expected)
        measured = topics.measure(flow, *ends, *captured) | stalled
        measured = measured.without(topics.without_captures(measured, topic_evidence.dropped(self, view)))
        measured = topic_evidence.checked(self, view, logs, measured)
        return measured | topics.withheld_mark(topic_evidence.dropped(self, view))

    def deliveries(self, view: View) -> "Sequence[Delivery]":
        """See `SendsFlow.deliveries`."""
        from fieldkit.measure.transfers import topic_stalls  # noqa: PLC0415 (as above)

        return topic_stalls.read(self._traffic(view), self._both_logs(view), self._captured(view), self._expected)

    @property
    def destination(self) -> Role:
        """See `SendsFlow.destination`."""
        return self.receiver

    def _traffic(self, view: View) -> "TopicTraffic":
        from fieldkit.measure.transfers import topics  # noqa: PLC0415 (as above)

        return topics.TopicTraffic(
            sender_address=view.scene.robot(self.sender).address,
            receiver_address=view.scene.robot(self.receiver).address,
            data_ports=self.wire.data,
            discovery_ports=self.wire.discovery,
            deadline_s=self.qos.deadline,
        )

    def _both_logs(self, view: View) -> "tuple[TopicLog | None, TopicLog | None]":
        """Return the whole logs of publisher and subscriber."""
        from fieldkit.steps import topic_evidence  # noqa: PLC0415 (as above)

        logs, _ = topic_evidence.read(self, view, self._logs)
        return logs.get(self.sender), logs.get(self.receiver)

    def _captured(self, view: View) -> "tuple[Packets | None, Packets | None]":
        left, arrived = (view.capture(role) for role in (self.sender, self.receiver))
        return left.packets if left else None, arrived.packets if arrived else None

    @property
    def _expected(self) -> "FlowSchedule":
        from fieldkit.measure.transfers.deliveries import FlowSchedule  # noqa: PLC0415 (as above)

        # The last sample is sent one interval before the end.
        return FlowSchedule(interval_s=1 / self.rate, lasts_s=max(self.duration - 1 / self.rate, 0.0))

    @override
    def summary(self, values: Mapping[str, Value]) -> Iterator[str]:
        if values.get("topic_discovered") is False:
            yield "topic not discovered"
        if isinstance(loss := values.get("topic_loss"), float):
            yield f"topic loss {100 * loss:.1f} %"
        if isinstance(delay_s := values.get("topic_delay_median_s"), float):
            yield f"topic delay {1e3 * delay_s:.1f} ms"
