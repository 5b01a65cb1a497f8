"""The data types that everything shares: frozen, without behaviour."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, ClassVar, Final


class Role(str):
    """What a robot does in a trial; procedures speak of roles, never of hosts.

    Three have a meaning of their own; beside them a procedure may have others, for robots that it places. There is
    one object per role, however it is made.

    Args:
        name: `rival`, `rival-2`.

    Raises:
        ValueError: It is no name of a role.
    """

    SENDER: ClassVar["Role"]
    RECEIVER: ClassVar["Role"]
    RELAY: ClassVar["Role"]

    PATTERN: Final = r"[a-z][a-z0-9_]{0,30}"
    __slots__ = ()
    _made: ClassVar[dict[str, "Role"]] = {}

    def __new__(cls, name: str) -> "Role":
        """See the class."""
        if (known := cls._made.get(name)) is None:
            if not re.fullmatch(cls.PATTERN, name):
                raise ValueError("a role is named by small letters, digits and _, a letter first")
            known = cls._made.setdefault(str(name), super().__new__(cls, name))
        return known

    @classmethod
    def __get_pydantic_core_schema__(cls, _: Any, handler: Any) -> Any:  # noqa: ANN401 (of pydantic, not imported here)
        return {
            "type": "function-after",
            "function": {"type": "no-info", "function": cls},
            "schema": handler(str),
        }


Role.SENDER, Role.RECEIVER, Role.RELAY = map(Role, ("sender", "receiver", "relay"))

FIXED_ROLES: Final = (Role.SENDER, Role.RECEIVER, Role.RELAY)
"""The roles that have a meaning of their own, in the order in which they are listed."""


def in_order(roles: Iterable[Role]) -> list[Role]:
    """Return roles in the order in which they are listed: those of `FIXED_ROLES`, then a lab's own by name."""
    return sorted(
        roles, key=lambda role: (FIXED_ROLES.index(role) if role in FIXED_ROLES else len(FIXED_ROLES), role)
    )


ROS_MASTER_PORT: Final = 11311
"""Where every ROS 1 master listens unless it is told otherwise (wiki.ros.org/roscore)."""

BRIDGE_IS_UP: Final = "the bridge is up"
"""What `fieldkit bridge` says once it carries, for who waits for it."""


class Protocol(StrEnum):
    """The transport protocol that carries the file."""

    TCP = "tcp"
    UDP = "udp"


class Scenario(StrEnum):
    """Whether an obstacle stands between the robots."""

    LOS = "los"
    NLOS = "nlos"


class Topology(StrEnum):
    """Whether traffic passes the relay's access point or goes directly."""

    MASTER = "master"
    MASTERLESS = "masterless"


class Control(StrEnum):
    """Which way SSH takes to the robots: a network of its own, or the radio under test."""

    SEPARATE = "separate"
    RADIO = "radio"


class Status(StrEnum):
    """How a repeat stands.

    `measured`: its steps are done and its evidence is on the robots; `void`: its evidence is not whole.
    """

    PLANNED = "planned"
    RUNNING = "running"
    MEASURED = "measured"
    VALID = "valid"
    VOID = "void"
    FAILED = "failed"


MOST_REPEATS: Final = 100_000
"""Repeats per protocol of one trial: weeks, and what a plan can list in a moment."""

ENDED: Final = (Status.VALID, Status.VOID, Status.FAILED)
"""How an attempt may end."""


class Verdict(StrEnum):
    """What a check came to; `warn` lets the trial go on, `fail` does not."""

    OK = "ok"
    WARN = "warn"
    FAIL = "fail"


@dataclass(frozen=True)
class Distance:
    """A distance with the operator's own label.

    Attributes:
        metres: The distance in metres, above zero.
        label: As the operator wrote it, for example `30ft`.
    """

    metres: float
    label: str


@dataclass(frozen=True)
class Placement:
    """Places where the robots are to stand.

    Attributes:
        scenario: With or without an obstacle.
        topology: Which robots the distance is between: `master`, each station and the relay (stations on
            opposite sides of it); `masterless`, sender and receiver.
        distance: The distance.
        posts: Places of robots in roles of the procedure's own.
    """

    scenario: Scenario
    topology: Topology
    distance: Distance
    posts: tuple["Post", ...] = ()


class FaultKind(StrEnum):
    """What is done to a robot on purpose."""

    LINK_DOWN = "link-down"
    REBOOT = "reboot"
    KILL = "kill"
    OUT_OF_RANGE = "out-of-range"


@dataclass(frozen=True)
class Fault:
    """Something done to a robot on purpose, to see the network heal.

    Attributes:
        kind: What.
        role: To which robot.
        duration_s: How long it lasts, in seconds; 0 for a reboot or a kill, which last as long as they do.
        process: Name of the process killed; empty for the other kinds.
    """

    kind: FaultKind
    role: Role
    duration_s: float = 0.0
    process: str = ""


class OnAbort(StrEnum):
    """What becomes of a drone whose trial is cut short: it comes down where it is, or where it rose."""

    LAND = "land"
    RETURN = "return"


