"""Protocols of backends: `Backend` provides robots, `Testbed` controls them, `Oracle` has data of a radio model."""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from types import MappingProxyType
from typing import Final, Protocol, runtime_checkable

from fieldkit.config import schema
from fieldkit.config.profiles import RobotProfile
from fieldkit.config.schema import Document, Field, Strict
from fieldkit.config.site import Site
from fieldkit.core import model
from fieldkit.core.errors import FieldkitError
from fieldkit.core.events import Sink
from fieldkit.core.model import (
    ROS_MASTER_PORT,
    Control,
    DelayParts,
    Fault,
    Lateness,
    LinkSample,
    Move,
    Placement,
    Role,
    Topology,
    TrackPoint,
)
from fieldkit.core.prompts import Answer, Operator
from fieldkit.remote.shell import Shell

_FORMER_KEYS: Final = MappingProxyType({"drives": "drive", "flies": "mavlink"})
"""Section for each ability, by the key of the ability in plans of earlier versions."""


class RobotLink(Strict):
    """A robot's end of a link.

    Attributes:
        interface: Its network interface.
        address: Its IPv4 address on the link.
    """

    interface: str
    address: str


class Robot(Strict):
    """A robot in a role, as it is written into the plan of a trial.

    Attributes:
        name: Its name in the lab, `turtlebot-1`.
        address: Its IPv4 address on the radio under test.
        profile: Its profile.
        links: Its ends of the links other than the radio under test, by the name of the link.
        control: The network that SSH uses to reach it, from the site file.
        ros_master: Address on the radio of the robot that runs its ROS master; empty if its setup files define it.
        abilities: Sections of its profile by which steps may move it, for example `drive`.
    """

    name: str
    address: str
    profile: RobotProfile
    links: dict[str, RobotLink] = Field(default_factory=dict, exclude_if=schema.is_empty)
    control: Control = Control.SEPARATE
    ros_master: str = Field(default="", exclude_if=schema.is_empty)
    abilities: schema.Names = Field(default=frozenset(), exclude_if=schema.is_empty)

    @schema.model_validator(mode="before")
    @classmethod
    def _read_former_keys(cls, data: object) -> object:
        """Read plans of earlier versions, which have a boolean for each ability."""
        if not isinstance(data, dict) or not data.keys() & _FORMER_KEYS.keys():
            return data
        abilities = [section for key, section in _FORMER_KEYS.items() if data.get(key)]
        return {key: value for key, value in data.items() if key not in _FORMER_KEYS} | {"abilities": abilities}

    def link(self, name: str = "") -> RobotLink | None:
        """Return its end of a link, or None if it has no such link. An empty name is the radio under test."""
        radio = self.profile.radio.interface
        if not name or self.profile.links.get(name) == radio:
            return RobotLink(interface=radio, address=self.address)
        return self.links.get(name)

    @property
    def ros_graph(self) -> str:
        """A text that names the ROS domain or master of its topics; empty if it shares topics with no other robot."""
        ros = self.profile.ros
        if ros is not None and ros.variant == "ros2":
            return f"ROS domain {ros.domain}{' over Zenoh' if ros.middleware == 'zenoh' else ''}"
        return f"the ROS master at {self.ros_master}" if self.ros_master else ""

    @property
    def ros_environment(self) -> dict[str, str]:
        """Environment variables of its ROS programs, in addition to the variables of its setup files.

        Robots that share a master find each other by their addresses on the radio. ROS_HOSTNAME overrides ROS_IP,
        which a setup file may set (wiki.ros.org/ROS/EnvironmentVariables).
        """
        variables = dict(self.profile.ros.environment) if self.profile.ros else {}
        if not self.ros_master:
            return variables
        master = f"http://{self.ros_master}:{ROS_MASTER_PORT}"
        return variables | {"ROS_MASTER_URI": master, "ROS_HOSTNAME": self.address}


Cast = Mapping[Role, Robot]
"""The robot in each role."""


