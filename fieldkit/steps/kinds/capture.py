"""Capture packets on several robots while other steps run."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Annotated, Final

from typing_extensions import override

from fieldkit.backends.protocols import Testbed
from fieldkit.config import schema
from fieldkit.config.profiles import InterfaceName, RobotProfile
from fieldkit.config.schema import Field, Int
from fieldkit.core.columns import Column, Measured, columns
from fieldkit.core.crosschecks import CheckOutcome, CrossCheck
from fieldkit.core.errors import FieldkitError
from fieldkit.core.model import Protocol, Role, Verdict, sort_roles
from fieldkit.core.threads import run_parallel
from fieldkit.measure.evidence import tcpdump_log
from fieldkit.measure.evidence.tcpdump_log import capture_file
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

    With `monitor`, a second tcpdump captures all frames of IEEE 802.11 on this interface, with radiotap headers: PHY
    rate, signal and retransmissions. It writes `ROLE-monitor.pcap` and `ROLE-monitor-capture.log`. The interface must
    be in monitor mode on the same radio: `iw dev wlan0 interface add mon0 type monitor`; `ip link set mon0 up`.

    Attributes:
        over: Link to capture, by its name in [the profiles of the robots](links.md); without it, the radio under
            test.
        robots: Roles that capture.
        port: A port to capture in addition to the ports of the steps inside.
        monitor: Monitor interface of the radio under test, such as `mon0`, on each robot that captures.
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
        CrossCheck(
            quantity="frames of a radio",
            columns=("*_monitor_*",),
            source="`ROLE-monitor.pcap`",
            against=(
                "`ROLE-link.txt`: counters, signal and rates",
                "`ROLE.pcap`: packets that the robot received",
                "`ROLE-monitor.pcap` of the other robot: sequence numbers and retry flags",
            ),
            tolerance=(
                "iw reads the driver up to 0.5 s after the time of a sample; signals may differ by 1 dB, and rates "
                "by 0.1 Mbit/s; rates during retransmissions are not compared, because radiotap has the rate of the "
                "first attempt and iw that of the last"
            ),
            outcome=CheckOutcome.WITHHELD,
        ),
    )

    robots: Annotated[tuple[Role, ...], Field(min_length=1)] = (Role.SENDER, Role.RECEIVER)
    port: Annotated[Int, Field(gt=0, lt=65536)] | None = None
    monitor: InterfaceName | None = Field(default=None, exclude_if=schema.is_empty)
    during: Annotated[tuple[StepEntry, ...], Field(min_length=1)]

    @schema.model_validator(mode="after")
    def _captures_once(self) -> "CaptureStep":
        if len(set(self.robots)) < len(self.robots):
            raise schema.validation_error("a robot is named twice", "robots")
        if self.monitor and self.over:
            raise schema.validation_error(
                "`monitor` is an interface of the radio under test; remove `over`", "monitor"
            )
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
        yield from (capture for capture, _ in self._planned_captures(scene))
        yield from self.inside(scene)

    def _planned_captures(self, scene: Scene) -> Iterator[tuple[Planned, str]]:
        """Yield the job and the file of each capture."""
        for role in self.robots:
            interface, packet_filter = self.capture_interface(scene, role), self._filter(scene)
            file = self._file(role)
            yield self._planned_job(scene, role, "capture", ("-i", interface), (file, packet_filter)), file
        if self.monitor:
            from fieldkit.steps import monitor_capture  # noqa: PLC0415 (few captures have a monitor interface)

            for role in self.robots:
                options, file = monitor_capture.options(self.monitor), self._monitor_file(role)
                yield self._planned_job(scene, role, "monitor", options, (file,)), file

    def _planned_job(
        self, scene: Scene, role: Role, name: str, source: tuple[str, ...], destination: tuple[str, ...]
    ) -> Planned:
        """Return a job of tcpdump.

        Args:
            scene: The attempt.
            role: Role of the robot.
            name: Name of the job.
            source: Options that select the interface.
            destination: The file, then the filter if there is one.
        """
        profile = scene.robot(role).profile
        immediate = ("--immediate-mode",) if scene.tools(role).immediate_mode else ()
        options = ("-n", "-U", *immediate, "-s", str(self._snap_bytes), "-B", str(self._buffer_kib))
        job = Job(
            folder=scene.folder,
            name=self.prefixed_name(name),
            argv=(profile.tools.capture, *source, *options, "-w", *destination),
            # The limit exceeds the captured jobs, because a capture that was stopped at its limit looks complete.
            limit_s=LIMIT_S + sum(planned.job.limit_s for planned in self.inside(scene)),
            log=tcpdump_log.capture_log_file(destination[0]),
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
            if self.monitor:
                from fieldkit.steps import monitor_capture  # noqa: PLC0415 (as in `_planned_captures`)

                yield monitor_capture.need(role, prefix, tools.capture, self.monitor)

    @override
    def stored_bytes(self, scene: Scene, role: Role) -> float:
        if role not in self.robots:
            return 0.0
        captures = 2 if self.monitor else 1
        return captures * (self._snap_bytes + _RECORD_BYTES) * sum(flow.frames for flow in flows_inside(self, scene))

    @override
    def captures(self) -> Mapping[Role, str]:
        return {role: self._file(role) for role in self.robots}

    def _file(self, role: Role) -> str:
        return self.prefixed_name(capture_file(role))

    def _monitor_file(self, role: Role) -> str:
        return self.prefixed_name(tcpdump_log.monitor_file(role))

    def _capture_files(self, role: Role) -> Iterator[str]:
        yield self._file(role)
        if self.monitor:
            yield self._monitor_file(role)

    @override
    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        captures = list(self._planned_captures(scene))
        first, *others = (entry.step for entry in self.during)
        first_actions: list[Callable[[Announce], None]] = []

        def prepare() -> None:
            first_actions.append(base.prepare(first, scene, testbed))

        starts: list[Callable[[], None]] = [
            partial(jobs.start, testbed.shells[capture.role], capture.job) for capture, _ in captures
        ]
        # With sudo the first step is prepared after the captures have started. sudo may take seconds if the robot's
        # host name cannot be resolved, and a UDP listener that the first step has started would stop waiting.
        rounds = (
            ([*starts], [prepare]) if any(capture.job.as_root for capture, _ in captures) else ([*starts, prepare],)
        )
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
        for (capture, _), code in zip(captures, self._stop(scene, testbed, captures), strict=True):
            if code != 0:
                raise scene.failure(capture, f"tcpdump ended with exit code {code}")

    def _stop(self, scene: Scene, testbed: Testbed, captures: Sequence[tuple[Planned, str]]) -> list[int]:
        """Stop the captures, which are given with their files; return the exit code of each."""

        def stop(capture_and_file: tuple[Planned, str]) -> int:
            capture, file = capture_and_file
            if not scene.tools(capture.role).immediate_mode:
                jobs.begin_wait(testbed.shells[capture.role], capture.job, RING_S).end(RING_S + jobs.REPLY_S)
            return jobs.stop(testbed.shells[capture.role], capture.job, settle=file, end_text=LAST_LINE)

        return run_parallel(stop, captures)

    @override
    def exclusive_resources(self) -> tuple[str, ...]:
        return tuple(f"a capture on {role}" for role in self.robots)

    @override
    def files(self) -> tuple[str, ...]:
        names = (name for role in self.robots for name in self._capture_files(role))
        return tuple(file for name in names for file in (name, tcpdump_log.capture_log_file(name)))

    def check(self, view: View) -> Iterator[str]:
        """Yield a reason for each incomplete or contradictory capture, and for dropped packets; see `Step.check`.

        Dropped packets are permitted if each step inside leaves the columns that depend on them empty.
        """
        from fieldkit.steps import capture_problems  # noqa: PLC0415 (a dry run checks no evidence)

        for role in self.robots:
            for problem in capture_problems.find(role, self._file(role), view, needs_all=self._needs_all_packets):
                yield f"{role} capture: {problem}"
            if self.monitor:
                # The columns are empty if frames were dropped; the repeat remains valid.
                for problem in capture_problems.find(role, self._monitor_file(role), view, needs_all=False):
                    yield f"{role} capture on {self.monitor}: {problem}"

    @override
    def measure(self, view: View) -> Measured:
        measured = Measured()
        for role in (Role.SENDER, Role.RECEIVER):
            if role not in self.robots:
                role_columns = [column for column in self.columns if column.name.startswith(f"{role}_")]
                measured |= Measured.all_missing(role_columns, f"the {role} does not capture")
                continue
            capture = view.evidence.undamaged_capture(self._file(role))
            log = view.evidence.read_or_none(tcpdump_log.read, tcpdump_log.capture_log_file(self._file(role)))
            values = {
                f"{role}_captured": capture.frames if capture else None,
                f"{role}_capture_dropped": log.dropped_by_kernel if log else None,
            }
            measured |= Measured.from_optional(values, "its capture is incomplete")
        if self.monitor:
            from fieldkit.steps import monitor_capture  # noqa: PLC0415 (as in `_planned_captures`)

            measured |= monitor_capture.measure(view, {role: self._capture_files(role) for role in self.robots})
        return measured

    @override
    def output_columns(self) -> tuple[Column, ...]:
        if not self.monitor:
            return self.columns
        from fieldkit.measure.checks import monitor_columns  # noqa: PLC0415 (as in `_planned_captures`)

        return (*self.columns, *monitor_columns.COLUMNS)

    @override
    def expected_s(self, protocol: Protocol) -> float:
        return 0.2 + self.inside_s(protocol)


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
