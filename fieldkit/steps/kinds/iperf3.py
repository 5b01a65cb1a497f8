"""Measure how fast and how well iperf3 gets its packets from one robot to another."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from typing import Annotated, ClassVar, Final, Self

from typing_extensions import override

from fieldkit.backends.protocols import Testbed
from fieldkit.config import schema
from fieldkit.config.schema import Bool, Bytes, Duration, Field
from fieldkit.core.columns import Column, Measured, Value
from fieldkit.core.errors import EvidenceError, RobotError
from fieldkit.core.model import Protocol, Role
from fieldkit.measure import job_times
from fieldkit.measure.captures.packets import Packets
from fieldkit.measure.checks import iperf3_checks, load_checks
from fieldkit.measure.checks.iperf3_checks import IperfOrder
from fieldkit.measure.checks.load_checks import LoadWitness
from fieldkit.measure.evidence import iperf3
from fieldkit.measure.evidence.iperf3 import IperfTest
from fieldkit.measure.transfers import load, load_streams, stalls
from fieldkit.measure.transfers.deliveries import Delivery
from fieldkit.measure.transfers.load import LoadFlow
from fieldkit.measure.transfers.load_streams import LoadStreams
from fieldkit.remote import jobs
from fieldkit.remote.jobs import Job
from fieldkit.steps.along import AlongStep
from fieldkit.steps.loads import PROGRAM, LoadOptions
from fieldkit.steps.scene import Announce, Flow, ListeningPort, Planned, Scene
from fieldkit.steps.view import View

_LEAVES_S: Final = 5
"""How much longer than its client a server may run that has been told of the end."""

_LASTS_S: Final = 10.0
"""iperf3's own."""

_INTERVAL_BYTES: Final = 600
"""What iperf3 says of each second and stream."""

_STALLS: Final = stalls.declared("iperf3", "iperf3", 67)


