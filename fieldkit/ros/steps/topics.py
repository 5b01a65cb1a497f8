"""Stream samples of a topic from one robot to another over a middleware; measure loss, delay and discovery."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from typing import TYPE_CHECKING, ClassVar, Final, Self

from typing_extensions import override

from fieldkit.backends.protocols import Testbed
from fieldkit.core.columns import Column, Measured, Value
from fieldkit.core.model import Protocol, Role, sort_roles
from fieldkit.core.threads import run_parallel
from fieldkit.measure.transfers import stalls
from fieldkit.remote import agent, jobs
from fieldkit.remote.command import with_environment
from fieldkit.remote.jobs import Job
from fieldkit.ros.middlewares.middleware import Discovery, MiddlewareName
from fieldkit.ros.streams import read_checks, topic_checks
from fieldkit.ros.streams.stream_options import LONGEST_S, StreamOptions
from fieldkit.steps import agent_commands
from fieldkit.steps.along import AlongStep
from fieldkit.steps.capabilities import HasNeeds, Listens, Prepares, SendsTraffic, Summarizes, UsesSpace
from fieldkit.steps.scene import (
    BY_EXIT,
    BY_FIELDKIT,
    Announce,
    Flow,
    ListeningPort,
    Need,
    Planned,
    Scene,
    fragments,
)
from fieldkit.steps.view import View

if TYPE_CHECKING:
    from fieldkit.measure.attempt import AttemptEvidence
    from fieldkit.measure.captures.packets import Packets
    from fieldkit.measure.transfers.deliveries import FlowSchedule, StreamDeliveries
    from fieldkit.report.attempt_timing import AttemptTimes
    from fieldkit.report.charts import Panel
    from fieldkit.ros.streams.topic_columns import TopicTraffic
    from fieldkit.ros.streams.topic_samples import TopicLog


MASTER: Final = "rosmaster"
"""Program of the ROS master."""

KEPT_BYTES: Final = 256
"""Captured bytes of each frame, enough for the head of a sample. With an Ethernet header, the head ends at byte 138
for DDS, at 154 if the DDS message names its reader, and at about 190 for Zenoh, after attachment and key
expression."""

BUFFER_KIB: Final = 32_768
"""Kernel buffer of a capture around a topic. In immediate mode a frame needs about 400 bytes of it with `KEPT_BYTES`,
so 4 MiB hold 10,000 packets. Fast DDS sent 60,000 packets per second when it requested lost fragments again."""

_GRACE_S: Final = 5
"""Time in which a subscriber, router or master must exit after it was stopped; otherwise it is killed."""
_OVERHEAD_S: Final = 10.0
"""Time for the start of Python and the middleware, and for the publisher's wait at its end."""
_RECORD_BYTES: Final = 32
"""Size of the record of a sample, or of a read of the newest sample, in a log."""
_ENVELOPE_BYTES: Final = 100
"""Approximate size of the headers of middleware and IP per sample."""


