"""Data that steps and those who run them hand each other: scenes, jobs, needs, flows."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import ClassVar, Final

from fieldkit.backends.protocols import Cast, Robot
from fieldkit.config.programs import LabProgram
from fieldkit.core import geometry
from fieldkit.core.errors import RobotError
from fieldkit.core.model import OnAbort, Placement, Protocol, Role, Vector, Verdict
from fieldkit.core.threads import Halt
from fieldkit.measure.evidence.endings import Cause
from fieldkit.remote.jobs import Job
from fieldkit.remote.shell import Shell
from fieldkit.steps import variants
from fieldkit.steps.motions import Motions
from fieldkit.steps.origins import MemoryOrigins, Origins
from fieldkit.steps.variants import Tool, Variants

Shells = Mapping[Role, Shell]
Announce = Callable[[str, float | None], None]
"""Told the name of a phase that begins, and how many seconds it should take where that is known."""

_SEGMENT_BYTES: Final = 1448
"""Payload of a full TCP segment in an Ethernet frame, with time stamps."""

GOOD_BIT_S: Final = 25e6
"""About what TCP brings over a good link of 802.11n, with one stream in 20 MHz."""

_HEADER_BYTES: Final = 8
_FRAGMENT_BYTES: Final = 1480
"""What an IPv4 packet carries in an Ethernet frame: of UDP and ICMP, their headers too."""

BY_ITSELF: Final = frozenset({Cause.ITSELF})
BY_LIMIT: Final = frozenset({Cause.LIMIT})
BY_ITSELF_OR_LIMIT: Final = BY_ITSELF | BY_LIMIT
BY_FIELDKIT: Final = frozenset({Cause.ASKED})


@dataclass(frozen=True)
class RecordedFile:
    """A file that a step makes on a robot, for others to send.

    Attributes:
        role: On whose robot.
        name: Its name, below the attempt's folder.
        size_bytes: About how large it gets.
        called: What a procedure may call it, too, whatever name its maker gives it.
    """

    role: Role
    name: str
    size_bytes: float
    called: str = ""


@dataclass(frozen=True)
class Scene:
    """One attempt at one repeat, as far as command lines and measures depend on it.

    Attributes:
        protocol: The transport protocol under test.
        cast: Who plays which role.
        folder: The attempt's folder on every robot.
        recorded: The files that the procedure makes on each robot, in the order in which it does.
        variants: Which tools the robots have, where that was looked up.
        here: The attempt's folder on this machine, for what no robot can know; None where no attempt is made.
        placement: Where the robots were placed; None where nobody placed them.
        repeat: Number of the repeat of its protocol, from 1; None where it holds for all repeats.
        flows: What all steps of the procedure send over the radio.
        on_abort: What becomes of a drone where the attempt is cut short; those that are not there land.
        halt: Ends what waits, where the steps are not to go on.
        motions: The robots that move by themselves, which the operator may stop.
        origins: Origins of the robots that move by themselves, and the record of each motion.
    """

    protocol: Protocol
    cast: Cast
    folder: str
    recorded: Mapping[Role, tuple[RecordedFile, ...]] = field(default_factory=lambda: MappingProxyType({}))
    variants: Mapping[Role, Variants] = field(default_factory=lambda: MappingProxyType({}))
    here: Path | None = None
    placement: Placement | None = None
    repeat: int | None = None
    flows: "tuple[Flow, ...]" = ()
    on_abort: Mapping[Role, OnAbort] = field(default_factory=lambda: MappingProxyType({}))
    halt: Halt = field(default_factory=Halt, compare=False, repr=False)
    motions: Motions = field(default_factory=Motions, compare=False, repr=False)
    origins: Origins = field(default_factory=MemoryOrigins, compare=False, repr=False)

    def robot(self, role: Role) -> Robot:
        """Return the robot in `role`."""
        return self.cast[role]

    def tools(self, role: Role) -> Variants:
        """Return the tools of the robot in `role`: those found, or those that its profile lets expect."""
        return self.variants.get(role) or variants.expected(self.cast[role].profile)

    @property
    def places_m(self) -> Mapping[Role, Vector]:
        """Where robots were placed, as `geometry.positions_m` has it; empty where nobody placed them."""
        return {} if self.placement is None else geometry.positions_m(self.placement)

    def failure(self, planned: "Planned", what: str) -> RobotError:
        """Return what to raise where a job did not do what it was to; its log says more.

        Args:
            planned: The job.
            what: In one sentence without a full stop.
        """
        return RobotError(what, where=self.robot(planned.role).name, remedy=f"see {planned.job.log} of this repeat")


@dataclass(frozen=True)
class PutProgram:
    """A program of the lab that is copied to a robot before the first step of an attempt.

    Attributes:
        role: To whose robot.
        program: The program.
        at: Its path there, below the attempt's folder.
    """

    role: Role
    program: LabProgram
    at: str


@dataclass(frozen=True)
class Planned:
    """A job that a step will run.

    Attributes:
        role: Whose robot runs it.
        job: The job.
        program: The tool behind the command line, which preflight looks for.
        setup: Shell files to source before looking for it.
        tool: Which tool that is, if it is one that has variants.
        ends: Who may end it; ended by anybody else its evidence is not whole.
        least_s: How long it runs at least where it ends by itself and nothing cuts it short, in seconds.
        remedy: What to do where the program is missing; empty where the profile or a package is to blame.
        put: Program of the lab that the job needs on the robot; None where it needs none.
    """

    role: Role
    job: Job
    program: str
    setup: tuple[str, ...] = ()
    tool: Tool | None = None
    ends: frozenset[Cause] = BY_ITSELF
    least_s: float = 0.0
    remedy: str = ""
    put: PutProgram | None = None


@dataclass(frozen=True)
class Refusal:
    """Why a step cannot work with the tools that a robot has.

    Attributes:
        role: Whose robot.
        what: Why not, in one sentence without a full stop.
        remedy: What to do about it.
    """

    role: Role
    what: str
    remedy: str


@dataclass(frozen=True)
class Said:
    """Output of a command that preflight ran on a robot.

    Attributes:
        text: Its output and errors.
        code: Its exit code.
    """

    MISSING: ClassVar[int] = 127
    """Exit code of a command that a shell does not find."""

    text: str
    code: int

    @property
    def ok(self) -> bool:
        """Whether the command succeeded."""
        return self.code == 0


@dataclass(frozen=True)
class Need:
    """A right or a setting that a step needs of a robot, beside programs; preflight asks for it.

    Attributes:
        role: Of whose robot.
        name: What is checked.
        argv: Command that changes nothing.
        judge: Makes of its answer a verdict, a detail, and a remedy that is empty where all is well.
        of: Program that must be there for the answer to mean anything; empty where there is none.
        explains: Program that is not found because this need is not met; empty where there is none.
        agent: Whether the command is of the agent, which is put on the robot before.
    """

    role: Role
    name: str
    argv: tuple[str, ...]
    judge: Callable[[Said], tuple[Verdict, str, str]]
    of: str = ""
    explains: str = ""
    agent: bool = False


@dataclass(frozen=True)
class Pinging:
    """Round-trip times that a step measures.

    Attributes:
        role: Whose robot asks, and prints them.
        file: What it printed, in an attempt's folder.
        name: Name of the step, empty without one.
    """

    role: Role
    file: str
    name: str


@dataclass(frozen=True)
class Flow:
    """Packets that a step sends from one robot to another.

    Attributes:
        source: Who sends.
        destination: Who receives.
        port: Port that one of them listens on; None where the packets have none.
        frames: About how many Ethernet frames they are, answers too: `frames`.
        protocol: Transport protocol; None for the one under test.
        group: A multicast group that either of them sends to as well; None where neither does.
        served: Whether it is a program of the source that listens, which is there anyway.
    """

    source: Role
    destination: Role
    port: int | None = None
    frames: float = 0.0
    protocol: Protocol | None = None
    group: str | None = None
    served: bool = False


@dataclass(frozen=True)
class ListeningPort:
    """A port that a step listens on for another robot.

    Attributes:
        role: Whose robot listens.
        port: On which port.
        peer: Who speaks to it.
        source: Who of the two sends the data, where the step knows its connections by the ports of both ends; None
            where it knows them by this port alone.
        by: Key of the step that gives it another port.
        shared: Whether others may listen there at the same time, for who else does.
    """

    role: Role
    port: int
    peer: Role
    source: Role | None = None
    by: str = "port"
    shared: bool = False

    def looks_like(self, other: "ListeningPort") -> bool:
        """Return whether packets of both in one capture cannot be told apart."""
        alike = (self.role, self.port, self.peer) == (other.role, other.port, other.peer)
        opposite = None not in {self.source, other.source} and self.source != other.source
        return alike and not opposite


def frames(protocol: Protocol, size_bytes: float, payload_bytes: int) -> float:
    """Return about how many Ethernet frames carry so many bytes, with TCP's acknowledgements.

    Args:
        protocol: What carries them.
        size_bytes: How many.
        payload_bytes: How many of them are in one datagram, where they are in datagrams.
    """
    if protocol is Protocol.TCP:
        return 2 * size_bytes / _SEGMENT_BYTES
    return size_bytes / payload_bytes * fragments(payload_bytes)


def fragments(payload_bytes: int) -> int:
    """Return how many Ethernet frames carry a datagram of UDP, or an echo request, with so much payload."""
    return math.ceil((payload_bytes + _HEADER_BYTES) / _FRAGMENT_BYTES)
