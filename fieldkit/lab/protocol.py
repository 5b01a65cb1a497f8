"""Protocols of a lab: robots that are up outside of any trial, and a backend that brings up all of a site file."""

import socket
from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

from fieldkit.backends.protocols import Backend
from fieldkit.config.profiles import RobotProfile
from fieldkit.core.errors import ConfigurationError, nearest
from fieldkit.core.events import Sink
from fieldkit.core.model import Vector

Place = tuple[float, float]
"""Metres east and north."""


@dataclass(frozen=True)
class LabRobot:
    """A robot of a lab.

    Attributes:
        name: Its name.
        profile: What it is.
        address: Its IPv4 address on the radio.
        roles: What it plays in trials, as people read it: `sender (master)`.
    """

    name: str
    profile: RobotProfile
    address: str
    roles: tuple[str, ...] = ()


@dataclass(frozen=True)
class Login:
    """Login on the robots of a lab.

    Attributes:
        user: Login name.
        private_key: OpenSSH private key text.
        host_keys: Public host key per robot, `ssh-ed25519 AAAA...`.
    """

    user: str
    private_key: str = field(repr=False)
    host_keys: Mapping[str, str]


@dataclass(frozen=True)
class Destination:
    """Destination of a robot, given by the place of its antenna.

    Attributes:
        east_m: Metres east of the world's corner, or of where the robot is.
        north_m: Metres north of it.
        up_m: Height of the antenna in the world, or by how much it rises over the ground; None: the robot stands on
            the ground, or stays as high over it as it is.
        relative: Whether the first three are from where the robot is.
    """

    east_m: float
    north_m: float
    up_m: float | None
    relative: bool


@dataclass(frozen=True)
class Outline:
    """An obstacle from above.

    Attributes:
        material: Of what it is.
        corners: Its outline.
    """

    material: str
    corners: tuple[Place, ...]


@dataclass(frozen=True)
class LabLink:
    """Radio link between two robots of a lab.

    Attributes:
        ends: Their names.
        snr_db: Signal-to-noise ratio, that of the worse direction.
        linked: Whether frames arrive at all.
        through: Names of the obstacles between them.
    """

    ends: tuple[str, str]
    snr_db: float
    linked: bool
    through: tuple[str, ...]


@dataclass(frozen=True)
class Overview:
    """A lab from above.

    Attributes:
        world: Name of its world.
        area_m: Its extent, metres east and north from the origin.
        outlines: What stands in it, what covers others last.
        robots: Where the robots stand.
        links: Between any two of them; none where the radio does not depend on places.
    """

    world: str
    area_m: Place
    outlines: Sequence[Outline]
    robots: Mapping[str, Place]
    links: Sequence[LabLink]


class Lab(Protocol):
    """Robots that are up."""

    @property
    def members(self) -> Mapping[str, LabRobot]:
        """The robots by name."""
        ...

    @property
    def login(self) -> Login:
        """Login on all of them."""
        ...

    def connect(self, name: str, timeout_s: float) -> socket.socket:
        """Return a stream to the SSH server of a robot.

        Raises:
            OSError: There was none in time.
        """
        ...

    def programs(self, name: str) -> tuple[str, ...]:
        """Return the names of the programs that run on a robot, none when it has ended."""
        ...

    def place_m(self, name: str) -> Vector:
        """Return where a robot's antenna is."""
        ...

    def move(self, name: str, to: Destination) -> Vector:
        """Put a robot elsewhere, at once, and return where its antenna is now.

        Raises:
            ConfigurationError: That is no place in the world.
            LinkError: The radio does not answer.
        """
        ...

    def overview(self) -> Overview:
        """Return the robots from above, where they are now."""
        ...


@runtime_checkable
class LabBackend(Protocol):
    """A backend that can bring up all robots of its site file at once, with or without roles."""

    def open_lab(self, *, seed: int, sink: Sink) -> AbstractContextManager[Lab]:
        """Bring up every robot, each in the range of the others where the world allows it.

        Raises:
            FieldkitError: A right or a program is missing, or a robot did not come up.
        """
        ...

    def overview(self) -> Overview:
        """Return what `open_lab` would bring up, from above; nothing is brought up.

        Raises:
            ConfigurationError: A profile is missing or wrong.
        """
        ...


def unknown_robot(name: str, names: Iterable[str]) -> ConfigurationError:
    """Return the error for a robot that a lab does not have, with what was perhaps meant."""
    return ConfigurationError(
        f"there is no robot {name!r} in this lab", remedy=nearest(name, names, "fieldkit lab ps lists them")
    )


def of(name: str, backend: Backend) -> LabBackend:
    """Return what brings up the robots of a backend.

    Raises:
        ConfigurationError: It cannot.
    """
    if not isinstance(backend, LabBackend):
        raise ConfigurationError(
            f"the backend {name} finds robots, it brings up none", remedy="fieldkit lab up --backend emulated"
        )
    return backend
