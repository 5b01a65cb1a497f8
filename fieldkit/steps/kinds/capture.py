"""Capture packets on several robots while other steps run."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Annotated, Final

import numpy as np
from typing_extensions import override

from fieldkit.backends.protocols import Testbed
from fieldkit.config import schema
from fieldkit.config.profiles import RobotProfile
from fieldkit.config.schema import Field, Int
from fieldkit.core.columns import Measured, columns
from fieldkit.core.crosschecks import CrossCheck
from fieldkit.core.errors import EvidenceError, FieldkitError
from fieldkit.core.model import Protocol, Role, Verdict, sort_roles
from fieldkit.core.threads import run_parallel
from fieldkit.core.units import format_count
from fieldkit.measure.captures import pcap
from fieldkit.measure.captures.arrays import NO_TIME
from fieldkit.measure.captures.pcap import Capture
from fieldkit.measure.evidence import host, tcpdump_log
from fieldkit.measure.evidence.tcpdump_log import capture_file, log_file
from fieldkit.measure.transfers import altered_packets
from fieldkit.remote import jobs
from fieldkit.remote.command import quote
from fieldkit.remote.jobs import Job
from fieldkit.steps import base
from fieldkit.steps.base import Step, StepEntry
from fieldkit.steps.capabilities import ChecksPlacement, HasNeeds, UsesSpace
from fieldkit.steps.nest import Nest, flows_inside, steps_inside
from fieldkit.steps.over_link import OverLink
from fieldkit.steps.scene import BY_FIELDKIT, Announce, CommandResult, Flow, Need, Planned, Scene
from fieldkit.steps.surroundings import EarlierStep, EnclosingStep
from fieldkit.steps.variants import Tool
from fieldkit.steps.view import View

SNAP_BYTES: Final = 128
BUFFER_KIB: Final = 4096
"""Bytes of each frame that are captured, and size of the kernel's buffer. With tcpdump's defaults for these values,
the kernel dropped 177 of 215 packets of a burst in immediate mode; with these values, it dropped none."""

LIMIT_S: Final = 900.0
"""Time limit of a capture in addition to the limits of the steps inside."""

_RECORD_BYTES: Final = 16
"""Size of the header of each captured frame in the file."""

RING_S: Final = 2
"""Waiting time after the steps inside, before tcpdump is stopped, if it does not support immediate mode. The kernel
then passes packets to tcpdump with a delay of up to a second: of 215 packets, tcpdump had none after 0.5 s and all
after 1.0 s."""

LAST_LINE: Final = "dropped by kernel"
"""Text of tcpdump's last line. After this line the kernel needs 15 to 31 ms to close the socket."""

BACK_S: Final = 0.1
"""Permitted step backwards between time stamps: packets received by two processors may be recorded out of order."""

STAMP_NS: Final = 1_000
"""Resolution of time stamps: tcpdump truncates them to microseconds."""


