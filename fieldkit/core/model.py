"""Immutable data types that all packages share."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, ClassVar, Final


class Role(str):
    """Role of a robot in a trial; procedures name roles, never hosts.

    Three roles are predefined (`FIXED_ROLES`). A procedure can define additional roles for robots that it places.
    Equal names give the same object.

    Args:
        name: For example `rival`.

    Raises:
        ValueError: It is not a valid name of a role.
    """

    SENDER: ClassVar["Role"]
    RECEIVER: ClassVar["Role"]
    RELAY: ClassVar["Role"]

    PATTERN: Final = r"[a-z][a-z0-9_]{0,30}"
    __slots__ = ()
    _instances: ClassVar[dict[str, "Role"]] = {}

    def __new__(cls, name: str) -> "Role":
        """Return the object of this name."""
        if (role := cls._instances.get(name)) is None:
            if not re.fullmatch(cls.PATTERN, name):
                raise ValueError(
                    "the name of a role consists of lower-case letters, digits and _, begins with a letter, and has "
                    "at most 31 characters"
                )
            role = cls._instances.setdefault(str(name), super().__new__(cls, name))
        return role

    @classmethod
    def __get_pydantic_core_schema__(cls, _: Any, handler: Any) -> Any:  # noqa: ANN401 (of pydantic, not imported here)
        return {
            "type": "function-after",
            "function": {"type": "no-info", "function": cls},
            "schema": handler(str),
        }


Role.SENDER, Role.RECEIVER, Role.RELAY = map(Role, ("sender", "receiver", "relay"))

FIXED_ROLES: Final = (Role.SENDER, Role.RECEIVER, Role.RELAY)
"""The predefined roles, in the order in which they are listed."""


def sort_roles(roles: Iterable[Role]) -> list[Role]:
    """Return roles in the order of listings: first the roles in `FIXED_ROLES`, then additional roles by name."""
    return sorted(
        roles, key=lambda role: (FIXED_ROLES.index(role) if role in FIXED_ROLES else len(FIXED_ROLES), role)
    )


ROS_MASTER_PORT: Final = 11311
"""Default TCP port of a ROS 1 master (wiki.ros.org/roscore)."""

BRIDGE_IS_UP: Final = "the bridge is up"
"""Start of the line that `fieldkit bridge` prints when it is ready to forward messages; a trial waits for it."""


class Protocol(StrEnum):
    """Transport protocol of the traffic of a repeat."""

    TCP = "tcp"
    UDP = "udp"


class Scenario(StrEnum):
    """Line of sight (`los`), or an obstacle between the robots (`nlos`)."""

    LOS = "los"
    NLOS = "nlos"


class Topology(StrEnum):
    """Whether traffic passes through the relay's access point or directly between the robots."""

    MASTER = "master"
    MASTERLESS = "masterless"


class Control(StrEnum):
    """Network of the SSH connections to the robots: a separate network, or the radio under test."""

    SEPARATE = "separate"
    RADIO = "radio"


class Status(StrEnum):
    """Status of a repeat, or of an attempt at it.

    `measured`: its steps have ended, and its evidence is still on the robots. `void`: the attempt is not valid, for
    example because a step failed or evidence is incomplete or contradictory; another attempt is allowed. `failed`:
    the attempt is not valid, and it was the last allowed one, or another attempt would have the same error.
    """

    PLANNED = "planned"
    RUNNING = "running"
    MEASURED = "measured"
    VALID = "valid"
    VOID = "void"
    FAILED = "failed"


MAX_REPEATS: Final = 100_000
"""Maximum number of repeats per protocol of one trial. A trial with this number would take weeks."""

LOOP: Final = "for"
"""Key of a loop in a list of steps."""
MAX_STEPS: Final = 1000
"""Maximum number of steps of a procedure's file after its loops are expanded."""

FINAL_STATUSES: Final = (Status.VALID, Status.VOID, Status.FAILED)
"""Statuses of an attempt that has ended."""


class Verdict(StrEnum):
    """Outcome of a check; the trial continues after `warn`, but not after `fail`."""

    OK = "ok"
    WARN = "warn"
    FAIL = "fail"


@dataclass(frozen=True)
class Distance:
    """A distance with the text that the operator wrote.

    Attributes:
        metres: The distance in metres, above zero.
        label: The operator's text, for example `30ft`.
    """

    metres: float
    label: str


@dataclass(frozen=True)
class Placement:
    """Positions at which the robots must be placed.

    Attributes:
        scenario: With or without an obstacle.
        topology: Robots between which the distance is measured: `master`, each station and the relay (the stations
            are on opposite sides of it); `masterless`, sender and receiver.
        distance: The distance.
        posts: Positions of the robots in additional roles.
    """

    scenario: Scenario
    topology: Topology
    distance: Distance
    posts: tuple["Post", ...] = ()


class FaultKind(StrEnum):
    """Kind of an injected fault."""

    LINK_DOWN = "link-down"
    REBOOT = "reboot"
    KILL = "kill"
    OUT_OF_RANGE = "out-of-range"


@dataclass(frozen=True)
class Fault:
    """A fault that is injected into a robot in order to measure how the network recovers.

    Attributes:
        kind: Kind of the fault.
        role: Role of the affected robot.
        duration_s: Duration in seconds; 0 for a reboot or a kill, whose duration is not controlled.
        process: Name of the process that is killed; empty for other kinds.
        link: Name of the link that is down; empty for the radio under test, and for other kinds of fault.
    """

    kind: FaultKind
    role: Role
    duration_s: float = 0.0
    process: str = ""
    link: str = ""


