"""The data types that everything shares: frozen, without behaviour."""

from dataclasses import dataclass
from enum import StrEnum


class Role(StrEnum):
    """What a robot does in a trial; procedures speak of roles, never of hosts."""

    SENDER = "sender"
    RECEIVER = "receiver"
    RELAY = "relay"


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


class Status(StrEnum):
    """How a repeat stands; `void` means that its evidence is not whole."""

    PLANNED = "planned"
    RUNNING = "running"
    VALID = "valid"
    VOID = "void"
    FAILED = "failed"


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
    """Where the robots are to stand.

    Attributes:
        scenario: With or without an obstacle.
        topology: Which robots the distance is between: `master`, each station and the relay (stations on
            opposite sides of it); `masterless`, sender and receiver.
        distance: The distance.
    """

    scenario: Scenario
    topology: Topology
    distance: Distance


@dataclass(frozen=True, order=True)
class RepeatId:
    """One planned pass of a procedure; `str` gives its folder name, `udp-07`."""

    protocol: Protocol
    number: int

    def __str__(self) -> str:
        return f"{self.protocol}-{self.number:02d}"


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