class Oracle(Protocol):
    """Data that only a modelled radio has: lateness and delays of packets, and positions of robots."""

    def track(self, since_utc_ns: int) -> Sequence[TrackPoint]:
        """Return the positions of the robots from a time of the laptop's clock until now.

        `since_utc_ns` must not decrease from call to call, because older positions may be deleted.

        Returns:
            Positions in the order of time. The first entry of each robot is the last one until `since_utc_ns`, so it
            may be older; the robot had this position, or moved from it with this velocity.
        """
        ...

    def delays(
        self, source: Role, destination: Role, protocol: model.Protocol, port: int, *, link: str = ""
    ) -> DelayParts:
        """Return the parts of the delay of the packets from one robot to a port of another.

        Args:
            source: The sending robot.
            destination: The receiving robot.
            protocol: Transport protocol.
            port: Destination port, which distinguishes the flow from others.
            link: Name of the link; empty for the radio under test.

        Returns:
            Sums over the packets and fragments of this flow that were delivered to `destination` since the first call
            for this flow.

        Raises:
            LinkError: The process of the modelled radio did not answer.
        """
        ...

    def lateness(self) -> Lateness:
        """Return the lateness of packets relative to the model, over all packets since the testbed started.

        Raises:
            LinkError: The process of the modelled radio did not answer.
        """
        ...

    def links(self, *, continue_sampling: bool) -> Mapping[Role, Sequence[LinkSample]]:
        """Return the samples of the robots' links since the last call, and a sample of the current state.

        Five samples are taken per second.

        Args:
            continue_sampling: Whether sampling continues after this call; it starts with the first such call.

        Returns:
            Samples by robot in the order of time. Times are of the laptop's clock; stations are names of robots.

        Raises:
            LinkError: The process of the modelled radio did not answer.
        """
        ...

    def record_air(self, folder: Path | None) -> None:
        """Record every transmission from now on in `folder`, if the site file enables this.

        Args:
            folder: Destination folder; None stops the recording.

        Raises:
            LinkError: The process of the modelled radio did not answer.
            OSError: The files cannot be created.
        """
        ...


class Testbed(Protocol):
    """Running, reachable robots, with the actions that every backend supports."""

    @property
    def shells(self) -> Mapping[Role, Shell]:
        """The control connection of each robot of the cast."""
        ...

    @property
    def oracle(self) -> Oracle | None:
        """The data of a modelled radio; None if the radio is real. Constant."""
        ...

    @property
    def operator(self) -> Operator:
        """The operator, for actions and observations that need a person."""
        ...

    def place(self, placement: Placement) -> Answer:
        """Bring the robots to their positions; return when they are there.

        Returns:
            The operator's answer: a note, or the decision to postpone this placement.

        Raises:
            FieldkitError: They could not be placed.
        """
        ...

    def inject(self, fault: Fault) -> float | None:
        """Cause a fault; return when the cause is over, which is before the robot has recovered.

        The cause is over when the link is up again, the robot has power again, or the process has been killed.

        Returns:
            Duration of the cause in seconds, 0 for a reboot or a kill; None if unknown.

        Raises:
            RobotError: The fault could not be caused, for example because no such process runs.
            LinkError: The robot could not be reached.
        """
        ...

    def moving(self, move: Move) -> AbstractContextManager[None]:
        """Return a context in which a robot moves along its path from its place.

        At the end of the path the robot waits. Leaving the context brings it back to its place, also after an error,
        so that all repeats start from the same place.

        Raises:
            FieldkitError: The robot could not be moved or brought back.
        """
        ...

    def bring_back(self, role: Role, *, has_returned: bool) -> None:
        """Bring a robot that drove automatically back to its place.

        Args:
            role: Role of the robot.
            has_returned: Whether the robot has reported that it has driven back.

        Raises:
            FieldkitError: The robot could not be brought back.
        """
        ...


@runtime_checkable
class Transient(Protocol):
    """Optional capability of a `Testbed` whose robots, with all their files, disappear when it is closed."""

    def check_alive(self) -> None:
        """Check that every process that the robots need is running.

        Raises:
            TestbedLostError: A process has ended or no longer answers.
        """
        ...