class CaptureStep(Nest, OverLink, ChecksPlacement, HasNeeds, UsesSpace):
    """Runs tcpdump on each robot. It starts before the steps in `during` and ends after them.

    The filter accepts the ports of the steps inside, ICMP, and every later IP fragment between the robots of these
    steps (a port filter matches only first fragments). The columns on losses and delays of a transfer are empty
    unless the transfer is inside a capture on both of its robots. [One-way delay](method-delay.md#one-way-delay)
    needs the offset between the two clocks, which is computed from packets in both directions. A UDP transfer has no
    answer, so put a `ping` after it, inside the capture. A link with the interface `lo` is an address that a routing
    daemon reaches over any interface ([links](links.md)). For such a link, tcpdump captures on all interfaces; do not
    use it on a robot with a bridge or bond, where each packet appears twice. Writes `ROLE.pcap` and
    `ROLE-capture.log`.

    Attributes:
        over: Link to capture, by its name in [the profiles of the robots](links.md); without it, the radio under
            test.
        robots: Roles that capture.
        port: A port to capture in addition to the ports of the steps inside.
        during: Steps to capture.
    """

    columns = columns(
        70,
        ("sender_captured", "count", "Packets in the sender's capture."),
        ("sender_capture_dropped", "count", "Packets that the sender's kernel dropped before tcpdump."),
        ("receiver_captured", "count", "Packets in the receiver's capture."),
        ("receiver_capture_dropped", "count", "Packets that the receiver's kernel dropped before tcpdump."),
    )

    cross_checks = (
        CrossCheck(
            quantity="packets captured and dropped",
            columns=("*_captured", "*_capture_dropped"),
            source="`ROLE.pcap`, `ROLE-capture.log`",
            against=(
                "each other",
                "each robot's clock before and after",
                "the order of times in the file",
                "checksums of IPv4 headers",
            ),
            tolerance=(
                "a packet may be 0.1 s earlier than the previous one, because two processors receive them; if only "
                "topics and pings run inside, packets may be dropped before tcpdump, and the columns that depend on "
                "them are empty"
            ),
        ),
    )

    robots: Annotated[tuple[Role, ...], Field(min_length=1)] = (Role.SENDER, Role.RECEIVER)
    port: Annotated[Int, Field(gt=0, lt=65536)] | None = None
    during: Annotated[tuple[StepEntry, ...], Field(min_length=1)]

    @schema.model_validator(mode="after")
    def _captures_once(self) -> "CaptureStep":
        if len(set(self.robots)) < len(self.robots):
            raise schema.validation_error("a robot is named twice", "robots")
        return self

    @override
    def placement_error(self, earlier: Sequence[EarlierStep], within: Sequence[EnclosingStep]) -> str | None:
        for step in self._leaves():
            if isinstance(step, OverLink) and step.over != self.over:
                step_link, capture_link = (
                    f"link {link}" if link else "the radio under test" for link in (step.over, self.over)
                )
                return (
                    f"a {step.kind_name()} uses {step_link}, but the capture around it is on {capture_link}; "
                    "see `over`"
                )
        return None

    @override
    def jobs(self, scene: Scene) -> Iterator[Planned]:
        for role in self.robots:
            yield self._planned_job(scene, role)
        yield from self.inside(scene)

    def _planned_job(self, scene: Scene, role: Role) -> Planned:
        profile = scene.robot(role).profile
        interface = self.capture_interface(scene, role)
        immediate = ("--immediate-mode",) if scene.tools(role).immediate_mode else ()
        options = ("-n", "-U", *immediate, "-s", str(self._snap_bytes), "-B", str(self._buffer_kib))
        job = Job(
            folder=scene.folder,
            name=self.prefixed_name("capture"),
            argv=(profile.tools.capture, "-i", interface, *options, "-w", self._file(role), self._filter(scene)),
            # The limit exceeds the captured jobs, because a capture that was stopped at its limit looks complete.
            limit_s=LIMIT_S + sum(planned.job.limit_s for planned in self.inside(scene)),
            log=self._log(role),
            ready="log:listening on",
            as_root=profile.tools.capture_right == "sudo",
        )
        return Planned(role, job, program=profile.tools.capture, tool=Tool.CAPTURE, permitted_causes=BY_FIELDKIT)

    @property
    def _snap_bytes(self) -> int:
        return max(SNAP_BYTES, *(step.kept_bytes for step in steps_inside(self)))

    @property
    def _buffer_kib(self) -> int:
        return max(BUFFER_KIB, *(step.capture_buffer_kib for step in self._leaves()))

    @property
    def _needs_all_packets(self) -> bool:
        """Whether a packet dropped before tcpdump makes the repeat void; see `Step.needs_complete_capture`."""
        return any(step.needs_complete_capture for step in self._leaves())

    def _leaves(self) -> Iterator[Step]:
        """Yield the steps inside, at any depth, that contain no steps."""
        return (step for step in steps_inside(self) if not isinstance(step, Nest))

    def _filter(self, scene: Scene) -> str:
        """Return the capture filter (pcap-filter(7))."""
        flows = list(flows_inside(self, scene)) or [Flow(Role.SENDER, Role.RECEIVER)]
        pairs = dict.fromkeys(frozenset({flow.source, flow.destination}) for flow in flows)
        hosts = [
            " and ".join(f"host {scene.link(role, self.over).address}" for role in sort_roles(pair)) for pair in pairs
        ]
        groups = {(flow.group, role) for flow in flows if flow.group for role in (flow.source, flow.destination)}
        hosts += [
            f"src host {scene.link(role, self.over).address} and dst host {group}" for group, role in sorted(groups)
        ]
        ports = dict.fromkeys(port for port in (*(flow.port for flow in flows), self.port) if port is not None)
        # `ip[6:2] & 0x1fff` is the fragment offset, which is 0 only in unfragmented packets and first fragments.
        packet_kinds = " or ".join((*(f"port {port}" for port in ports), "icmp", "ip[6:2] & 0x1fff != 0"))
        host_filter = hosts[0] if len(hosts) == 1 else f"({' or '.join(f'({pair})' for pair in hosts)})"
        return f"{host_filter} and ({packet_kinds})"

    @override
    def needs(self, scene: Scene) -> Iterator[Need]:
        """Yield the check of the permission to capture."""
        for role in self.robots:
            profile = scene.robot(role).profile
            tools = profile.tools
            # A capture with sudo runs the job script as root, so that the script can signal its children.
            prefix = ("sudo", "-n", "sh", "-c", 'exec "$@"', "sh") if tools.capture_right == "sudo" else ()
            # The list of link types needs the same permission as a capture, because it opens the interface.
            argv = (*prefix, tools.capture, "-L", "-i", self.capture_interface(scene, role))
            name = f"right to capture{f' on {self.over}' if self.over else ''}"
            yield Need(role, name, argv, partial(_judge, profile), required_program=tools.capture)

    @override
    def stored_bytes(self, scene: Scene, role: Role) -> float:
        if role not in self.robots:
            return 0.0
        return (self._snap_bytes + _RECORD_BYTES) * sum(flow.frames for flow in flows_inside(self, scene))

    @override
    def captures(self) -> Mapping[Role, str]:
        return {role: self._file(role) for role in self.robots}

    def _file(self, role: Role) -> str:
        return self.prefixed_name(capture_file(role))

    def _log(self, role: Role) -> str:
        return self.prefixed_name(log_file(role))

    @override
    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        captures = [self._planned_job(scene, role) for role in self.robots]
        first, *others = (entry.step for entry in self.during)
        first_actions: list[Callable[[Announce], None]] = []

        def prepare() -> None:
            first_actions.append(base.prepare(first, scene, testbed))

        starts: list[Callable[[], None]] = [
            partial(jobs.start, testbed.shells[capture.role], capture.job) for capture in captures
        ]
        # With sudo the first step is prepared after the captures have started. sudo may take seconds if the robot's
        # host name cannot be resolved, and a UDP listener that the first step has started would stop waiting.
        rounds = ([*starts], [prepare]) if any(capture.job.as_root for capture in captures) else ([*starts, prepare],)
        announce("start captures", None)
        try:
            for calls in rounds:
                run_parallel(lambda call: call(), calls)
            for run_first in first_actions:
                run_first(announce)
            for step in others:
                step.run(scene, testbed, announce)
        except FieldkitError:
            # The captures are kept with the failed attempt. The first error is the cause of the failure.
            with suppress(FieldkitError):
                self._stop(scene, testbed, captures)
            raise
        announce("drain captures", None)
        for capture, code in zip(captures, self._stop(scene, testbed, captures), strict=True):
            if code != 0:
                raise scene.failure(capture, f"tcpdump ended with exit code {code}")

    def _stop(self, scene: Scene, testbed: Testbed, captures: Sequence[Planned]) -> list[int]:
        """Stop the captures; return the exit code of each."""

        def stop(capture: Planned) -> int:
            if not scene.tools(capture.role).immediate_mode:
                jobs.begin_wait(testbed.shells[capture.role], capture.job, RING_S).end(RING_S + jobs.REPLY_S)
            shell, file = testbed.shells[capture.role], self._file(capture.role)
            return jobs.stop(shell, capture.job, settle=file, end_text=LAST_LINE)

        return run_parallel(stop, captures)

    @override
    def exclusive_resources(self) -> tuple[str, ...]:
        return tuple(f"a capture on {role}" for role in self.robots)

    @override
    def files(self) -> tuple[str, ...]:
        return tuple(name for role in self.robots for name in (self._file(role), self._log(role)))

    def check(self, view: View) -> Iterator[str]:
        """Yield a reason for each incomplete or contradictory capture, and for dropped packets; see `Step.check`.

        Dropped packets are permitted if each step inside leaves the columns that depend on them empty.
        """
        for role in self.robots:
            for problem in _problems(
                role, self._file(role), self._log(role), view, needs_all=self._needs_all_packets
            ):
                yield f"{role} capture: {problem}"

    @override
    def measure(self, view: View) -> Measured:
        measured = Measured()
        for role in (Role.SENDER, Role.RECEIVER):
            if role not in self.robots:
                role_columns = [column for column in self.columns if column.name.startswith(f"{role}_")]
                measured |= Measured.all_missing(role_columns, f"the {role} does not capture")
                continue
            capture = view.evidence.undamaged_capture(self._file(role))
            log = view.evidence.read_or_none(tcpdump_log.read, self._log(role))
            values = {
                f"{role}_captured": capture.frames if capture else None,
                f"{role}_capture_dropped": log.dropped_by_kernel if log else None,
            }
            measured |= Measured.from_optional(values, "its capture is incomplete")
        return measured

    @override
    def expected_s(self, protocol: Protocol) -> float:
        return 0.2 + self.inside_s(protocol)


