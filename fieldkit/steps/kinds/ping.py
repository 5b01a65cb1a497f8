"""Measure round-trip times with ping."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import product
from typing import TYPE_CHECKING, Annotated, Final, Self

from typing_extensions import override

from fieldkit.backends.protocols import Testbed
from fieldkit.config import schema
from fieldkit.config.profiles import LinkName
from fieldkit.config.schema import Bool, Duration, Field, Int, Strict
from fieldkit.core.columns import Column, Measured, Value
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Protocol, Role
from fieldkit.core.units import format_count
from fieldkit.measure.checks import ping_checks
from fieldkit.measure.checks.ping_captures import PingCaptures
from fieldkit.measure.evidence import ping
from fieldkit.measure.positions import position_columns
from fieldkit.remote import jobs
from fieldkit.remote.jobs import Job
from fieldkit.steps import routing
from fieldkit.steps.along import AlongStep
from fieldkit.steps.capabilities import ChecksPlacement, HasNeeds, HasRefusals, Pings, SendsTraffic, Summarizes
from fieldkit.steps.over_link import OverLink
from fieldkit.steps.scene import Announce, Flow, Need, PingSource, Planned, Refusal, Scene, fragments
from fieldkit.steps.surroundings import EarlierStep, EnclosingStep
from fieldkit.steps.variants import PingTool, Tool
from fieldkit.steps.view import View, capture_around

if TYPE_CHECKING:
    from fieldkit.measure.checks.ping_duplicates import PingEchoes
    from fieldkit.measure.checks.ping_links import LinkEnds

REPLY_TIMEOUT_S: Final = 2
"""Time that ping waits for the reply to its last request (option `-W`)."""
MAX_SEQUENCE_COUNT: Final = 0xFFFF
"""Largest sequence number of an echo request, which has 16 bits (RFC 792). With more requests, numbers repeat."""
OLD_IPUTILS_MIN_INTERVAL_S: Final = 0.2
"""Shortest interval that iputils before 20210722 allows without root."""
MAX_COUNT: Final = 1_000_000
_SPARE_S: Final = 10.0
"""Time limit of the job in addition to the time that ping needs."""
_ROUNDING: Final = 1e-6
"""Rounding error that must not add a request when a duration is divided by the interval."""

Payload = Annotated[Int, Field(ge=0, le=65507)]


def command_line(scene: Scene, role: Role, options: Iterable[str], address: str) -> tuple[str, ...]:
    """Return the ping command of a robot. Its output is in English and has numeric addresses.

    It has time stamps unless the ping is busybox's.
    """
    # busybox has no option for time stamps, and never resolves names.
    stamp_options = () if scene.tools(role).ping is PingTool.BUSYBOX else ("-n", "-D")
    return ("env", "LC_ALL=C", scene.robot(role).profile.tools.ping, *stamp_options, *options, address)


class Payloads(Strict):
    """ICMP payload in bytes per protocol.

    The defaults are the window sizes in bytes that the paper (cited in docs/index.md) uses for TCP and UDP.

    Attributes:
        tcp: Payload in repeats that use TCP.
        udp: Payload in repeats that use UDP.
    """

    tcp: Payload = 502
    udp: Payload = 8192

    @schema.model_validator(mode="before")
    @classmethod
    def _expand_number(cls, data: object) -> object:
        """Accept a single number for both protocols."""
        return {"tcp": data, "udp": data} if isinstance(data, int) and not isinstance(data, bool) else data


class PingStep(AlongStep, OverLink, ChecksPlacement, HasRefusals, HasNeeds, SendsTraffic, Pings, Summarizes):
    """Measures round-trip times with ping. Writes `ping.txt`.

    Attributes:
        sender: Role that sends the requests.
        receiver: Role that answers.
        count: Number of echo requests.
        interval: Time between requests. For less than `200ms`, iputils before 20210722 needs root.
        payload_bytes: ICMP payload per protocol; one number sets both.
        gap: Whether columns report the longest time without an answer, `rtt_gap_s`, and the requests lost in it,
            `rtt_gap_lost`. If the ping started or ended in the gap, the columns have lower bounds
            (`rtt_gap_at_least_s`).
        duplicates: Whether a column reports the requests and replies that arrived again over another link,
            `rtt_duplicates`. It needs `over` with a link whose interface is `lo`, and a `capture` over this link on
            both robots around the ping.
        links: Names of links. For each link, columns report the requests sent over it, how many of them were lost,
            duplicates, and the failover time: `rtt_over_LINK_sent`, `..._lost`, `..._duplicates`, `..._failover_s`.
            The requirements are the same as for `duplicates`.
        forwarded: Whether robots forward packets for each other; the checks then require a routing daemon on each.
    """

    columns = (*ping.COLUMNS, *ping.SENT_COLUMNS, *ping.MOTION_COLUMNS)
    cross_checks = ping_checks.CROSS_CHECKS
    needs_complete_capture = False
    duration_key = "count"

    sender: Role = Field(alias="from")
    receiver: Role = Field(alias="to")
    count: Annotated[Int, Field(gt=0, le=MAX_COUNT)] = 10
    interval: Annotated[Duration, Field(ge=0.002)] = 0.2
    payload_bytes: Payloads = Payloads.defaults()
    gap: Bool = Field(default=False, exclude_if=schema.is_empty)
    duplicates: Bool = Field(default=False, exclude_if=schema.is_empty)
    links: list[LinkName] = Field(default_factory=list, exclude_if=schema.is_empty)
    forwarded: Bool = Field(default=False, exclude_if=schema.is_empty)

    @schema.model_validator(mode="after")
    def _has_two_ends(self) -> "PingStep":
        if self.sender == self.receiver:
            raise schema.validation_error(f"{self.sender} cannot ping itself; name another robot", "to")
        return self

    @override
    def placement_error(self, earlier: Sequence[EarlierStep], within: Sequence[EnclosingStep]) -> str | None:
        if not self._needs_interfaces:
            return super().placement_error(earlier, within)
        key = "duplicates" if self.duplicates else "links"
        if self.count > MAX_SEQUENCE_COUNT:
            return f"{key} allows at most {MAX_SEQUENCE_COUNT} requests, because their numbers repeat"
        if not self.over or not all(capture_around(within, role) for role in (self.sender, self.receiver)):
            return f"{key} needs `over`, and a capture on both robots around the ping"
        return super().placement_error(earlier, within)

    @property
    def _needs_interfaces(self) -> bool:
        """True if columns need the interface over which each echo arrived."""
        return self.duplicates or bool(self.links)

    @override
    def with_duration(self, seconds: float) -> Self:
        count = math.ceil(seconds / self.interval - _ROUNDING)
        return self.model_copy(update={"count": min(max(count, 1), MAX_COUNT)})

    @override
    def jobs(self, scene: Scene) -> Iterator[Planned]:
        for link, role in product(self.links, (self.sender, self.receiver)):
            scene.link(role, link)  # raises ConfigurationError if the robot has no such link
        requests = ("-c", str(self.count), "-i", f"{self.interval:g}", "-s", str(self.payload_of(scene.protocol)))
        options = (*requests, "-W", str(REPLY_TIMEOUT_S))
        yield Planned(
            self.sender,
            Job(
                folder=scene.folder,
                name=self.prefixed_name("ping"),
                argv=command_line(scene, self.sender, options, scene.link(self.receiver, self.over).address),
                limit_s=self.count * self.interval + REPLY_TIMEOUT_S + _SPARE_S,
                log=self._log,
                stdout=self._file,
            ),
            program=scene.robot(self.sender).profile.tools.ping,
            tool=Tool.PING,
        )

    def payload_of(self, protocol: Protocol) -> int:
        """Return the payload of a request under a protocol, in bytes."""
        return self.payload_bytes.udp if protocol is Protocol.UDP else self.payload_bytes.tcp

    @override
    def refusals(self, scene: Scene) -> Iterator[Refusal]:
        tools = scene.tools(self.sender)
        if tools.ping is PingTool.IPUTILS_OLD and not tools.root and self.interval < OLD_IPUTILS_MIN_INTERVAL_S:
            yield Refusal(
                self.sender,
                f"its ping allows an interval of {1e3 * self.interval:g} ms only for root (iputils before 20210722)",
                "interval: 200ms in the procedure, or user: root in the site file",
            )

    @override
    def needs(self, scene: Scene) -> Iterator[Need]:
        yield from self.route_needs(scene, self.sender, self.receiver)
        if self.forwarded:
            yield from routing.needs(scene)

    @override
    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        (planned,) = self.jobs(scene)
        announce("ping", self.expected_s(scene.protocol))
        shell = testbed.shells[self.sender]
        with shell.silence(planned.job.limit_s):
            code = jobs.run(shell, planned.job)
        if code not in {0, 1}:  # exit code 1: replies are missing, which is a valid result
            raise scene.failure(planned, f"ping ended with exit code {code}")

    @override
    def files(self) -> tuple[str, ...]:
        return (self._file, self._log)

    @property
    def _file(self) -> str:
        return self.prefixed_name(ping.FILE)

    @property
    def _log(self) -> str:
        return self.prefixed_name(f"{self.sender}-ping.log")

    @override
    def flows(self, scene: Scene) -> Iterator[Flow]:
        frame_count = 2 * self.count * fragments(self.payload_of(scene.protocol))
        yield Flow(self.sender, self.receiver, frames=frame_count, link=self.over)

    @override
    def ping_source(self) -> PingSource:
        return PingSource(self.sender, self._file, self.prefix)

    @override
    def check(self, view: View) -> Iterator[str]:
        """Yield a reason if requests are missing, or the output contradicts the captures."""
        try:
            result = view.evidence.read(ping.read, self._file)
        except EvidenceError:
            yield f"{self._file} is missing"
            return
        if result.transmitted is None:
            yield f"{self._file}: ping was stopped early; its summary is missing"
        elif result.transmitted < self.count:
            yield f"{self._file}: ping sent {result.transmitted} of {self.count} requests"
        payload_bytes, window = self.payload_of(view.scene.protocol), view.attempt_window(self.sender)
        yield from (
            f"{self._file}: {reason}"
            for reason in ping_checks.check_output(result, self.count, payload_bytes, window)
        )
        if self._needs_interfaces:
            from fieldkit.measure.checks import ping_duplicates  # noqa: PLC0415 (only with several links)

            reasons = ping_duplicates.contradictions(result, self.interval, *self._captured_echoes(view))
            yield from (f"{self._file}: {reason}" for reason in reasons)
        if result.received is not None and result.received != len(result.answers):
            answers_text = format_count(result.received, "answer")
            yield f"{self._file}: ping counted {answers_text} and printed {len(result.answers)}"
        # iputils reports 0 for a negative time, and "time of day goes back" in its log.
        if 0.0 in result.rtt_s:
            yield f"{self._file} has a round-trip time of 0: the clock was set back while ping waited"
        yield from self._captures(view).find_problems(result, self.interval)

    def _captures(self, view: View) -> PingCaptures:
        roles = (self.sender, self.receiver)
        source, destination = (view.scene.link(role, self.over).address for role in roles)
        return PingCaptures(
            self._file, self.sender, {role: view.capture(role) for role in roles}, source, destination
        )

    def _captured_echoes(self, view: View) -> "tuple[PingEchoes | None, ...]":
        return self._captures(view).echoes(self.payload_of(view.scene.protocol))

    def _link_ends(self, view: View) -> "dict[str, LinkEnds]":
        """Return the indices of the interfaces of each link."""
        from fieldkit.measure.checks.ping_links import LinkEnds  # noqa: PLC0415 (only with `links`)
        from fieldkit.measure.robot_state.interfaces import read_indices  # noqa: PLC0415 (as above)

        roles = (self.sender, self.receiver)
        indices = {role: read_indices(view.evidence, role) for role in roles}
        return {
            link: LinkEnds(*(indices[role].get(view.scene.link(role, link).interface) for role in roles))
            for link in self.links
        }

    @override
    def output_columns(self) -> tuple[Column, ...]:
        chosen: list[Column] = []
        if self.gap:
            from fieldkit.measure.evidence import ping_gaps  # noqa: PLC0415 (only with `gap: true`)

            chosen += [*ping_gaps.GAP_COLUMNS, *ping_gaps.OPEN_GAP_COLUMNS]
        if self.duplicates:
            from fieldkit.measure.checks import ping_duplicates  # noqa: PLC0415 (only with `duplicates: true`)

            chosen += ping_duplicates.COLUMNS
        if self.links:
            from fieldkit.measure.checks import ping_links  # noqa: PLC0415 (only with `links`)

            chosen += [column for link in self.links for column in ping_links.declare_columns(link)]
        return (*self.columns, *chosen)

    @override
    def measure(self, view: View) -> Measured:
        result = view.evidence.read_or_none(ping.read, self._file)
        reply_times_ns = [at_ns for reply in result.answers if (at_ns := reply.at_utc_ns)] if result else []
        ends = self.sender, self.receiver
        gap = Measured()
        if self.gap:
            from fieldkit.measure.evidence import ping_gaps  # noqa: PLC0415 (only with `gap: true`)

            gap = ping_gaps.measure_gap(result, self.interval)
        duplicates = Measured()
        if self.duplicates:
            from fieldkit.measure.checks import ping_duplicates  # noqa: PLC0415 (only with `duplicates: true`)

            duplicates = ping_duplicates.measure(*self._captured_echoes(view))
        by_link = Measured()
        if self.links:
            from fieldkit.measure.checks import ping_links  # noqa: PLC0415 (only with `links`)

            by_link = ping_links.measure(self._link_ends(view), *self._captured_echoes(view))
        return (
            ping.measure(result)
            | gap
            | duplicates
            | by_link
            | position_columns.measure(view.evidence, ping.MOTION_COLUMNS, ends, reply_times_ns)
        )

    @override
    def summary(self, values: Mapping[str, Value]) -> Iterator[str]:
        if isinstance(loss := values.get("rtt_loss"), float | int):
            no_reply_text = f" ({format_count(int(values['rtt_sent']), 'request')}, no reply)" if loss >= 1 else ""
            yield f"ping loss {100 * loss:.1f} %{no_reply_text}"
        if isinstance(gap_s := values.get("rtt_gap_s"), float):
            yield f"longest gap {gap_s:.1f} s with {values['rtt_gap_lost']} lost"
        if duplicates := values.get("rtt_duplicates"):
            yield f"{format_count(int(duplicates), 'packet')} received again over another link"
        if isinstance(open_s := values.get("rtt_gap_at_least_s"), float):
            yield f"longest gap >= {open_s:.1f} s with {values['rtt_gap_lost_at_least']} lost"
        if isinstance(median_s := values.get("rtt_median_s"), float):
            # Times of different sizes are not comparable: a large request takes longer on the same link.
            payload = values.get("rtt_payload_bytes")
            size = f" ({format_count(payload, 'byte')})" if isinstance(payload, int) else ""
            yield f"RTT {1e3 * median_s:.1f} ms{size}"

    @override
    def expected_s(self, protocol: Protocol) -> float:
        return (self.count - 1) * self.interval
