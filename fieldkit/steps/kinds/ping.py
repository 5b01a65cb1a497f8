"""Measure round-trip times with ping."""

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Annotated, Final, Self

import numpy as np
from typing_extensions import override

from fieldkit.backends.protocols import Testbed
from fieldkit.config import schema
from fieldkit.config.schema import Bool, Duration, Field, Int, Strict
from fieldkit.core.columns import Column, Measured, Value
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Protocol, Role
from fieldkit.core.units import format_count
from fieldkit.measure.captures.arrays import NO_TIME, Mask
from fieldkit.measure.captures.ip import ICMP
from fieldkit.measure.captures.packets import ECHO_REPLY, NO_ECHO, Packets
from fieldkit.measure.checks import ping_checks
from fieldkit.measure.evidence import ping
from fieldkit.measure.evidence.ping import Ping
from fieldkit.measure.positions import where
from fieldkit.measure.transfers import echoes
from fieldkit.remote import jobs
from fieldkit.remote.jobs import Job
from fieldkit.steps import routing
from fieldkit.steps.along import AlongStep
from fieldkit.steps.scene import Announce, Flow, Need, Pinging, Planned, Refusal, Scene, fragments
from fieldkit.steps.variants import PingTool, Tool
from fieldkit.steps.view import View

LAST_REPLY_S: Final = 2
_HEADER_BYTES: Final = 8
OLD_INTERVAL_S: Final = 0.2
MOST: Final = 1_000_000
_ROUNDING: Final = 1e-6

Payload = Annotated[Int, Field(ge=0, le=65507)]


def command_line(scene: Scene, role: Role, options: Iterable[str], address: str) -> tuple[str, ...]:
    """Return how the robot in `role` pings `address`, for output that can be read: no names, time stamps, English."""
    # busybox has no time stamps, and resolves no names anyway.
    stamps = () if scene.tools(role).ping is PingTool.BUSYBOX else ("-n", "-D")
    return ("env", "LC_ALL=C", scene.robot(role).profile.tools.ping, *stamps, *options, address)


class Payloads(Strict):
    """ICMP payload in bytes per protocol; the defaults are what the paper calls each protocol's window.

    Attributes:
        tcp: In TCP repeats.
        udp: In UDP repeats.
    """

    tcp: Payload = 502
    udp: Payload = 8192

    @schema.model_validator(mode="before")
    @classmethod
    def _of_both(cls, data: object) -> object:
        """Take a single number for both."""
        return {"tcp": data, "udp": data} if isinstance(data, int) and not isinstance(data, bool) else data