@runtime_checkable
class Attended(Protocol):
    """Optional capability of a `Testbed` with real robots: a person can permit motion again after a fault.

    Without it no robot moves automatically again after a fault.
    """

    @property
    def operator(self) -> Operator:
        """The operator who confirms."""
        ...

    @property
    def permissions(self) -> frozenset[str]:
        """Names of the permissions that the operator gave; see `fieldkit.core.permissions`."""
        ...


CLOCK: Final = "clock"
"""Key in `Simulating.simulators` of the simulator that provides the clock."""
INSTRUCTIONS: Final = "instructions"
"""Description of the simulator `CLOCK` if its clock counts the instructions of an emulated processor.

Differences of its times are then not real durations.
"""


class Backend(Protocol):
    """A source of robots, created from the lab's site file: `Backend(site, document)`.

    The constructor only checks the site file; it raises `ConfigurationError` if an entry is missing there.
    """

    permissions: frozenset[str]
    """Names of the permissions that the operator gave by options `--allow-NAME`; empty in a new backend."""

    @property
    def by_hand(self) -> bool:
        """Whether people set up the robots and carry them to their places."""
        ...

    @property
    def lab_bytes(self) -> int:
        """Maximum number of bytes that the testbed itself writes per attempt, in addition to the robots' files."""
        ...

    def cast(self, topology: Topology) -> Cast:
        """Return the robot in each role without contacting any robot (`--dry-run` uses nothing else).

        Steps move robots with `Robot.abilities`; `Testbed.moving` moves the others.

        Raises:
            ConfigurationError: The site file gives no roles for this topology.
        """
        ...

    def open(self, cast: Cast, *, seed: int, sink: Sink, operator: Operator) -> AbstractContextManager[Testbed]:
        """Start the testbed of a cast; leaving the context removes it completely.

        It need not check that every robot can be reached: `fieldkit.trial.running.preflight` does.

        Args:
            cast: The result of `cast`.
            seed: Seed of all random numbers of the lab. A resumed trial has another seed with the same
                `fieldkit.core.seeds.place_seed`.
            sink: Receives the names of phases.
            operator: Performs actions that need a person.

        Raises:
            ConfigurationError: A permission or a program is missing on this machine.
            LinkError: A robot cannot be reached.
        """
        ...

    def persistent_shells(self, *, sink: Sink) -> AbstractContextManager[Mapping[str, Shell | FieldkitError]]:
        """Return a context with control connections to the robots that keep running without fieldkit, in any role.

        Args:
            sink: Receives the names of phases.

        Returns:
            A context that yields the connection, or the error of the attempt to connect, by name of the robot. The
            mapping is empty if the robots disappear with their lab.
        """
        ...


@runtime_checkable
class Simulating(Protocol):
    """Optional capability of a `Backend` whose robots run on simulators.

    Attributes:
        simulators: Description of each simulator by its purpose: `physics`, `network`, `sync` (the policy between
            physics and network), `wifi` or `CLOCK`. Empty if there are none.
    """

    simulators: Mapping[str, str]


@runtime_checkable
class Relocating(Protocol):
    """Optional capability of a `Backend` that may have to run commands of fieldkit in a virtual machine."""

    @property
    def must_relocate(self) -> bool:
        """True if commands that use robots cannot run in this process."""
        ...

    def run_elsewhere(self, argv: Sequence[str], results: Path) -> int:
        """Run a command line of fieldkit elsewhere.

        Args:
            argv: The words after `fieldkit`.
            results: Folder that the command may change; it is created. Other changes may be lost.

        Returns:
            Its exit code.

        Raises:
            FieldkitError: It cannot run.
        """
        ...


def simulators_of(backend: Backend) -> dict[str, str]:
    """Return the simulators of a backend; empty if its robots are real, or use only a radio model."""
    return dict(backend.simulators) if isinstance(backend, Simulating) else {}


class BackendFactory(Protocol):
    """The object of an entry point of the group `fieldkit.backends`, usually the backend's class."""

    def __call__(self, site: Site | None, document: Document | None) -> Backend:
        """Return the backend for a site file, or for a lab without a site file."""
        ...
