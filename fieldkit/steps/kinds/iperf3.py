"""Measure how fast and how well iperf3 gets its packets from one robot to another."""

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from typing import Annotated, Final, Self

from fieldkit.backends.protocols import Testbed
from fieldkit.config import schema
from fieldkit.config.schema import Bool, Bytes, Duration, Field
from fieldkit.core.columns import Column, Measured, Value
from fieldkit.core.errors import EvidenceError, RobotError
from fieldkit.core.model import Protocol, Role
from fieldkit.measure.evidence import iperf3
from fieldkit.measure.evidence.iperf3 import IperfTest
from fieldkit.measure.transfers import load
from fieldkit.measure.transfers.load import LoadFlow
from fieldkit.remote import jobs
from fieldkit.remote.jobs import Job
from fieldkit.steps.along import AlongStep
from fieldkit.steps.base import View
from fieldkit.steps.loads import PROGRAM, LoadOptions
from fieldkit.steps.scene import Announce, Flow, ListeningPort, Planned, Scene

_LEAVES_S: Final = 5
"""How much longer than its client a server may run that has been told of the end."""

_LASTS_S: Final = 10.0
"""iperf3's own."""

_INTERVAL_BYTES: Final = 600
"""What iperf3 says of each second and stream."""


class Iperf3Step(LoadOptions, AlongStep):
    """A test of iperf3, what both ends say of it kept as JSON.

    Attributes:
        duration: How long it sends, in seconds; None for 10 s, or until `size` is sent.
        size: How much it sends; None where that is not what ends it.
        reverse: Whether the server sends and the client receives.
        limit: When a test that has not ended is ended.
    """

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

    def lasting(self, seconds: float) -> Self:
        """See `AlongStep.lasting`: in whole seconds, with the limit after them."""
        lasts_s = float(max(math.ceil(seconds), 1))
        return self.model_copy(update={"duration": lasts_s, "limit": lasts_s + self.limit})

    def commands(self, scene: Scene) -> Iterator[Planned]:
        """See `Step.commands`."""
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
        return Planned(role, job, program=PROGRAM)

    def prepare(self, scene: Scene, testbed: Testbed) -> Callable[[Announce], None]:
        """See `Step.prepare`: the server is up."""
        server, _ = self.commands(scene)
        jobs.start(testbed.shells[self.receiver], server.job)
        return partial(self._test, scene, testbed)

    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        """See `Step.run`."""
        self.prepare(scene, testbed)(announce)

    def _test(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        server, client = self.commands(scene)
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

    def roles(self) -> frozenset[Role]:
        """See `Step.roles`."""
        return frozenset({self.sender, self.receiver})

    def expected_s(self, protocol: Protocol) -> float:
        """See `Step.expected_s`."""
        lasts_s = self._lasts_s if self.size is None else 8 * self.size / self.expected_bit_s(protocol)
        return lasts_s + 0.5

    def claims(self) -> tuple[str, ...]:
        """See `Step.claims`."""
        return ("an iperf3",)

    def files(self) -> tuple[str, ...]:
        """See `Step.files`."""
        return tuple(name for role in (self.sender, self.receiver) for name in (self._json(role), self._log(role)))

    def _json(self, role: Role) -> str:
        return self.own_name(iperf3.json_file(role))

    def _log(self, role: Role) -> str:
        return self.own_name(f"{role}-iperf3.log")

    def listens(self) -> tuple[ListeningPort, ...]:
        """See `Step.listens`; both ends say by which ports they spoke."""
        return (ListeningPort(self.receiver, self.port, self.sender, self.source),)

    def flows(self, scene: Scene) -> Iterator[Flow]:
        """See `Step.flows`."""
        size_bytes = self.size or self._lasts_s * self.expected_bit_s(scene.protocol) / 8
        yield replace(self.flow(scene.protocol, size_bytes), source=self.source, destination=self.destination)

    def bytes_left(self, scene: Scene, role: Role) -> float:
        """See `Step.bytes_left`."""
        intervals = self.expected_s(scene.protocol) * (self.streams + 1)
        return intervals * _INTERVAL_BYTES if role in self.roles() else 0.0

    def declared(self) -> tuple[Column, ...]:
        """See `Step.declared`; a trial without iperf3 has no columns for it."""
        return (*iperf3.COLUMNS, *load.COLUMNS)

    def problems(self, view: View) -> Iterator[str]:
        """See `Step.problems`: both ends wrote their JSON to its end, and nothing went wrong."""
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

    def measure(self, view: View) -> Measured:
        """See `Step.measure`."""
        protocol = self.carried_by(view.scene.protocol)
        sent, received = (self._said(view, role) for role in (self.source, self.destination))
        flow = LoadFlow(
            protocol=protocol,
            source_address=view.scene.robot(self.source).address,
            destination_address=view.scene.robot(self.destination).address,
            ports=sent.ports if sent else (),
            payload_bytes=self.payload_bytes,
            window_s=received.window_s if received else (0.0, 0.0),
        )
        left, came = (view.capture(role) for role in (self.source, self.destination))
        captured = load.measure(flow, left.packets if left else None, came.packets if came else None)
        return iperf3.measure(protocol, sent, received) | captured

    def _said(self, view: View, role: Role) -> IperfTest | None:
        test = view.evidence.known(iperf3.read, self._json(role))
        return None if test is None or test.error else test

    def in_words(self, values: Mapping[str, Value]) -> Iterator[str]:
        """See `Step.in_words`."""
        if isinstance(rate_bit_s := values.get("iperf3_throughput_bit_s"), float):
            yield f"iperf3 {rate_bit_s / 1e6:.2f} Mbit/s"
        if isinstance(loss := values.get("iperf3_loss"), float):
            yield f"iperf3 loss {100 * loss:.1f} %"