class PingStep(AlongStep):
    """Measures round-trip times with ping. Leaves `ping.txt`.

    Attributes:
        sender: Role that sends the requests.
        receiver: Role that answers.
        count: Echo requests.
        interval: Time between them; below `200ms` iputils before 20210722 needs root.
        payload_bytes: ICMP payload per protocol; one number sets both.
        gap: Whether columns report the longest time without an answer, `rtt_gap_s`, and the requests lost in it,
            `rtt_gap_lost`. If the ping began or ended in the gap, the columns have lower bounds
            (`rtt_gap_at_least_s`).
        forwarded: Whether robots forward for each other; preflight then looks for a routing daemon on all of them.
    """

    columns = (*ping.COLUMNS, *ping.SENT_COLUMNS, *ping.WAY_COLUMNS)
    cross_checks = ping_checks.CROSS_CHECKS
    needs_complete_capture = False
    lasts_by = "count"

    sender: Role = Field(alias="from")
    receiver: Role = Field(alias="to")
    count: Annotated[Int, Field(gt=0, le=MOST)] = 10
    interval: Annotated[Duration, Field(ge=0.002)] = 0.2
    payload_bytes: Payloads = Payloads.defaults()
    gap: Bool = Field(default=False, exclude_if=schema.is_empty)
    forwarded: Bool = Field(default=False, exclude_if=schema.is_empty)

    @schema.model_validator(mode="after")
    def _has_two_ends(self) -> "PingStep":
        if self.sender == self.receiver:
            raise schema.complaint(f"{self.sender} cannot ping itself; name another robot", "to")
        return self

    @override
    def lasting(self, seconds: float) -> Self:
        count = math.ceil(seconds / self.interval - _ROUNDING)
        return self.model_copy(update={"count": min(max(count, 1), MOST)})

    @override
    def jobs(self, scene: Scene) -> Iterator[Planned]:
        sends = ("-c", str(self.count), "-i", f"{self.interval:g}", "-s", str(self._payload_bytes(scene.protocol)))
        options = (*sends, "-W", str(LAST_REPLY_S))
        yield Planned(
            self.sender,
            Job(
                folder=scene.folder,
                name=self.own_name("ping"),
                argv=command_line(scene, self.sender, options, scene.robot(self.receiver).address),
                limit_s=self.count * self.interval + LAST_REPLY_S + 10.0,
                log=self._log,
                stdout=self._file,
            ),
            program=scene.robot(self.sender).profile.tools.ping,
            tool=Tool.PING,
        )

    def _payload_bytes(self, protocol: Protocol) -> int:
        return self.payload_bytes.udp if protocol is Protocol.UDP else self.payload_bytes.tcp

    @override
    def refusals(self, scene: Scene) -> Iterator[Refusal]:
        tools = scene.tools(self.sender)
        if tools.ping is PingTool.IPUTILS_OLD and not tools.root and self.interval < OLD_INTERVAL_S:
            yield Refusal(
                self.sender,
                f"its ping lets only root send every {1e3 * self.interval:g} ms (iputils before 20210722)",
                "interval: 200ms in the procedure, or user: root in the site file",
            )

    @override
    def needs(self, scene: Scene) -> Iterator[Need]:
        if self.forwarded:
            yield from routing.needs(scene)

    @override
    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        (planned,) = self.jobs(scene)
        announce("ping", self.expected_s(scene.protocol))
        shell = testbed.shells[self.sender]
        with shell.silence(planned.job.limit_s):
            code = jobs.run(shell, planned.job)
        if code not in {0, 1}:  # 1: some or all replies are missing, which is a measurement
            raise scene.failure(planned, f"ping ended with exit code {code}")

    @override
    def files(self) -> tuple[str, ...]:
        return (self._file, self._log)

    @property
    def _file(self) -> str:
        return self.own_name(ping.FILE)

    @property
    def _log(self) -> str:
        return self.own_name(f"{self.sender}-ping.log")

    @override
    def flows(self, scene: Scene) -> Iterator[Flow]:
        there_and_back = 2 * self.count * fragments(self._payload_bytes(scene.protocol))
        yield Flow(self.sender, self.receiver, frames=there_and_back)

    @override
    def pinging(self) -> Pinging:
        return Pinging(self.sender, self._file, self.prefix)

    @override
    def check(self, view: View) -> Iterator[str]:
        """Every request was sent, and ping said so."""
        try:
            found = view.evidence.read(ping.read, self._file)
        except EvidenceError:
            yield f"{self._file} is missing"
            return
        if found.transmitted is None:
            yield f"{self._file}: ping was cut short, its summary is missing"
        elif found.transmitted < self.count:
            yield f"{self._file}: ping sent {found.transmitted} of {self.count} requests"
        asked_bytes, window = self._payload_bytes(view.scene.protocol), view.attempt_window(self.sender)
        yield from (f"{self._file}: {why}" for why in ping_checks.within(found, self.count, asked_bytes, window))
        if found.received is not None and found.received != len(found.answers):
            yield f"{self._file}: ping counted {found.received} answers and printed {len(found.answers)}"
        # iputils takes 0 for a time below it, and says "time of day goes back" in its log.
        if 0.0 in found.rtt_s:
            yield f"{self._file} has an answer that took no time: the clock was set back while ping waited"
        roles = (self.sender, self.receiver)
        unseen = [what for role in roles if view.captured(role) for what in self._unseen(found, role, view)]
        yield from unseen or self._contradictions(found, view)
        # A capture that lacks this attempt's own packets does not tell whose others are.
        if not unseen and view.captured(*roles) and (earlier := self._earlier(view)):
            of = f"{format_count(earlier, 'packet')} came of a ping that sent none in this one"
            yield f"packets of an earlier attempt were still on the way: {of}"

    def _contradictions(self, found: Ping, view: View) -> Iterator[str]:
        """Yield the contradictions with the ping in each capture that has the fewest, where several run."""
        asks, answers = (view.scene.robot(end).address for end in (self.sender, self.receiver))
        for role in (self.sender, self.receiver):
            capture = view.capture(role)
            if capture is None or found.payload_bytes is None or (capture.packets.time_ns == NO_TIME).any():
                continue
            pings = echoes.of_each_ping(capture.packets, asks, answers, found.payload_bytes)
            on_sender = role == self.sender
            reasons = [list(ping_checks.beside(found, one, self.interval, role, asks=on_sender)) for one in pings]
            yield from (f"{self._file}: {why}" for why in min(reasons, key=len, default=[]))

    def _unseen(self, found: Ping, role: Role, view: View) -> Iterator[str]:
        """Yield what ping printed more of than there is in a capture: answers, and requests that were answered.

        A ping that runs beside has another identifier, most often another size, or both: whichever of those in the
        capture this one is, none has more than the fullest.
        """
        capture = view.capture(role)
        if capture is None:
            return
        asks, answers = (view.scene.robot(end).address for end in (self.sender, self.receiver))
        packets = capture.packets
        echoes = packets.where((packets.echo != NO_ECHO) & _fits(packets, found.payload_bytes))
        seen = (
            (len(found.replies), "answer", _fullest(_icmp(echoes, answers, asks))),
            (len(found.answers), "answered request", _fullest(_icmp(echoes, asks, answers))),
        )
        for printed, what, captured in seen:
            if printed > captured:
                yield f"{self._file} has {format_count(printed, what)}, and the {role}'s capture holds {captured}"
                return

    def _earlier(self, view: View) -> int:
        """Return how many packets arrived of pings of which no request left while this one was captured.

        A ping that runs beside is none, nor is a reply that its sender's capture missed at its end. Of fragments
        that came without their first one those of requests count: captures outlive the ping that sends them.
        """
        near, far = (view.capture(role) for role in (self.sender, self.receiver))
        if near is None or far is None:
            return 0
        asks, answers = (view.scene.robot(role).address for role in (self.sender, self.receiver))
        left, came = (_icmp(capture.packets, asks, answers) for capture in (near, far))
        back = _icmp(near.packets, answers, asks)
        asked = (came.echo != NO_ECHO) & (came.echo < ECHO_REPLY)
        own = np.isin(came.echo, left.echo)
        earlier = int((asked & ~own).sum())
        earlier += int(((back.echo >= ECHO_REPLY) & ~np.isin(back.echo - ECHO_REPLY, left.echo)).sum())
        # A router may give other ids, by which fragments are known.
        if np.isin(came.ip_id[asked & own], left.ip_id).all():
            earlier += int(((came.fragment_offset > 0) & ~np.isin(came.ip_id, left.ip_id)).sum())
        return earlier

    @override
    def output_columns(self) -> tuple[Column, ...]:
        return (*self.columns, *ping.GAP_COLUMNS, *ping.OPEN_GAP_COLUMNS) if self.gap else self.columns

    @override
    def measure(self, view: View) -> Measured:
        found = view.evidence.read_or_none(ping.read, self._file)
        replied_ns = [at_ns for reply in found.answers if (at_ns := reply.at_utc_ns)] if found else []
        ends = self.sender, self.receiver
        gap = ping.measure_gap(found, self.interval) if self.gap else Measured()
        return ping.measure(found) | gap | where.measure(view.evidence, ping.WAY_COLUMNS, ends, replied_ns)

    @override
    def summary(self, values: Mapping[str, Value]) -> Iterator[str]:
        if isinstance(loss := values.get("rtt_loss"), float | int):
            unanswered = f" ({format_count(int(values['rtt_sent']), 'request')}, no reply)" if loss >= 1 else ""
            yield f"ping loss {100 * loss:.1f} %{unanswered}"
        if isinstance(gap_s := values.get("rtt_gap_s"), float):
            yield f"longest gap {gap_s:.1f} s with {values['rtt_gap_lost']} lost"
        if isinstance(open_s := values.get("rtt_gap_at_least_s"), float):
            yield f"longest gap >= {open_s:.1f} s with {values['rtt_gap_lost_at_least']} lost"
        if isinstance(median_s := values.get("rtt_median_s"), float):
            yield f"RTT {1e3 * median_s:.1f} ms"

    @override
    def expected_s(self, protocol: Protocol) -> float:
        return (self.count - 1) * self.interval


def _fits(packets: Packets, payload_bytes: int | None) -> Mask:
    """Return which packets may be echoes with so much payload: whole ones, or first fragments."""
    if payload_bytes is None:
        return np.ones(len(packets), dtype=np.bool_)
    size = payload_bytes + _HEADER_BYTES
    fits: Mask = np.where(packets.more_fragments, packets.ip_payload_bytes < size, packets.ip_payload_bytes == size)
    return fits


def _fullest(echoes: Packets) -> int:
    """Return how many packets the identifier has that has the most."""
    _, counts = np.unique(echoes.echo, return_counts=True)
    return int(counts.max(initial=0))


def _icmp(packets: Packets, source: str, destination: str) -> Packets:
    """Return the ICMP packets from one address to another."""
    return packets.where((packets.protocol == ICMP) & packets.are_from(source) & packets.are_to(destination))
