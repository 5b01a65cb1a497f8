"""Where robots come from: the Backend protocol, its registry, and the field backend."""

import socket
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Final, Protocol

from fieldkit.config import Document
from fieldkit.deadline import Deadline
from fieldkit.errors import ConfigurationError
from fieldkit.events import PhaseStarted, Sink
from fieldkit.model import Placement, Role, Scenario, Topology
from fieldkit.profiles import RobotProfile, Site, SiteRobot, load_profile
from fieldkit.remote.shell import Shell
from fieldkit.remote.ssh import CONNECT_S, SshShell

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

Ask = Callable[[str], None]
"""Shows the operator what to do and returns when it is done."""


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
    """A source of robots, made from the lab's site file: `Backend(site, document)`.

    Making it checks the site file and touches nothing else; `ConfigurationError` says what the backend misses there.
    """

    def cast(self, topology: Topology) -> Cast:
        """Return who plays which role, without touching any robot (`--dry-run` uses this alone).

        Raises:
            ConfigurationError: The site file gives no roles for this topology.
        """
        ...

    def open(self, cast: Cast, *, seed: int, sink: Sink, ask: Ask) -> AbstractContextManager[Lab]:
        """Bring up the lab of a cast from `cast`; leaving the context takes it down without trace.

        Args:
            cast: What `cast` returned.
            seed: Seed of everything random in the lab.
            sink: Told about phases.
            ask: Asks the operator to do something and returns when it is done.

        Raises:
            ConfigurationError: A right or a program is missing on this machine.
            LinkError: A robot cannot be reached.
        """
        ...


class BackendFactory(Protocol):
    """What an entry point of the group `fieldkit.backends` names: usually the backend's class."""

    def __call__(self, site: Site | None, document: Document | None) -> Backend:
        """Return the backend for a site file, or for no site file."""
        ...


def backend_names() -> tuple[str, ...]:
    """Return the names of the installed backends."""
    return tuple(sorted(point.name for point in entry_points(group=ENTRY_POINTS)))


def load_backend(name: str, site: Site | None, document: Document | None) -> Backend:
    """Return the backend `name` for a site file.

    Raises:
        ConfigurationError: No such backend is installed, or the site file does not give what it needs.
    """
    for point in entry_points(group=ENTRY_POINTS, name=name):
        factory: BackendFactory = point.load()
        return factory(site, document)
    raise ConfigurationError(f"there is no backend {name!r}", remedy=f"installed: {', '.join(backend_names())}")


def cast_of(site: Site, topology: Topology, addresses: Mapping[str, str]) -> Cast:
    """Return the cast that a site file gives for a topology.

    Args:
        site: The site file.
        topology: The topology.
        addresses: Address on the radio per robot name.

    Raises:
        ConfigurationError: The site file has no roles for the topology, or names a profile that does not exist.
    """
    if topology not in site.roles:
        raise ConfigurationError(
            f"the site file gives no roles for topology {topology}",
            remedy=f"add roles.{topology}, or use --topology {next(iter(site.roles), 'masterless')}",
        )
    names = site.roles[topology]
    return {
        role: Robot(names[role], role, load_profile(site.robots[names[role]].profile), addresses[names[role]])
        for role in Role
        if role in names
    }


class FieldBackend:
    """Real robots over SSH, placed by a person."""

    def __init__(self, site: Site | None, document: Document | None) -> None:
        if site is None or document is None:
            raise ConfigurationError(
                "the field backend needs a site file",
                remedy="write fieldkit.yaml, see docs/field.md, or name it by --site",
            )
        for name, robot in site.robots.items():
            for key in ("host", "user", "host_key"):
                if getattr(robot, key) is None:
                    raise ConfigurationError(
                        f"robot {name!r} has no {key}",
                        where=document.where(("robots", name)),
                        remedy=f"add {key}: to it; the field backend needs it",
                    )
        self._site = site

    def cast(self, topology: Topology) -> Cast:
        """See `Backend.cast`."""
        addresses = {name: robot.address or robot.host or "" for name, robot in self._site.robots.items()}
        return cast_of(self._site, topology, addresses)

    @contextmanager
    def open(self, cast: Cast, *, seed: int, sink: Sink, ask: Ask) -> Iterator[Lab]:  # noqa: ARG002 (nothing random)
        """See `Backend.open`."""
        sink(PhaseStarted("connect"))
        shells: dict[Role, Shell] = {}
        try:
            for role, robot in cast.items():
                shells[role] = _shell(robot.name, self._site.robots[robot.name])
                shells[role].run(("true",), deadline=Deadline.after(CONNECT_S))
            yield FieldLab(cast, shells, ask)
        finally:
            for shell in shells.values():
                shell.close()


class FieldLab:
    """Real robots that a person puts where the trial wants them.

    Args:
        cast: Who plays which role.
        shells: Their control connections.
        ask: Asks the person.
    """

    def __init__(self, cast: Cast, shells: Mapping[Role, Shell], ask: Ask) -> None:
        self._cast = cast
        self._shells = shells
        self._ask = ask

    @property
    def shells(self) -> Mapping[Role, Shell]:
        """See `Lab.shells`."""
        return self._shells

    def place(self, placement: Placement) -> None:
        """See `Lab.place`."""
        names = {role: robot.name for role, robot in self._cast.items()}
        sender, receiver = names[Role.SENDER], names[Role.RECEIVER]
        where = f"{placement.distance.label} ({placement.distance.metres:.2f} m)"
        if placement.topology is Topology.MASTER:
            text = f"put {sender} and {receiver} on opposite sides of {names[Role.RELAY]}, each {where} from it"
        else:
            text = f"put {sender} and {receiver} {where} apart"
        wall = f", {sender} behind the wall" if placement.scenario is Scenario.NLOS else ", nothing between them"
        self._ask(text + wall)


def _shell(name: str, robot: SiteRobot) -> Shell:
    host = robot.host or ""
    return SshShell(
        name,
        connect=lambda timeout_s: socket.create_connection((host, robot.port), timeout=timeout_s),
        user=robot.user or "",
        host_key=robot.host_key or "",
        private_key=None if robot.key is None else _key_text(name, robot.key),
    )


def _key_text(name: str, path: str) -> str:
    try:
        return Path(path).expanduser().read_text(encoding="ascii")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(
            f"its key {path} cannot be read",
            where=name,
            remedy="correct key: in the site file, or leave it out to use the agent",
        ) from error
