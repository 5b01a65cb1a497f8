"""Data exchanged between steps and the code that runs them: attempts, jobs, preflight checks, traffic."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, ClassVar, Final

from fieldkit.backends.protocols import Cast, Robot, RobotLink
from fieldkit.core import geometry
from fieldkit.core.errors import ConfigurationError, RobotError, did_you_mean
from fieldkit.core.model import Placement, Protocol, Role, Vector, Verdict
from fieldkit.core.threads import StopSignal
from fieldkit.measure.evidence.terminations import Cause
from fieldkit.remote.jobs import Job
from fieldkit.remote.shell import Shell
from fieldkit.steps import variants
from fieldkit.steps.motions import Motions
from fieldkit.steps.variants import Tool, Variants

if TYPE_CHECKING:
    from fieldkit.config.program_files import LabProgram

Shells = Mapping[Role, Shell]
Announce = Callable[[str, float | None], None]
"""Called with the name of a starting phase, and its expected duration in seconds or None."""

_SEGMENT_BYTES: Final = 1448
"""Payload of a full TCP segment with time stamps in an Ethernet frame."""

GOOD_BIT_S: Final = 25e6
"""Approximate TCP throughput on a good 802.11n link with one stream in 20 MHz."""

_HEADER_BYTES: Final = 8
"""Size of a UDP header, and of the ICMP header of an echo request."""

_FRAGMENT_BYTES: Final = 1480
"""Payload of an IPv4 packet in an Ethernet frame, including the UDP or ICMP header."""

BY_EXIT: Final = frozenset({Cause.EXITED})
BY_LIMIT: Final = frozenset({Cause.LIMIT})
BY_EXIT_OR_LIMIT: Final = BY_EXIT | BY_LIMIT
BY_FIELDKIT: Final = frozenset({Cause.STOPPED})
"""Values of `Planned.permitted_causes`: the job exits without being stopped, is stopped at its time limit, or is
stopped by fieldkit."""


@dataclass(frozen=True)
class RecordedFile:
    """A file that a step records on a robot, and that other steps may send.

    Attributes:
        role: Role of the robot.
        name: Its path, relative to the attempt's folder.
        size_bytes: Approximate size.
        alias: Alternative name in procedures, independent of the robot's recorder.
    """

    role: Role
    name: str
    size_bytes: float
    alias: str = ""


@dataclass(frozen=True)
class Scene:
    """One attempt at one repeat, with all data on which command lines and measurements depend.

    Attributes:
        protocol: The transport protocol under test.
        cast: The robot in each role.
        folder: The attempt's folder on every robot.
        recordings: The files that the procedure records on each robot, in the order of recording.
        variants: The detected tools of the robots; empty before the detection.
        laptop_folder: The attempt's folder on the laptop, for data that no robot has; None if no attempt is made.
        placement: The placement of the robots; None if the robots were not placed.
        repeat: Number of the repeat of its protocol, from 1; None if the scene is valid for all repeats.
        flows: The traffic of all steps of the procedure on the radio.
        sections: The sections of the procedure that installed packages added, by key.
        halt: Interrupts waits when the steps must not continue.
        motions: The robots that move automatically, which the operator may stop.
        origins: Start positions of the robots that move automatically, as an object of the package that moves them;
            None if no attempt is made.
    """

    protocol: Protocol
    cast: Cast
    folder: str
    recordings: Mapping[Role, tuple[RecordedFile, ...]] = field(default_factory=lambda: MappingProxyType({}))
    variants: Mapping[Role, Variants] = field(default_factory=lambda: MappingProxyType({}))
    laptop_folder: Path | None = None
    placement: Placement | None = None
    repeat: int | None = None
    flows: "tuple[Flow, ...]" = ()
    sections: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))
    halt: StopSignal = field(default_factory=StopSignal, compare=False, repr=False)
    motions: Motions = field(default_factory=Motions, compare=False, repr=False)
    origins: object = field(default=None, compare=False, repr=False)

    def robot(self, role: Role) -> Robot:
        """Return the robot in `role`."""
        return self.cast[role]

    def link(self, role: Role, name: str = "") -> RobotLink:
        """Return the robot's end of a link; an empty name means the radio under test.

        Raises:
            ConfigurationError: The robot has no such link.
        """
        robot = self.cast[role]
        link = robot.link(name)
        if link is None:
            profile = robot.profile
            raise ConfigurationError(
                f"{robot.name} ({role}) has no link {name!r}",
                remedy=did_you_mean(
                    name, profile.links, f"links of profile {profile.name}: {', '.join(profile.links) or 'none'}"
                ),
            )
        return link

    def tools(self, role: Role) -> Variants:
        """Return the detected tools of the robot in `role`, or the tools that are expected from its profile."""
        return self.variants.get(role) or variants.expected(self.cast[role].profile)

    @property
    def places_m(self) -> Mapping[Role, Vector]:
        """Positions at which the robots were placed, from `geometry.positions_m`; empty if they were not placed."""
        return {} if self.placement is None else geometry.positions_m(self.placement)

    def failure(self, planned: "Planned", what: str) -> RobotError:
        """Return the error of a job that failed, with its log as the remedy.

        Args:
            planned: The job.
            what: What happened, a sentence without a full stop.
        """
        return RobotError(what, where=self.robot(planned.role).name, remedy=f"see {planned.job.log} of this repeat")


@dataclass(frozen=True)
class PutProgram:
    """A program of the lab that is copied to a robot before the first step of an attempt.

    Attributes:
        role: Role of the robot.
        program: The program.
        at: Its path on the robot, relative to the attempt's folder.
    """

    role: Role
    program: "LabProgram"
    at: str


@dataclass(frozen=True)
class Planned:
    """A job that a step will run.

    Attributes:
        role: Role of the robot that runs it.
        job: The job.
        program: The program of the command line; a preflight check searches for it.
        setup: Shell files to source before this search.
        tool: The tool of the program; None if it has no variants.
        permitted_causes: Permitted causes of its end; after another cause its evidence is incomplete.
        min_duration_s: Minimum duration in seconds of a job that ended normally.
        remedy: What to do if the program is missing; empty for the default remedy on profile and package.
        put: Program of the lab that the job needs on the robot; None if it needs no such program.
    """

    role: Role
    job: Job
    program: str
    setup: tuple[str, ...] = ()
    tool: Tool | None = None
    permitted_causes: frozenset[Cause] = BY_EXIT
    min_duration_s: float = 0.0
    remedy: str = ""
    put: PutProgram | None = None


@dataclass(frozen=True)
class Refusal:
    """A reason why a step cannot run on a robot.

    Attributes:
        role: Role of the robot.
        what: The reason, a sentence without a full stop.
        remedy: What to do.
    """

    role: Role
    what: str
    remedy: str


@dataclass(frozen=True)
class CommandResult:
    """Result of the command of a preflight check on a robot.

    Attributes:
        text: Its standard output and standard error.
        code: Its exit code.
    """

    MISSING: ClassVar[int] = 127
    """Exit code of a shell if the command is not found."""

    text: str
    code: int

    @property
    def ok(self) -> bool:
        """Whether the command succeeded."""
        return self.code == 0


@dataclass(frozen=True)
class Need:
    """A permission or setting that a step needs on a robot, and the command of its preflight check.

    Attributes:
        role: Role of the robot.
        name: Name of the check.
        argv: Command that changes nothing on the robot.
        judge: Converts the result to a verdict, a detail, and a remedy, which is empty if the need is met.
        required_program: Program without which the check is skipped; empty if the check depends on no program.
        missing_program: Program whose absence is the cause if this need is not met. Its absence is then not reported
            separately. Empty if there is no such program.
        agent: Whether the command runs the agent, which is then installed first.
    """

    role: Role
    name: str
    argv: tuple[str, ...]
    judge: Callable[[CommandResult], tuple[Verdict, str, str]]
    required_program: str = ""
    missing_program: str = ""
    agent: bool = False


@dataclass(frozen=True)
class PingSource:
    """Round-trip times that a step measures.

    Attributes:
        role: Role of the robot that sends the requests and prints the times.
        file: File of the output in an attempt's folder.
        name: Name of the step; empty if it has no name.
    """

    role: Role
    file: str
    name: str


@dataclass(frozen=True)
class Flow:
    """Packets that a step sends from one robot to another.

    Attributes:
        source: Role of the sender.
        destination: Role of the receiver.
        port: Listening port of one of them; None if the packets have no ports.
        frames: Approximate number of Ethernet frames including answers.
        protocol: Transport protocol; None for the protocol under test.
        group: A multicast group to which either of them also sends; None without multicast.
        has_other_listener: Whether a program that the step does not start listens on the source.
        link: Name of the link that carries them; empty for the radio under test.
    """

    source: Role
    destination: Role
    port: int | None = None
    frames: float = 0.0
    protocol: Protocol | None = None
    group: str | None = None
    has_other_listener: bool = False
    link: str = ""


@dataclass(frozen=True)
class ListeningPort:
    """A port on which a robot listens for another robot.

    Attributes:
        role: Role of the listening robot.
        port: The port.
        peer: Role of the robot that connects or sends to it.
        source: Role of the robot (one of these two) that sends the data, if the step identifies its connections by
            the ports of both ends; None if it identifies them by this port alone.
        by: YAML key of the step that sets the port.
        shared: Whether several programs can listen on the port at the same time.
    """

    role: Role
    port: int
    peer: Role
    source: Role | None = None
    by: str = "port"
    shared: bool = False

    def is_ambiguous_with(self, other: "ListeningPort") -> bool:
        """Return True if the packets of both ports cannot be distinguished in a capture."""
        is_same = (self.role, self.port, self.peer) == (other.role, other.port, other.peer)
        # Data that flows in opposite directions can be distinguished.
        is_opposite = None not in {self.source, other.source} and self.source != other.source
        return is_same and not is_opposite


def frames(protocol: Protocol, size_bytes: float, payload_bytes: int) -> float:
    """Return the approximate number of Ethernet frames for a number of bytes, including acknowledgements of TCP.

    Args:
        protocol: Transport protocol.
        size_bytes: Number of bytes.
        payload_bytes: Payload of one datagram, if the protocol is UDP.
    """
    if protocol is Protocol.TCP:
        return 2 * size_bytes / _SEGMENT_BYTES
    return size_bytes / payload_bytes * fragments(payload_bytes)


def fragments(payload_bytes: int) -> int:
    """Return the number of Ethernet frames for a UDP datagram or an echo request with this payload."""
    return math.ceil((payload_bytes + _HEADER_BYTES) / _FRAGMENT_BYTES)