def _problems(role: Role, file: str, log_file: str, view: View, *, needs_all: bool) -> Iterator[str]:
    """Yield the reasons why a robot's capture cannot be used; with `needs_all`, also if packets were dropped."""
    try:
        log = view.evidence.read(tcpdump_log.read, log_file)
        capture = view.evidence.read(pcap.read, file)
    except EvidenceError as error:
        yield error.what
        return
    if not log.listening:
        yield "tcpdump was not listening"
    if log.captured is None:
        yield "tcpdump ended without its counters"
        return
    if needs_all and (log.dropped_by_kernel or log.dropped_by_interface):
        dropped_text = format_count(log.dropped_by_kernel or 0, "packet")
        yield f"its kernel dropped {dropped_text}, its interface {log.dropped_by_interface or 0}"
    # The filter may have matched more packets than were written: see `CaptureLog.received_by_filter`.
    if log.received_by_filter is not None and log.received_by_filter < log.captured:
        yield f"{format_count(log.received_by_filter, 'packet')} matched the filter, but tcpdump wrote {log.captured}"
    if capture.damage is not None:
        yield capture.damage
    elif capture.frames != log.captured:
        yield f"the file has {format_count(capture.frames, 'packet')}, but tcpdump counted {log.captured}"
    else:
        if problem := altered_packets.header_problem(capture.packets):
            yield problem
        yield from _time_problems(role, capture, view)