@dataclass(frozen=True)
class Leg:
    """A straight piece of a way, relative to where the piece before it ends.

    Attributes:
        away_m: So far away from the robot at the other end of the link, in metres; negative for towards it.
        left_m: So far to the left of who looks away from it; negative for to the right.
    """

    away_m: float = 0.0
    left_m: float = 0.0


@dataclass(frozen=True)
class Post:
    """Place of a robot in a role of a procedure's own.

    Attributes:
        role: Whose.
        near: Which of the robots under test it stands near to, in one of `FIXED_ROLES`.
        leg: Where from there; away is away from the other end of that robot's link.
    """

    role: Role
    near: Role
    leg: Leg


@dataclass(frozen=True)
class Move:
    """A robot moves from its place along a way.

    Attributes:
        role: Which robot.
        legs: The way.
        speed_m_s: How fast, along all of it.
    """

    role: Role
    legs: tuple[Leg, ...]
    speed_m_s: float


@dataclass(frozen=True)
class MotionOrigin:
    """Place and heading of a robot at its first start in a trial: centre of its fence, reference of all directions.

    Attributes:
        frame: Frame of the coordinates: `odometry`, or `local` for MAVLink's LOCAL_POSITION_NED.
        frame_id: Identifies the life of that frame, for example the boot ID of the robot; a frame that was lost and
            made anew has another one.
        x_m: x of `nav_msgs/Odometry`, or metres north.
        y_m: y of `nav_msgs/Odometry`, or metres east.
        heading_rad: Where the robot faces, from x towards y: counterclockwise in `odometry`, clockwise in `local`.
        latitude_deg: Latitude of the place (WGS 84); None if unknown.
        longitude_deg: Its longitude; None if unknown.
    """

    frame: str
    frame_id: str
    x_m: float
    y_m: float
    heading_rad: float
    latitude_deg: float | None = None
    longitude_deg: float | None = None


Vector = tuple[float, float, float]
"""East, north, up."""


@dataclass(frozen=True)
class Whereabouts:
    """Place of a robot from a moment on, until the next of it.

    Attributes:
        utc_ns: From when, nanoseconds since 1970 UTC by the laptop's clock.
        role: Which robot.
        position_m: Where its antenna was, in metres; None where nobody heard it.
        velocity_m_s: How it moved.
    """

    utc_ns: int
    role: Role
    position_m: Vector | None
    velocity_m_s: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class StationSample:
    """What a radio knows of another that it sends to; None where it does not tell. Counters go on from any number.

    Attributes:
        station: Which one: its address, or its name where an emulator tells.
        signal_dbm: How strong it arrives.
        tx_rate_bit_s: Rate of the last frame to it.
        rx_rate_bit_s: Rate of the last frame from it.
        tx_packets: Packets that went on the air to it.
        rx_packets: Packets that came from it.
        tx_retries: Frames sent again to it.
        tx_failures: Packets to it that were given up.
        beacon_losses: Times that its beacons stayed away.
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
    """What a radio told at one moment; None where it did not.

    Attributes:
        utc_ns: When, nanoseconds since 1970 UTC by the robot's clock.
        stations: What it knows of others.
        cell: Address of the access point that it is joined to.
        noise_dbm: Noise in its channel.
        active_ns: Counter of the time for which it listened to its channel.
        busy_ns: Of that, the time in which it found the channel busy.
    """

    utc_ns: int
    stations: tuple[StationSample, ...] = ()
    cell: str | None = None
    noise_dbm: float | None = None
    active_ns: int | None = None
    busy_ns: int | None = None


@dataclass(frozen=True, order=True)
class RepeatId:
    """One planned pass of a procedure; `str` gives its folder name, `udp-07`."""

    protocol: Protocol
    number: int

    def __str__(self) -> str:
        return f"{self.protocol}-{self.number:02d}"

    def folder(self, status: Status, attempt: int) -> str:
        """Return the name of an attempt's folder: `udp-07`, or `udp-07.void1` for one that was redone."""
        return str(self) if status is Status.VALID else f"{self}.{status}{attempt}"


@dataclass(frozen=True, kw_only=True)
class DelayParts:
    """What packets that went one way were delayed by, in the four parts of the paper's eq. 2, summed over them.

    Attributes:
        packets: How many they are.
        processing_ns: What the stations themselves took.
        transmission_ns: What their bits took at the rate of the link.
        propagation_ns: What the way took once they had left.
        queuing_ns: What they waited for others before them.
    """

    packets: int
    processing_ns: int
    transmission_ns: int
    propagation_ns: int
    queuing_ns: int


@dataclass(frozen=True, kw_only=True)
class Lateness:
    """Time by which packets reached their robots after the moment that a model of the air says.

    Attributes:
        bound_ns: Where one packet is later than this, the model was not kept.
        packets: How many packets were late by at most so many ns, rounded up by an eighth at most; each once.
    """

    bound_ns: int
    packets: Mapping[int, int]


@dataclass(frozen=True)
class Interval:
    """A point estimate with its interval.

    Attributes:
        value: The estimate.
        low: Lower bound.
        high: Upper bound.
    """

    value: float
    low: float
    high: float
