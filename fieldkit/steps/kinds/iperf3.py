"""Measure throughput, loss and jitter between two robots with iperf3."""

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
from fieldkit.measure import robot_clock
from fieldkit.measure.captures.packets import Packets
from fieldkit.measure.checks import iperf3_checks, load_checks
from fieldkit.measure.checks.iperf3_checks import IperfSettings
from fieldkit.measure.checks.load_checks import LoadEvidence
from fieldkit.measure.evidence import iperf3
from fieldkit.measure.evidence.iperf3 import IperfTest
from fieldkit.measure.transfers import iperf3_load, stalls
from fieldkit.measure.transfers.deliveries import StreamDeliveries
from fieldkit.measure.transfers.iperf3_load import LoadFlow, LoadStreams
from fieldkit.remote import jobs
from fieldkit.remote.jobs import Job
from fieldkit.steps.along import AlongStep
from fieldkit.steps.capabilities import Listens, Prepares, SendsTraffic, Summarizes, UsesSpace
from fieldkit.steps.loads import PROGRAM, LoadOptions
from fieldkit.steps.scene import Announce, Flow, ListeningPort, Planned, Scene
from fieldkit.steps.view import View

_SERVER_EXIT_S: Final = 5
"""Maximum time between the exits of client and server."""

_DEFAULT_DURATION_S: Final = 10.0
"""Default duration of iperf3."""

_START_S: Final = 0.5
"""Approximate time in which server and client start and exit."""

_INTERVAL_BYTES: Final = 600
"""Size of iperf3's report on one second of one stream."""

_STALLS: Final = stalls.declare_columns("iperf3", "iperf3", rank=67)