class Iperf3Step(LoadOptions, AlongStep):
    """Measures with iperf3, 3.1 or later, which both robots need: `sudo apt-get install iperf3`.

    The server ends with the test. Leaves `ROLE-iperf3.json`, the reports of both ends second by second. Inside a
    `capture` there are also the captures' figures of the same packets: [columns](method-loss.md#iperf3),
    [stalls](method-delay.md#stalls-of-a-flow).

    Attributes:
        duration: How long it sends, in whole seconds; 10 s without `size`.
        size: How much it sends, `10MB`, in place of `duration`.
        reverse: Whether the server sends and the client receives.
        limit: A test that takes longer is ended, and the repeat is void. With `along` it is added to the duration.
    """

    flow_kind: ClassVar[str] = "iperf3"
    cross_checks = (
        *iperf3_checks.CROSS_CHECKS,
        *load_streams.JITTER_CROSS_CHECKS,
        *stalls.cross_checks("iperf3"),
    )

    duration: Annotated[Duration, Field(ge=1)] | None = None
    size: Bytes | None = None
    reverse: Bool = False
    limit: Annotated[Duration, Field(gt=0)] = 120.0

    @schema.model_validator(mode="after")
    def _ends(self) -> "Iperf3Step":
        if self.size is not None and self.duration is not None:
            raise schema.complaint("a test lasts for its duration, or until its size is sent; leave one out", "size")
        if self.size is not None and self.along:
            raise schema.complaint("a test lasts along a way, or until its size is sent; leave one out", "size")
        if self._lasts_s % 1:
            raise schema.complaint(f"iperf3 counts whole seconds, not {self._lasts_s:g} s", "duration")
        if self.size is None and self._lasts_s >= self.limit:
            raise schema.complaint(f"it is to last {self._lasts_s:g} s and would be ended before", "limit")
        return self

    @property
    def _lasts_s(self) -> float:
        return _LASTS_S if self.duration is None else self.duration

    @property
    def source(self) -> Role:
        """Who sends."""
        return self.receiver if self.reverse else self.sender

    @property
    def destination(self) -> Role:
        """Who receives."""
        return self.sender if self.reverse else self.receiver

    @override
    def lasting(self, seconds: float) -> Self:
        """In whole seconds, with the limit after them."""
        lasts_s = float(max(math.ceil(seconds), 1))
        return self.model_copy(update={"duration": lasts_s, "limit": lasts_s + self.limit})

    @override
    def jobs(self, scene: Scene) -> Iterator[Planned]:
        until = ("-t", f"{self._lasts_s:.0f}") if self.size is None else ("-n", f"{self.size:.0f}")
        client = self.client(scene, *until, *(("-R",) if self.reverse else ()), "-i", "1", "--json")
        yield self._planned(scene, self.receiver, "server", self.server("-i", "1", "--json"))
        yield self._planned(scene, self.sender, "client", client)

    def _planned(self, scene: Scene, role: Role, name: str, argv: tuple[str, ...]) -> Planned:
        serves = role == self.receiver
        job = Job(
            folder=scene.folder,
            name=self.own_name(f"iperf3-{name}"),
            argv=argv,
            limit_s=self.limit + _LEAVES_S * serves,
            log=self._log(role),
            stdout=self._json(role),
            ready=jobs.bound(Protocol.TCP, self.port) if serves else None,
        )
        least_s = 0.0 if serves or self.size is not None else self._lasts_s
        return Planned(role, job, program=PROGRAM, least_s=least_s)

    @override
    def prepare(self, scene: Scene, testbed: Testbed) -> Callable[[Announce], None]:
        """The server is up."""
        server, _ = self.jobs(scene)
        jobs.start(testbed.shells[self.receiver], server.job)
        return partial(self._test, scene, testbed)

    @override
    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        self.prepare(scene, testbed)(announce)

    def _test(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        server, client = self.jobs(scene)
        listening, asking = (testbed.shells[planned.role] for planned in (server, client))
        announce("iperf3", self.expected_s(scene.protocol))
        with ExitStack() as silent:
            for shell in (listening, asking):
                silent.enter_context(shell.silence(self.limit))
            code = jobs.run(asking, client.job)
        # With --json some versions end with 0 whatever happened: what they wrote is judged with the evidence.
        left = jobs.begin_wait(listening, server.job, _LEAVES_S).end(_LEAVES_S + jobs.REPLY_S)
        if left == jobs.STILL_RUNNING:
            jobs.stop(listening, server.job)
        for planned, ended in ((client, code), (server, left)):
            if ended != 0:
                how = "was not told of its end" if ended == jobs.STILL_RUNNING else f"ended with exit code {ended}"
                raise RobotError(
                    f"{planned.job.name} {how}",
                    where=scene.robot(planned.role).name,
                    remedy=f"see {planned.job.stdout} and {planned.job.log} of this repeat",
                )

    @override
    def expected_s(self, protocol: Protocol) -> float:
        lasts_s = self._lasts_s if self.size is None else 8 * self.size / self.expected_bit_s(protocol)
        return lasts_s + 0.5

    @override
    def files(self) -> tuple[str, ...]:
        return tuple(name for role in (self.sender, self.receiver) for name in (self._json(role), self._log(role)))

    def _json(self, role: Role) -> str:
        return self.own_name(iperf3.json_file(role))

    def _log(self, role: Role) -> str:
        return self.own_name(f"{role}-iperf3.log")

    @override
    def listens(self) -> tuple[ListeningPort, ...]:
        """Both ends say by which ports they spoke."""
        return (ListeningPort(self.receiver, self.port, self.sender, self.source),)

    @override
    def flows(self, scene: Scene) -> Iterator[Flow]:
        size_bytes = self.size or self._lasts_s * self.expected_bit_s(scene.protocol) / 8
        yield replace(self.flow(scene.protocol, size_bytes), source=self.source, destination=self.destination)

    @override
    def bytes_left(self, scene: Scene, role: Role) -> float:
        intervals = self.expected_s(scene.protocol) * (self.streams + 1)
        return intervals * _INTERVAL_BYTES if role in self.roles() else 0.0

    @override
    def output_columns(self) -> tuple[Column, ...]:
        """A trial without iperf3 has no columns for it."""
        return (*iperf3.COLUMNS, *load.COLUMNS, *load_streams.JITTER, *_STALLS)

    @override
    def check(self, view: View) -> Iterator[str]:
        """Both ends wrote their JSON to its end, and no other evidence contradicts it."""
        tests: dict[Role, IperfTest] = {}
        for role in (self.sender, self.receiver):
            file = self._json(role)
            try:
                test = view.evidence.read(iperf3.read, file)
            except EvidenceError as error:
                yield f"{file}: {error.what}"
                continue
            if test.error:
                yield f"{file}: iperf3 says: {test.error}"
            elif not test.intervals:
                yield f"{file}: iperf3 measured nothing"
            else:
                tests[role] = test
                own = iperf3_checks.within(test, sends=role == self.source)
                yield from (f"{file}: {why}" for why in own)
                if why := iperf3_checks.misdated(test, view.attempt_window(role)):
                    yield f"{file}: {why}"
        if len(tests) > 1:
            yield from self._contradictions(view, tests)

    def _contradictions(self, view: View, tests: Mapping[Role, IperfTest]) -> Iterator[str]:
        """Yield the contradictions between the JSON of both ends, the procedure, captures and interface counters."""
        protocol = self.carried_by(view.scene.protocol)
        lasts_s = self._lasts_s if self.size is None else None
        order = IperfOrder(protocol, self.streams, self.payload_bytes, self.reverse, lasts_s)
        yield from iperf3_checks.between(tests[self.sender], tests[self.receiver], order)
        sent, received = tests[self.source], tests[self.destination]
        left, came = (view.capture(role) for role in (self.source, self.destination))
        if left is not None and came is not None:
            witness = LoadWitness(
                sender=left.packets,
                receiver=came.packets,
                server_port=self.port,
                reverse=self.reverse,
                sender_counters=view.evidence.counters(self.source),
                receiver_counters=view.evidence.counters(self.destination),
            )
            yield from load_checks.find(self._flow(view, sent, received), sent, received, witness)
        interface = view.scene.robot(self.destination).profile.radio.interface
        moved = view.evidence.interface_bytes(self.destination, interface)
        payload_bytes = sum(interval.payload_bytes for interval in received.intervals)
        if moved is not None and payload_bytes > moved:
            what = f"iperf3 received {payload_bytes} bytes, and the interface of the {self.destination}"
            yield f"{what} {moved} in the whole attempt"

    def _flow(self, view: View, sent: IperfTest | None, received: IperfTest | None) -> LoadFlow:
        return LoadFlow(
            protocol=self.carried_by(view.scene.protocol),
            source_address=view.scene.robot(self.source).address,
            destination_address=view.scene.robot(self.destination).address,
            ports=sent.ports if sent else (),
            payload_bytes=self.payload_bytes,
            window_s=received.window_s if received else (0.0, 0.0),
        )

    @override
    def measure(self, view: View) -> Measured:
        protocol = self.carried_by(view.scene.protocol)
        sent, received = (self._said(view, role) for role in (self.source, self.destination))
        flow = self._flow(view, sent, received)
        left, came = self._packets(view)
        data = self._data_streams(view)
        return (
            iperf3.measure(protocol, sent, received)
            | load.measure(flow, left, came)
            | load_streams.measure_jitter(data, left, came)
            | load_streams.measure("iperf3", data, left, came)
        )

    def deliveries(self, view: View) -> Sequence[Delivery]:
        """See `SendsFlow.deliveries`."""
        return load_streams.read(self._data_streams(view), *self._packets(view))

    def _packets(self, view: View) -> tuple[Packets | None, Packets | None]:
        """Return what the robot that sends captured, and the one that receives."""
        left, came = (view.capture(role) for role in (self.source, self.destination))
        return left.packets if left else None, came.packets if came else None

    def _data_streams(self, view: View) -> LoadStreams:
        sent, received = (self._said(view, role) for role in (self.source, self.destination))
        ports = sent.ports if sent else tuple((other, own) for own, other in received.ports) if received else ()
        job = self.own_name(f"iperf3-{'client' if self.reverse else 'server'}")
        return self.data_streams(
            view.scene,
            reverse=self.reverse,
            ports=ports,
            lasts_s=self._lasts_s if self.size is None else None,
            until_ns=job_times.ended_ns(view.evidence, self.destination, job),
        )

    def _said(self, view: View, role: Role) -> IperfTest | None:
        test = view.evidence.read_or_none(iperf3.read, self._json(role))
        return None if test is None or test.error else test

    @override
    def summary(self, values: Mapping[str, Value]) -> Iterator[str]:
        if isinstance(loss := values.get("iperf3_loss"), float | int):
            yield f"iperf3 loss {100 * loss:.1f} %"
        if isinstance(rate_bit_s := values.get("iperf3_throughput_bit_s"), float):
            yield f"iperf3 {rate_bit_s / 1e6:.2f} Mbit/s"