def _time_problems(role: Role, capture: Capture, view: View) -> Iterator[str]:
    """Yield a reason for packet times that run backwards, or that the robot's clock excludes.

    The clock is read before and after the attempt, so no packet can be earlier or later.
    """
    times_ns = capture.packets.time_ns[capture.packets.time_ns != NO_TIME]
    if not len(times_ns):
        return
    back_s = float(-np.diff(times_ns).min(initial=0)) / 1e9
    if back_s > BACK_S:
        yield f"a packet is {back_s:.3f} s earlier than the one before it: the clock was set back"
    before, after = (
        view.evidence.read_or_none(host.read_state, file(role)) for file in (host.before_file, host.after_file)
    )
    if before and before.clock and times_ns.min() < before.clock.first_ns - STAMP_NS:
        early_s = (before.clock.first_ns - int(times_ns.min())) / 1e9
        yield f"has a packet from {early_s:.3f} s before the start of the attempt, by the robot's clock"
    if after and after.clock and times_ns.max() > after.clock.last_ns + STAMP_NS:
        late_s = (int(times_ns.max()) - after.clock.last_ns) / 1e9
        yield f"has a packet from {late_s:.3f} s after the end of the attempt, by the robot's clock"


def _judge(profile: RobotProfile, answer: CommandResult) -> tuple[Verdict, str, str]:
    """Return verdict, detail and remedy for the permission of a robot's user to capture."""
    tools = profile.tools
    if answer.ok:
        return Verdict.OK, "by sudo -n" if tools.capture_right == "sudo" else "permission of the user", ""
    if tools.capture_right == "direct":
        remedy = f"sudo setcap cap_net_raw,cap_net_admin+eip $(command -v {quote((tools.capture,))})"
    elif answer.code == CommandResult.MISSING:
        return Verdict.FAIL, "there is no sudo", f"write capture_right: direct in profile {profile.name}"
    else:
        remedy = 'echo "$USER ALL=(ALL) NOPASSWD: $(command -v sh)" | sudo tee /etc/sudoers.d/fieldkit'
    return Verdict.FAIL, answer.text, remedy
