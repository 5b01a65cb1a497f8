"""Where robots come from: the Backend protocol, its registry, and the field backend."""

from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Final, Protocol

from fieldkit.config import Document
from fieldkit.events import Sink
from fieldkit.model import Placement, Role, Topology
from fieldkit.profiles import RobotProfile, Site
from fieldkit.remote.shell import Shell

ENTRY_POINTS: Final = "fieldkit.backends"


@dataclass(frozen=True)
class Robot:
    """A robot in a role.

    Attributes:
        name: Its name in the lab, `turtlebot-1`.
        role: Its role in this trial.
        profile: What it is.
        address: Its IPv4 address on the radio under test.
    """

    name: str
    role: Role
    profile: RobotProfile
    address: str


Cast = Mapping[Role, Robot]


class Lab(Protocol):
    """Robots that are up and reachable."""

    @property
    def shells(self) -> Mapping[Role, Shell]:
        """The control connection of each robot of the cast."""
        ...

    def place(self, placement: Placement) -> None:
        """Bring the robots to their places; returns when they stand there.

        Raises:
            FieldkitError: They could not be placed.
        """
        ...


class Backend(Protocol):
    """A source of robots."""

    def cast(self, site: Site | None, document: Document | None, topology: Topology) -> Cast:
        """Return who plays which role, without touching any robot (`--dry-run` uses this alone).

        Args:
            site: The site file, or None for the backend's own default lab.
            document: The site file's document, for messages with lines.
            topology: The topology of the trial.

        Raises:
            ConfigurationError: The site file does not give what the backend needs.
        """
        ...

    def open(self, cast: Cast, *, seed: int, sink: Sink) -> AbstractContextManager[Lab]:
        """Bring up the lab of a cast from `cast`; leaving the context takes it down without trace.

        Args:
            cast: What `cast` returned.
            seed: Seed of everything random in the lab.
            sink: Told about phases.

        Raises:
            ConfigurationError: A right or a program is missing on this machine.
            LinkError: A robot cannot be reached.
        """
        ...