@dataclass(frozen=True)
class Leg:
    """A straight segment of a path, as a vector from the end of the previous segment.

    Attributes:
        away_m: Metres away from the robot at the other end of the link; negative towards it.
        left_m: Metres to the left when facing away from that robot; negative to the right.
    """

    away_m: float = 0.0
    left_m: float = 0.0


@dataclass(frozen=True)
class Post:
    """Position of a robot in an additional role.

    Attributes:
        role: Role of the robot.
        near: Reference robot, one of `FIXED_ROLES`.
        leg: Position relative to the reference robot; "away" means away from the other end of that robot's link.
    """

    role: Role
    near: Role
    leg: Leg


@dataclass(frozen=True)
class Move:
    """Motion of a robot along a path that starts at its position.

    Attributes:
        role: Role of the robot.
        legs: The path.
        speed_m_s: Constant speed along the path.
    """

    role: Role
    legs: tuple[Leg, ...]
    speed_m_s: float


Vector = tuple[float, float, float]
"""East, north, up."""


@dataclass(frozen=True)
class TrackPoint:
    """Position and velocity of a robot, valid until the next entry of the same robot.

    Attributes:
        utc_ns: Start of the validity, nanoseconds since 1970 UTC by the laptop's clock.
        role: Role of the robot.
        position_m: Position of its antenna, in metres; None while it was out of range of all robots.
        velocity_m_s: Its velocity.
    """

    utc_ns: int
    role: Role
    position_m: Vector | None
    velocity_m_s: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class StationSample:
    """Statistics that a radio reports about one peer station; None if not reported.

    Counters may start at any number.

    Attributes:
        station: MAC address of the station, or its name if the sample is of an emulator.
        signal_dbm: Received signal strength.
        tx_rate_bit_s: PHY rate of the last frame to it.
        rx_rate_bit_s: PHY rate of the last frame from it.
        tx_packets: Packets that were transmitted to it.
        rx_packets: Packets that were received from it.
        tx_retries: Number of retransmissions of frames to it.
        tx_failures: Packets to it that were dropped after the last retry.
        beacon_losses: Number of times that its beacons were lost.
    """

    station: str
    signal_dbm: float | None = None
    tx_rate_bit_s: float | None = None
    rx_rate_bit_s: float | None = None
    tx_packets: int | None = None
    rx_packets: int | None = None
    tx_retries: int | None = None
    tx_failures: int | None = None
    beacon_losses: int | None = None


@dataclass(frozen=True)
class LinkSample:
    """Statistics that a radio reported at one time; None if not reported.

    Attributes:
        utc_ns: Time of the sample, nanoseconds since 1970 UTC by the robot's clock; by the laptop's clock for a
            sample of a modelled radio.
        stations: Statistics of its peer stations.
        cell: BSSID of the access point with which it is associated; for a modelled radio the name of this access
            point.
        noise_dbm: Noise level in its channel.
        active_ns: Counter of the time for which it listened to its channel.
        busy_ns: Part of that time in which the channel was busy.
    """

    utc_ns: int
    stations: tuple[StationSample, ...] = ()
    cell: str | None = None
    noise_dbm: float | None = None
    active_ns: int | None = None
    busy_ns: int | None = None


@dataclass(frozen=True, order=True)
class RepeatId:
    """Identifier of one planned repeat of a procedure; `str` gives its folder name, `udp-07`."""

    protocol: Protocol
    number: int

    def __str__(self) -> str:
        return f"{self.protocol}-{self.number:02d}"

    def folder(self, status: Status, attempt: int) -> str:
        """Return the name of an attempt's folder: `udp-07` if it is valid, or for example `udp-07.void1`."""
        return str(self) if status is Status.VALID else f"{self}.{status}{attempt}"


@dataclass(frozen=True, kw_only=True)
class DelayParts:
    """One-way delay of packets in its four components, each summed over all packets.

    These are the components in equation 2 of the paper whose field trials fieldkit automates (docs/index.md).

    Attributes:
        packets: Number of packets.
        processing_ns: Processing time in the stations.
        transmission_ns: Transmission time of the bits at the rate of the link.
        propagation_ns: Propagation time on the medium.
        queuing_ns: Time that the packets waited for earlier packets.
        undivided_ns: Delay whose components the network does not report.
        policy_ns: Time added by the sync policy, not part of the delay; None without a co-simulation.
    """

    packets: int
    processing_ns: int
    transmission_ns: int
    propagation_ns: int
    queuing_ns: int
    undivided_ns: int = 0
    policy_ns: int | None = None


@dataclass(frozen=True, kw_only=True)
class Lateness:
    """Lateness of the packets that an emulator delivered, relative to the delivery times of its radio model.

    Attributes:
        bound_ns: Maximum lateness. If any packet or window is later, the emulation did not follow the model.
        packets: Number of packets by lateness in ns (a histogram); a lateness is rounded up by at most an eighth.
        windows: Number of windows of a co-simulation by lateness in ns (a histogram). The lateness of a window is the
            time from its end in real time to the arrival of its results. None without a co-simulation.
    """

    bound_ns: int
    packets: Mapping[int, int]
    windows: Mapping[int, int] | None = None


@dataclass(frozen=True)
class Interval:
    """A point estimate with its confidence interval.

    Attributes:
        value: The estimate.
        low: Lower bound.
        high: Upper bound.
    """

    value: float
    low: float
    high: float