class TopicsStep(StreamOptions, AlongStep, Prepares, HasNeeds, UsesSpace, Listens, SendsTraffic, Summarizes):
    """Streams samples of a topic from one robot to another over a middleware.

    The programs that publish and subscribe are part of fieldkit; both robots need the middleware for Python.
    [Topics](topics.md) also describes the columns. Inside a `capture` its traffic is counted, and delays are measured
    if there are packets in both directions. Writes `ROLE-topic.bin` and `ROLE-topic.log`, and `ROLE-serve.log` of a
    router or a master.
    """

    cross_checks = (
        *topic_checks.CROSS_CHECKS,
        *stalls.cross_checks("topic"),
        *read_checks.cross_checks("seen", "used", stream="topic"),
    )
    kept_bytes = KEPT_BYTES
    capture_buffer_kib = BUFFER_KIB
    needs_complete_capture = False
    flow_kind: ClassVar[str] = "topic"

    @override
    def with_duration(self, seconds: float) -> Self:
        return self.model_copy(update={"duration": min(seconds, LONGEST_S)})

    @override
    def jobs(self, scene: Scene) -> Iterator[Planned]:
        if self.server_role:
            yield self._server(scene, self.server_role)
        yield self._endpoint(scene, self.receiver, "subscribe")
        yield self._endpoint(scene, self.sender, "publish")

    def _endpoint(self, scene: Scene, role: Role, verb: str) -> Planned:
        """Return the job of the agent that publishes or subscribes."""
        robot = scene.robot(role)
        publishes = role == self.sender
        duration_s = self.patience + self.duration + _OVERHEAD_S
        job = Job(
            folder=scene.folder,
            name=self.prefixed_name(verb),
            argv=agent_commands.agent_command(
                robot, verb, self.agent_arguments(scene, role), self._file(role), environment=self.environment(robot)
            ),
            # The time limit of the subscriber must be longer than the limit of the publisher.
            limit_s=duration_s if publishes else 2 * duration_s,
            log=self._log(role),
            ready=None if publishes else "log:up,",
            ready_s=jobs.AGENT_READY_S,
        )
        setup, program = agent_commands.setup(robot), robot.profile.tools.python
        return Planned(
            role, job, program=program, setup=setup, permitted_causes=BY_EXIT if publishes else BY_FIELDKIT
        )

    def _server(self, scene: Scene, role: Role) -> Planned:
        """Return the job of the router or of the ROS master."""
        robot = scene.robot(role)
        is_router = self.discovery_method is Discovery.ROUTER
        setup = agent_commands.setup(robot)
        if is_router:
            arguments = agent_commands.compact({"network": self.network(scene, role)})
            argv, program = agent_commands.agent_command(robot, "route", arguments), robot.profile.tools.python
        else:
            # A master listens on the address of its node, which setup files often set to the loopback address.
            addresses = {"ROS_IP": robot.address, "ROS_HOSTNAME": robot.address}
            command = (MASTER, "--core", "-p", str(self.listening_port))
            argv, program = with_environment(command, setup=setup, environment=addresses), MASTER
        job = Job(
            folder=scene.folder,
            name=self.prefixed_name("serve"),
            argv=argv,
            limit_s=3 * (self.patience + self.duration + _OVERHEAD_S),
            log=self.prefixed_name(f"{role}-serve.log"),
            ready="log:up," if is_router else jobs.ready_when_bound(Protocol.TCP, self.listening_port),
            ready_s=jobs.AGENT_READY_S,
        )
        remedy = "" if is_router else f"sudo apt-get install python3-{MASTER}"
        return Planned(role, job, program=program, setup=setup, permitted_causes=BY_FIELDKIT, remedy=remedy)

    @override
    def prepare(self, scene: Scene, testbed: Testbed) -> Callable[[Announce], None]:
        """Install the agent and start all jobs except the publisher; return the function that publishes."""
        roles = sort_roles(self.participants)
        run_parallel(lambda role: agent.install(testbed.shells[role]), roles)
        *other_jobs, publish = self.jobs(scene)
        for planned in other_jobs:
            jobs.start(testbed.shells[planned.role], planned.job)
        return partial(self._stream, scene, testbed, other_jobs, publish)

    @override
    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        self.prepare(scene, testbed)(announce)

    def _stream(
        self, scene: Scene, testbed: Testbed, other_jobs: list[Planned], publish: Planned, announce: Announce
    ) -> None:
        """Run the publisher, stop the other programs, and check all exit codes."""
        announce("topics", self.expected_s(scene.protocol))
        with ExitStack() as silence_contexts:
            for role in self.participants:
                silence_contexts.enter_context(testbed.shells[role].silence(publish.job.limit_s))
            code = jobs.run(testbed.shells[publish.role], publish.job)
        exit_codes = [
            (planned, jobs.stop(testbed.shells[planned.role], planned.job, grace_s=_GRACE_S))
            for planned in reversed(other_jobs)
        ]
        for planned, exit_code in ((publish, code), *exit_codes):
            if exit_code != 0:
                raise scene.failure(planned, f"{planned.job.name} ended with exit code {exit_code}")

    @override
    def roles(self) -> frozenset[Role]:
        return self.participants

    @override
    def expected_s(self, protocol: Protocol) -> float:
        return self.duration + 3.0

    @override
    def listens(self) -> tuple[ListeningPort, ...]:
        """Return the listening ports, which differ between domains."""
        if not self.listening_port:  # DDS, whose participants use the next free ports
            return (ListeningPort(self.receiver, min(self.wire_ports.data), self.sender, by="domain", shared=True),)
        listeners = {(self.receiver, self.sender), (self.sender, self.receiver)}
        if self.server_role:
            # Clients of a router do not listen.
            listeners = listeners if self.over is MiddlewareName.ROS1 else set()
            listeners |= {(self.server_role, self.sender if self.server_role != self.sender else self.receiver)}
        ports = (ListeningPort(role, self.listening_port, peer, by="domain") for role, peer in listeners)
        return tuple(sorted(ports, key=lambda port: (port.role, port.peer)))

    @override
    def needs(self, scene: Scene) -> Iterator[Need]:
        """Yield the check of the middleware's Python package for each robot that needs it; a ROS master does not."""
        masters = {self.server_role} if self.discovery_method is Discovery.MASTER else set()
        for role in sort_roles(self.participants - masters):
            yield self.need(role, scene.robot(role))

    @override
    def exclusive_resources(self) -> tuple[str, ...]:
        return ("a stream of topics", read_checks.SEEN) if self.reads and self.image else ("a stream of topics",)

    @override
    def files(self) -> tuple[str, ...]:
        ends = [name for role in (self.receiver, self.sender) for name in (self._file(role), self._log(role))]
        return (*ends, *([self.prefixed_name(f"{self.server_role}-serve.log")] if self.server_role else []))

    def _file(self, role: Role) -> str:
        return self.prefixed_name(f"{role}-topic.bin")

    def _log(self, role: Role) -> str:
        return self.prefixed_name(f"{role}-topic.log")

    @override
    def flows(self, scene: Scene) -> Iterator[Flow]:
        # For each frame with data, at most one frame with an acknowledgement is expected.
        frames = 2 * self._samples * fragments(self.size_bytes + _ENVELOPE_BYTES)
        ends = (self.sender, self.receiver)
        server = self.server_role
        pairs = [ends, *((end, server) for end in ends if server and end != server)]
        for source, destination in dict.fromkeys(pairs):
            for port in sorted(self.wire_ports.data | self.wire_ports.discovery):
                yield Flow(source, destination, port, frames, group=self.wire_ports.group)
                frames = 0.0  # all frames are counted with the first flow

    @property
    def _samples(self) -> float:
        return self.rate * self.duration

    @override
    def stored_bytes(self, scene: Scene, role: Role) -> float:
        reads = self.reads.rate * self.duration if self.reads and role == self.receiver else 0.0
        return _RECORD_BYTES * (self._samples + reads) if role in {self.sender, self.receiver} else 0.0

    @override
    def output_columns(self) -> tuple[Column, ...]:
        """Return the columns of topics, which only trials with this step have."""
        from fieldkit.ros.streams import sample_reads, topic_columns, topic_stalls  # noqa: PLC0415 (needed only by this step)

        read_columns = sample_reads.declare_columns(self._reads_prefix, "topic_sent") if self.reads else ()
        return (*topic_columns.COLUMNS, *topic_stalls.COLUMNS, *read_columns)

    @override
    def check(self, view: View) -> Iterator[str]:
        """Yield a reason if a log is incomplete, or contradicts the other log, the attempt or the captures."""
        from fieldkit.ros.streams import topic_evidence  # noqa: PLC0415 (needed only by this step)

        logs, errors = topic_evidence.read(self, view, self._logs)
        yield from errors
        yield from topic_evidence.problems(self, view, logs)

    @property
    def _logs(self) -> Mapping[Role, str]:
        return {role: self._file(role) for role in (self.sender, self.receiver)}

    @override
    def measure(self, view: View) -> Measured:
        from fieldkit.ros.streams import topic_columns, topic_evidence, topic_stalls  # noqa: PLC0415 (needed only by this step)

        logs, _ = topic_evidence.read(self, view, self._logs)
        ends = logs.get(self.sender), logs.get(self.receiver)
        flow, packets = self._traffic(view), self._packets(view)
        stall_values = topic_stalls.measure(flow, ends, packets, self._schedule)
        measured = topic_columns.measure(flow, *ends, *packets) | stall_values
        measured = measured.without(
            topic_columns.withheld_reasons(measured, topic_evidence.dropped_reason(self, view))
        )
        measured = topic_evidence.without_contradicted_times(self, view, logs, measured)
        return (
            measured
            | topic_columns.measure_withheld(topic_evidence.dropped_reason(self, view))
            | self._measure_reads(view, ends, packets)
        )

    def _measure_reads(
        self,
        view: View,
        ends: "tuple[TopicLog | None, TopicLog | None]",
        packets: "tuple[Packets | None, Packets | None]",
    ) -> Measured:
        """Return the columns of `reads`: ages of the samples when a program reads the newest one at a fixed rate."""
        if self.reads is None:
            return Measured()
        from fieldkit.ros.streams import sample_reads  # noqa: PLC0415 (needed only by this step)

        addresses = (view.scene.robot(role).address for role in (self.sender, self.receiver))
        plan = sample_reads.ReadPlan(self._reads_prefix, self.reads.rate, self.reads.limit, 1 / self.rate)
        return sample_reads.measure(plan, *ends, *sample_reads.find_clocks(*packets, *addresses))

    @property
    def _reads_prefix(self) -> str:
        """Prefix of the columns of `reads`."""
        return "seen" if self.image else "used"

    def deliveries(self, view: View) -> "Sequence[StreamDeliveries]":
        """Return the deliveries of the stream; see `SendsFlow.deliveries`."""
        from fieldkit.ros.streams import topic_stalls  # noqa: PLC0415 (needed only by this step)

        return topic_stalls.read_deliveries(
            self._traffic(view), self._both_logs(view), self._packets(view), self._schedule
        )

    def panels(self, evidence: "AttemptEvidence", times: "AttemptTimes", zero_ns: int) -> "Iterator[Panel]":
        """Yield the panel of the delays; see `DrawsPanels.panels`."""
        from fieldkit.ros.streams import topic_panel  # noqa: PLC0415 (needed only by reports)

        yield from topic_panel.panels(self, evidence, times, zero_ns)

    @property
    def destination(self) -> Role:
        """Role of the subscriber."""
        return self.receiver

    def _traffic(self, view: View) -> "TopicTraffic":
        from fieldkit.ros.streams import topic_columns  # noqa: PLC0415 (needed only by this step)

        return topic_columns.TopicTraffic(
            sender_address=view.scene.robot(self.sender).address,
            receiver_address=view.scene.robot(self.receiver).address,
            data_ports=self.wire_ports.data,
            discovery_ports=self.wire_ports.discovery,
            deadline_s=self.qos.deadline,
        )

    def _both_logs(self, view: View) -> "tuple[TopicLog | None, TopicLog | None]":
        """Return the logs of publisher and subscriber; None for each that is not complete."""
        from fieldkit.ros.streams import topic_evidence  # noqa: PLC0415 (needed only by this step)

        logs, _ = topic_evidence.read(self, view, self._logs)
        return logs.get(self.sender), logs.get(self.receiver)

    def _packets(self, view: View) -> "tuple[Packets | None, Packets | None]":
        """Return the packets in the captures of sender and receiver; None for each without a complete capture."""
        sender, receiver = (view.capture(role) for role in (self.sender, self.receiver))
        return sender.packets if sender else None, receiver.packets if receiver else None

    @property
    def _schedule(self) -> "FlowSchedule":
        from fieldkit.measure.transfers.deliveries import FlowSchedule  # noqa: PLC0415 (needed only by this step)

        # The last sample is sent one interval before the end.
        return FlowSchedule(interval_s=1 / self.rate, duration_s=max(self.duration - 1 / self.rate, 0.0))

    @override
    def summary(self, values: Mapping[str, Value]) -> Iterator[str]:
        if values.get("topic_discovered") is False:
            yield "topic not discovered"
        if isinstance(loss := values.get("topic_loss"), float):
            yield f"topic loss {100 * loss:.1f} %"
        if isinstance(delay_s := values.get("topic_delay_median_s"), float):
            yield f"topic delay {1e3 * delay_s:.1f} ms"
        for name, text in (("seen_age_p95_s", "age of displayed frames"), ("used_age_p95_s", "age of used samples")):
            if isinstance(age_s := values.get(name), float):
                yield f"{text} {1e3 * age_s:.1f} ms"
