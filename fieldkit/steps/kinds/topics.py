"""Stream samples of a topic from one robot to another over a middleware, and measure what arrives, and when."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from functools import partial
from typing import TYPE_CHECKING, Final, Self

from fieldkit.backends.protocols import Testbed
from fieldkit.core.columns import Column, Measured, Value
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Protocol, Role, in_order
from fieldkit.core.threads import together
from fieldkit.remote import agent, jobs
from fieldkit.remote.command import with_environment
from fieldkit.remote.jobs import Job
from fieldkit.steps import streams
from fieldkit.steps.along import AlongStep
from fieldkit.steps.base import View
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

if TYPE_CHECKING:
    from fieldkit.measure.transfers.topic_log import TopicLog

MASTER: Final = "rosmaster"
"""ROS's own."""

_GRACE_S: Final = 5
_ENDS_S: Final = 10.0
"""Starting Python and the middleware, and what the publisher waits at its end."""
_RECORD_BYTES: Final = 32
"""What an end writes down of a sample."""
_ENVELOPE_BYTES: Final = 100
"""About what a middleware and IP add to a sample."""


class TopicsStep(StreamOptions, AlongStep):
    """A topic between two robots, by the agent on both.

    The subscriber is up before the publisher starts, so that discovery is timed by one clock: that of the publisher.
    """

    def lasting(self, seconds: float) -> Self:
        """See `AlongStep.lasting`."""
        return self.model_copy(update={"duration": min(seconds, LONGEST_S)})

    def commands(self, scene: Scene) -> Iterator[Planned]:
        """See `Step.commands`."""
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

    def prepare(self, scene: Scene, testbed: Testbed) -> Callable[[Announce], None]:
        """See `Step.prepare`: the agent is there, and all but the publisher is up."""
        members = in_order(self.members)
        together(lambda role: agent.install(testbed.shells[role]), members)
        *before, publish = self.commands(scene)
        for planned in before:
            jobs.start(testbed.shells[planned.role], planned.job)
        return partial(self._stream, scene, testbed, before, publish)

    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        """See `Step.run`."""
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

    def roles(self) -> frozenset[Role]:
        """See `Step.roles`."""
        return self.members

    def expected_s(self, protocol: Protocol) -> float:  # noqa: ARG002 (the same for every protocol)
        """See `Step.expected_s`."""
        return self.duration + 3.0

    def listens(self) -> tuple[ListeningPort, ...]:
        """See `Step.listens`: each domain has ports of its own."""
        if not self.served_on:  # of DDS, whose participants take the next ports that are free
            return (ListeningPort(self.receiver, min(self.wire.data), self.sender, by="domain", shared=True),)
        listeners = {(self.receiver, self.sender), (self.sender, self.receiver)}
        if self.serves:
            # Clients of a router have none of their own.
            listeners = listeners if self.over is Over.ROS1 else set()
            listeners |= {(self.serves, self.sender if self.serves != self.sender else self.receiver)}
        found = (ListeningPort(role, self.served_on, peer, by="domain") for role, peer in listeners)
        return tuple(sorted(found, key=lambda one: (one.role, one.peer)))

    def needs(self, scene: Scene) -> Iterator[Need]:
        """See `Step.needs`: the middleware's Python package."""
        # A master needs none of it.
        for role in in_order(self.members - ({self.serves} if self.way is Discovery.MASTER else set())):
            yield self.need(role, scene.robot(role))

    def claims(self) -> tuple[str, ...]:
        """See `Step.claims`."""
        return ("topics",)

    def files(self) -> tuple[str, ...]:
        """See `Step.files`."""
        ends = [name for role in (self.receiver, self.sender) for name in (self._file(role), self._log(role))]
        return (*ends, *([self.own_name(f"{self.serves}-serve.log")] if self.serves else []))

    def _file(self, role: Role) -> str:
        return self.own_name(f"{role}-topic.bin")

    def _log(self, role: Role) -> str:
        return self.own_name(f"{role}-topic.log")

    def flows(self, scene: Scene) -> Iterator[Flow]:  # noqa: ARG002 (the same for every scene)
        """See `Step.flows`."""
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

    def bytes_left(self, scene: Scene, role: Role) -> float:  # noqa: ARG002 (the same for every scene)
        """See `Step.bytes_left`."""
        return _RECORD_BYTES * self._samples if role in {self.sender, self.receiver} else 0.0

    def declared(self) -> tuple[Column, ...]:
        """See `Step.declared`; a trial without topics has no columns for them."""
        from fieldkit.measure.transfers import topics  # noqa: PLC0415 (only where there are any)

        return topics.COLUMNS

    def problems(self, view: View) -> Iterator[str]:
        """See `Step.problems`: both logs have their end, and nobody got what was never sent."""
        from fieldkit.measure.transfers import topic_log, topics  # noqa: PLC0415 (as above)

        logs: dict[Role, TopicLog] = {}
        for role in (self.sender, self.receiver):
            try:
                logs[role] = view.evidence.read(topic_log.read, self._file(role))
            except EvidenceError as error:
                yield f"{self._file(role)}: {error.what}"
                continue
            if not logs[role].whole:
                yield f"{self._file(role)} has no end: the agent was ended"
            if logs[role].foreign:
                yield f"{self._file(role)}: somebody else publishes {self.topic}, too: take another topic or domain"
        if len(logs) == 2 and (why := topics.contradiction(logs[self.sender], logs[self.receiver])):
            yield why

    def measure(self, view: View) -> Measured:
        """See `Step.measure`."""
        from fieldkit.measure.transfers import topics  # noqa: PLC0415 (as above)

        sent, came = (self._whole(view, role) for role in (self.sender, self.receiver))
        left, arrived = (view.capture(role) for role in (self.sender, self.receiver))
        flow = topics.TopicTraffic(
            sender_address=view.scene.robot(self.sender).address,
            receiver_address=view.scene.robot(self.receiver).address,
            data_ports=self.wire.data,
            discovery_ports=self.wire.discovery,
            deadline_s=self.qos.deadline,
        )
        captured = (left.packets if left else None, arrived.packets if arrived else None)
        return topics.measure(flow, sent, came, *captured)

    def _whole(self, view: View, role: Role) -> "TopicLog | None":
        from fieldkit.measure.transfers import topic_log  # noqa: PLC0415 (as above)

        found = view.evidence.known(topic_log.read, self._file(role))
        return found if found and found.whole else None

    def in_words(self, values: Mapping[str, Value]) -> Iterator[str]:
        """See `Step.in_words`."""
        if values.get("topic_discovered") is False:
            yield "topic not discovered"
        if isinstance(loss := values.get("topic_loss"), float):
            yield f"topic loss {100 * loss:.1f} %"
        if isinstance(delay_s := values.get("topic_delay_median_s"), float):
            yield f"topic delay {1e3 * delay_s:.1f} ms"
