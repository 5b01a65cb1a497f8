"""Protocols of labs: robots that run without a trial, and a backend that starts all robots of a site file."""

import socket
from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

from fieldkit.backends.protocols import Backend
from fieldkit.core.errors import ConfigurationError, did_you_mean
from fieldkit.core.events import Sink
from fieldkit.core.model import Vector
from fieldkit.lab.robots import Destination, LabRobot

Place = tuple[float, float]
"""Metres east and north."""


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
class Outline:
    """Outline of an obstacle in the plan view.

    Attributes:
        material: Its material.
        corners: Corners of the polygon.
    """

    material: str
    corners: tuple[Place, ...]


@dataclass(frozen=True)
class LabLink:
    """Radio link between two robots of a lab.

    Attributes:
        ends: Names of the two robots.
        snr_db: Signal-to-noise ratio of the worse direction.
        linked: Whether frames can arrive.
        through: Names of the obstacles between them.
    """

    ends: tuple[str, str]
    snr_db: float
    linked: bool
    through: tuple[str, ...]


@dataclass(frozen=True)
class Overview:
    """Plan view of a lab.

    Attributes:
        world: Name of its world.
        area_m: Its extent, metres east and north from the origin.
        outlines: Obstacles in drawing order: an obstacle that covers others comes after them.
        robots: Position of each robot.
        links: The link of each pair of robots; empty if the radio does not depend on positions.
    """

    world: str
    area_m: Place
    outlines: Sequence[Outline]
    robots: Mapping[str, Place]
    links: Sequence[LabLink]


@dataclass(frozen=True)
class LabLateness:
    """Lateness of the co-simulation of a lab since its start was complete.

    Attributes:
        bound_s: Maximum lateness; if a packet or a window was later, results that were measured then are not valid.
        packet_max_s: Maximum lateness of a packet; None if no packet arrived.
        window_max_s: Maximum time by which the results of a window were later than its end; None if no window ended.
        windows: Number of windows that ended.
        late: Number of packets and windows that were later than the bound.
    """

    bound_s: float
    packet_max_s: float | None
    window_max_s: float | None
    windows: int
    late: int


class Lab(Protocol):
    """The running robots of a lab."""

    @property
    def members(self) -> Mapping[str, LabRobot]:
        """The robots by name."""
        ...

    @property
    def login(self) -> Login:
        """Login on the robots."""
        ...

    def connect(self, name: str, timeout_s: float) -> socket.socket:
        """Return a connected socket to the SSH server of a robot.

        Raises:
            KeyError: There is no such robot.
            OSError: The connection failed or timed out.
            FieldkitError: A process of the lab has failed.
        """
        ...

    def programs(self, name: str) -> tuple[str, ...]:
        """Return the names of the programs that run on a robot; empty if the robot has terminated."""
        ...

    def place_m(self, name: str) -> Vector:
        """Return the position of a robot's antenna in metres.

        Raises:
            FieldkitError: The positions are unknown, because a process of the lab has failed.
        """
        ...

    def move(self, name: str, to: Destination) -> Vector:
        """Move a robot instantly and return the new position of its antenna in metres.

        Raises:
            ConfigurationError: The destination is not in the world.
            LinkError: The process of the modelled radio does not answer.
            RobotError: The robot or a physics simulator refuses the position.
        """
        ...

    def overview(self) -> Overview:
        """Return the plan view with the current positions of the robots.

        Raises:
            FieldkitError: The positions are unknown, because a process of the lab has failed.
        """
        ...

    def lateness(self) -> LabLateness | None:
        """Return the lateness of the co-simulation since the start was complete, or None without a co-simulation.

        Raises:
            LinkError: The process of the modelled radio does not answer.
        """
        ...


@runtime_checkable
class LabBackend(Protocol):
    """A backend that can start all robots of its site file together, with or without roles."""

    def open_lab(self, *, seed: int, sink: Sink) -> AbstractContextManager[Lab]:
        """Start all robots, within radio range of each other if the world allows it.

        Raises:
            FieldkitError: A permission or a program is missing, or a robot did not start.
        """
        ...

    def overview(self) -> Overview:
        """Return the plan view of the lab that `open_lab` would start, without starting it.

        Raises:
            ConfigurationError: A profile is missing or invalid.
        """
        ...


@runtime_checkable
class ChoosesWifi(Protocol):
    """Optional capability of a `LabBackend` with several kinds of Wi-Fi."""

    def use_wifi(self, kind: str) -> None:
        """Use a kind of Wi-Fi, `model` or `linux`.

        Raises:
            ConfigurationError: The site file excludes it.
        """
        ...


def unknown_robot_error(name: str, names: Iterable[str]) -> ConfigurationError:
    """Return the error for a robot that is not in the lab, with a similar name as a hint if there is one."""
    return ConfigurationError(
        f"there is no robot {name!r} in this lab", remedy=did_you_mean(name, names, "fieldkit lab ps lists them")
    )


@runtime_checkable
class GazeboWorlds(Protocol):
    """A backend whose robots a Gazebo of the user can move."""

    def gazebo_world(self, version: str) -> str:
        """Return the world of the robots as SDF.

        Args:
            version: Version of Gazebo, which determines the names of its plugins: `fortress`, or `garden` for Garden
                and later.

        Raises:
            ConfigurationError: A profile is missing or invalid.
        """
        ...


def as_lab_backend(name: str, backend: Backend) -> LabBackend:
    """Return a backend as a `LabBackend`.

    Raises:
        ConfigurationError: The backend cannot start robots.
    """
    if not isinstance(backend, LabBackend):
        raise ConfigurationError(
            f"the backend {name} connects to existing robots and cannot start any",
            remedy="fieldkit lab up --backend emulated",
        )
    return backend