class Iperf3Step(LoadOptions, AlongStep, Prepares, UsesSpace, Listens, SendsTraffic, Summarizes):
    """Measures with iperf3. Both robots need iperf3 3.1 or later: `sudo apt-get install iperf3`.

    The server exits after the test. Writes `ROLE-iperf3.json`, a report of each end with an entry per second. Inside
    a `capture`, figures of the same packets are also computed from the captures:
    [columns](method-loss.md#iperf3), [stalls](method-delay.md#stalls-of-a-flow).

    Attributes:
        duration: Duration of the test in whole seconds; 10 s without `size`.
        size: Amount of data to send, such as `10MB`, instead of `duration`.
        reverse: Whether the server sends and the client receives.
        limit: Maximum duration. A test that takes longer is stopped, and the repeat is void. With `along` the maximum
            is the duration of the path plus this value.
    """

    flow_kind: ClassVar[str] = "iperf3"
    cross_checks = (*iperf3_checks.CROSS_CHECKS, *iperf3_load.JITTER_CROSS_CHECKS, *stalls.cross_checks("iperf3"))

    duration: Annotated[Duration, Field(ge=1)] | None = None
    size: Bytes | None = None
    reverse: Bool = False
    limit: Annotated[Duration, Field(gt=0)] = 120.0

    @schema.model_validator(mode="after")
    def _has_duration_or_size(self) -> "Iperf3Step":
        if self.size is not None and self.duration is not None:
            raise schema.validation_error("a test has a duration or a size, not both; leave one out", "size")
        if self.size is not None and self.along:
            raise schema.validation_error("a test has along: true or a size, not both; leave one out", "size")
        if self._duration_s % 1:
            raise schema.validation_error(f"iperf3 needs whole seconds, not {self._duration_s:g} s", "duration")
        if self.size is None and self._duration_s >= self.limit:
            raise schema.validation_error(
                f"the test lasts {self._duration_s:g} s, so its limit must be longer", "limit"
            )
        return self

    @property
    def _duration_s(self) -> float:
        return _DEFAULT_DURATION_S if self.duration is None else self.duration

    @property
    def source(self) -> Role:
        """Role of the robot that sends the data."""
        return self.receiver if self.reverse else self.sender

    @property
    def destination(self) -> Role:
        """Role of the robot that receives the data."""
        return self.sender if self.reverse else self.receiver

    @override
    def with_duration(self, seconds: float) -> Self:
        """Return the step with the duration rounded up to whole seconds, and added to the limit."""
        duration_s = float(max(math.ceil(seconds), 1))
        return self.model_copy(update={"duration": duration_s, "limit": duration_s + self.limit})

    @override
    def jobs(self, scene: Scene) -> Iterator[Planned]:
        end_options = ("-t", f"{self._duration_s:.0f}") if self.size is None else ("-n", f"{self.size:.0f}")
        client = self.client_command(scene, *end_options, *(("-R",) if self.reverse else ()), "-i", "1", "--json")
        yield self._planned_job(scene, self.receiver, "server", self.server_command("-i", "1", "--json"))
        yield self._planned_job(scene, self.sender, "client", client)

    def _planned_job(self, scene: Scene, role: Role, name: str, argv: tuple[str, ...]) -> Planned:
        is_server = role == self.receiver
        job = Job(
            folder=scene.folder,
            name=self.prefixed_name(f"iperf3-{name}"),
            argv=argv,
            limit_s=self.limit + (_SERVER_EXIT_S if is_server else 0),
            log=self._log(role),
            stdout=self._json(role),
            ready=jobs.ready_when_bound(Protocol.TCP, self.port) if is_server else None,
        )
        min_duration_s = 0.0 if is_server or self.size is not None else self._duration_s
        return Planned(role, job, program=PROGRAM, min_duration_s=min_duration_s)

    @override
    def prepare(self, scene: Scene, testbed: Testbed) -> Callable[[Announce], None]:
        """Start the server; return the function that runs the client."""
        server, _ = self.jobs(scene)
        jobs.start(testbed.shells[self.receiver], server.job)
        return partial(self._test, scene, testbed)

    @override
    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        self.prepare(scene, testbed)(announce)

    def _test(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        """Run the client, then wait until the server has exited."""
        server, client = self.jobs(scene)
        server_shell, client_shell = (testbed.shells[planned.role] for planned in (server, client))
        announce("iperf3", self.expected_s(scene.protocol))
        with ExitStack() as silence_contexts:
            for shell in (server_shell, client_shell):
                silence_contexts.enter_context(shell.silence(self.limit))
            code = jobs.run(client_shell, client.job)
        # With --json some versions exit with 0 after any error; `check` evaluates their output.
        server_code = jobs.begin_wait(server_shell, server.job, _SERVER_EXIT_S).end(_SERVER_EXIT_S + jobs.REPLY_S)
        if server_code == jobs.STILL_RUNNING:
            jobs.stop(server_shell, server.job)
        for planned, exit_code in ((client, code), (server, server_code)):
            if exit_code != 0:
                ending_text = (
                    "did not exit" if exit_code == jobs.STILL_RUNNING else f"ended with exit code {exit_code}"
                )
                raise RobotError(
                    f"{planned.job.name} {ending_text}",
                    where=scene.robot(planned.role).name,
                    remedy=f"see {planned.job.stdout} and {planned.job.log} of this repeat",
                )

    @override
    def expected_s(self, protocol: Protocol) -> float:
        duration_s = self._duration_s if self.size is None else 8 * self.size / self.expected_bit_s(protocol)
        return duration_s + _START_S

    @override
    def files(self) -> tuple[str, ...]:
        return tuple(name for role in (self.sender, self.receiver) for name in (self._json(role), self._log(role)))

    def _json(self, role: Role) -> str:
        return self.prefixed_name(iperf3.json_file(role))

    def _log(self, role: Role) -> str:
        return self.prefixed_name(f"{role}-iperf3.log")

    @override
    def listens(self) -> tuple[ListeningPort, ...]:
        """Return the port of the server, with the role that sends the data.

        The reports contain the ports of both ends, so two tests in opposite directions can use the same port.
        """
        return (ListeningPort(self.receiver, self.port, self.sender, self.source),)

    @override
    def flows(self, scene: Scene) -> Iterator[Flow]:
        size_bytes = self.size or self._duration_s * self.expected_bit_s(scene.protocol) / 8
        yield replace(self.flow(scene.protocol, size_bytes), source=self.source, destination=self.destination)

    @override
    def stored_bytes(self, scene: Scene, role: Role) -> float:
        intervals = self.expected_s(scene.protocol) * (self.streams + 1)
        return intervals * _INTERVAL_BYTES if role in self.roles() else 0.0

    @override
    def output_columns(self) -> tuple[Column, ...]:
        """Return the columns of iperf3, which only trials with this step have."""
        return (*iperf3.COLUMNS, *iperf3_load.COLUMNS, *iperf3_load.JITTER, *_STALLS)

    @override
    def check(self, view: View) -> Iterator[str]:
        """Yield a reason if a JSON report is incomplete or contradicts other evidence."""
        tests: dict[Role, IperfTest] = {}
        for role in (self.sender, self.receiver):
            file = self._json(role)
            try:
                test = view.evidence.read(iperf3.read, file)
            except EvidenceError as error:
                yield f"{file}: {error.what}"
                continue
            if test.error:
                yield f"{file}: iperf3 reports: {test.error}"
            elif not test.intervals:
                yield f"{file}: iperf3 measured nothing"
            else:
                tests[role] = test
                reasons = iperf3_checks.check_one_end(test, sends=role == self.source)
                yield from (f"{file}: {reason}" for reason in reasons)
                if reason := iperf3_checks.date_problem(test, view.attempt_window(role)):
                    yield f"{file}: {reason}"
        if len(tests) > 1:
            yield from self._contradictions(view, tests)

    def _contradictions(self, view: View, tests: Mapping[Role, IperfTest]) -> Iterator[str]:
        """Yield the contradictions between both JSON reports, the procedure, captures and interface counters."""
        protocol = self.transport_protocol(view.scene.protocol)
        duration_s = self._duration_s if self.size is None else None
        settings = IperfSettings(protocol, self.streams, self.payload_bytes, self.reverse, duration_s)
        yield from iperf3_checks.compare_ends(tests[self.sender], tests[self.receiver], settings)
        source_test, destination_test = tests[self.source], tests[self.destination]
        source_capture, destination_capture = (view.capture(role) for role in (self.source, self.destination))
        if source_capture is not None and destination_capture is not None:
            load_evidence = LoadEvidence(
                sender=source_capture.packets,
                receiver=destination_capture.packets,
                server_port=self.port,
                reverse=self.reverse,
                sender_counters=view.evidence.counters(self.source),
                receiver_counters=view.evidence.counters(self.destination),
            )
            flow = self._flow(view, source_test, destination_test)
            yield from load_checks.find_contradictions(flow, source_test, destination_test, load_evidence)
        interface = view.scene.link(self.destination, self.over).interface
        interface_bytes = view.evidence.interface_bytes(self.destination, interface)
        payload_bytes = sum(interval.payload_bytes for interval in destination_test.intervals)
        if interface_bytes is not None and payload_bytes > interface_bytes:
            received_text = f"iperf3 received {payload_bytes} bytes, but the interface of the {self.destination}"
            yield f"{received_text} only {interface_bytes} in the whole attempt"

    def _flow(self, view: View, source_test: IperfTest | None, destination_test: IperfTest | None) -> LoadFlow:
        """Return the data flow of the test, for totals and checks."""
        return LoadFlow(
            protocol=self.transport_protocol(view.scene.protocol),
            source_address=view.scene.link(self.source, self.over).address,
            destination_address=view.scene.link(self.destination, self.over).address,
            ports=source_test.ports if source_test else (),
            payload_bytes=self.payload_bytes,
            window_s=destination_test.window_s if destination_test else (0.0, 0.0),
        )

    @override
    def measure(self, view: View) -> Measured:
        protocol = self.transport_protocol(view.scene.protocol)
        source_test, destination_test = (self._report(view, role) for role in (self.source, self.destination))
        flow = self._flow(view, source_test, destination_test)
        packets = self._packets(view)
        data = self._data_streams(view)
        return (
            iperf3.measure(protocol, source_test, destination_test)
            | iperf3_load.measure_totals(flow, *packets)
            | iperf3_load.measure_jitter(data, *packets)
            | iperf3_load.measure_stalls("iperf3", data, *packets)
        )

    def deliveries(self, view: View) -> Sequence[StreamDeliveries]:
        """Return the deliveries of each stream; see `SendsFlow.deliveries`."""
        return iperf3_load.read_deliveries(self._data_streams(view), *self._packets(view))

    def _packets(self, view: View) -> tuple[Packets | None, Packets | None]:
        """Return the packets in the captures of source and destination."""
        source, destination = (view.capture(role) for role in (self.source, self.destination))
        return source.packets if source else None, destination.packets if destination else None

    def _data_streams(self, view: View) -> LoadStreams:
        """Return the packet filter of the streams, with the ports from the report of one end."""
        source_test, destination_test = (self._report(view, role) for role in (self.source, self.destination))
        swapped_ports = tuple((remote, local) for local, remote in destination_test.ports) if destination_test else ()
        ports = source_test.ports if source_test else swapped_ports
        job = self.prefixed_name(f"iperf3-{'client' if self.reverse else 'server'}")
        return self.data_streams(
            view.scene,
            reverse=self.reverse,
            ports=ports,
            duration_s=self._duration_s if self.size is None else None,
            receiver_end_ns=robot_clock.job_end_ns(view.evidence, self.destination, job),
        )

    def _report(self, view: View, role: Role) -> IperfTest | None:
        """Return the valid report of a robot; None if it is missing or is an error."""
        test = view.evidence.read_or_none(iperf3.read, self._json(role))
        return None if test is None or test.error else test

    @override
    def summary(self, values: Mapping[str, Value]) -> Iterator[str]:
        if isinstance(loss := values.get("iperf3_loss"), float | int):
            yield f"iperf3 loss {100 * loss:.1f} %"
        if isinstance(rate_bit_s := values.get("iperf3_throughput_bit_s"), float):
            yield f"iperf3 {rate_bit_s / 1e6:.2f} Mbit/s"
