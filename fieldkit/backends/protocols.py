"""Protocols of backends: a source of robots, its robots when they are up, and what a carrier of packets knows."""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Protocol, runtime_checkable

from fieldkit.config import schema
from fieldkit.config.profiles import RobotProfile
from fieldkit.config.schema import Bool, Document, Field, Strict
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
    Whereabouts,
)
from fieldkit.core.prompts import Answer, Operator
from fieldkit.remote.shell import Shell


class Robot(Strict):
    """A robot in a role; the plan of a trial holds it as it is.

    Attributes:
        name: Its name in the lab, `turtlebot-1`.
        address: Its IPv4 address on the radio under test.
        profile: What it is.
        control: Which way SSH takes to it, as the site file says.
        ros_master: Address on the radio of the robot whose ROS master it uses; empty where its setup files say which.
        drives: Whether it drives by itself where a step moves it, by the topic of its profile.
        flies: Whether a step may fly it.
    """

    name: str
    address: str
    profile: RobotProfile
    control: Control = Control.SEPARATE
    ros_master: str = Field(default="", exclude_if=schema.is_empty)
    drives: Bool = Field(default=False, exclude_if=schema.is_empty)
    flies: Bool = Field(default=False, exclude_if=schema.is_empty)

    @property
    def ros_graph(self) -> str:
        """What robots have in common that hear each other's topics, in words; empty for one whose are its own."""
        ros = self.profile.ros
        if ros is not None and ros.variant == "ros2":
            return f"ROS domain {ros.domain}{' over Zenoh' if ros.middleware == 'zenoh' else ''}"
        return f"the ROS master at {self.ros_master}" if self.ros_master else ""

    @property
    def ros_environment(self) -> dict[str, str]:
        """The variables that its ROS programs run with, beside those of its setup files.

        Where robots share a master they find each other by addresses on the radio: ROS_HOSTNAME comes before ROS_IP,
        whatever a setup file says of either (wiki.ros.org/ROS/EnvironmentVariables).
        """
        own = dict(self.profile.ros.environment) if self.profile.ros else {}
        if not self.ros_master:
            return own
        master = f"http://{self.ros_master}:{ROS_MASTER_PORT}"
        return own | {"ROS_MASTER_URI": master, "ROS_HOSTNAME": self.address}


Cast = Mapping[Role, Robot]


class Oracle(Protocol):
    """What is known only to who carries the packets: how late they were, what delayed them, where the robots were."""

    def track(self, since_utc_ns: int) -> Sequence[Whereabouts]:
        """Return where the robots were from a moment of the laptop's clock on, until now.

        Asked with times that never go back: what was before may be forgotten.

        Returns:
            In the order of time. Of each robot, first what held at that moment, with the time since when it did.
        """
        ...

    def delays(self, source: Role, destination: Role, protocol: model.Protocol, port: int) -> DelayParts:
        """Return what the packets from one robot to a port of another were delayed by.

        Args:
            source: Who sends.
            destination: Who receives.
            protocol: Transport protocol.
            port: Port of `destination` that they go to, by which they are told from those of other flows.

        Returns:
            Sums over the packets of this flow, fragments too, that `destination` was given since they were asked
            for first.

        Raises:
            LinkError: What carries them did not answer.
        """
        ...

    def lateness(self) -> Lateness:
        """Return how far the modelled radio fell behind its model, over all packets since the testbed came up.

        Raises:
            LinkError: What carries the packets did not answer.
        """
        ...

    def links(self, *, go_on: bool) -> Mapping[Role, Sequence[LinkSample]]:
        """Return what the robots' radios told of their links five times a second since this was asked last, and now.

        Args:
            go_on: Whether they are to be sampled from now on; they are not before anybody asked.

        Returns:
            By robot, in the order of time; times are those of the laptop's clock, stations the robots' names.

        Raises:
            LinkError: What carries the packets did not answer.
        """
        ...

    def record_air(self, folder: Path | None) -> None:
        """Write every transmission from now on into `folder`, if the site file asks for it.

        Args:
            folder: Where to; None to write no longer.

        Raises:
            LinkError: What carries the packets did not answer.
            OSError: The files cannot be made.
        """
        ...


class Testbed(Protocol):
    """Robots that are up and reachable, and what can be done to them in every lab."""

    @property
    def shells(self) -> Mapping[Role, Shell]:
        """The control connection of each robot of the cast."""
        ...

    @property
    def oracle(self) -> Oracle | None:
        """What is known of the packets under way; None where the radio is real. It does not change."""
        ...

    @property
    def operator(self) -> Operator:
        """Who does what it cannot do by itself, and is asked what only a person sees."""
        ...

    def place(self, placement: Placement) -> Answer:
        """Bring the robots to their places; returns when they stand there.

        Returns:
            What the operator said to it: a note, or to leave this placement for later.

        Raises:
            FieldkitError: They could not be placed.
        """
        ...

    def inject(self, fault: Fault) -> float | None:
        """Do something to a robot on purpose; returns when the cause is over, which is before the robot has healed.

        The link is up again, the robot has power again, the process has been killed.

        Returns:
            How many seconds the cause lasted, 0 for a reboot or a kill; None where nobody can know.

        Raises:
            RobotError: It could not be done, for example because no such process runs.
            LinkError: The robot could not be told to.
        """
        ...

    def moving(self, move: Move) -> AbstractContextManager[None]:
        """Let a robot move from its place, from when the context is entered.

        At the end of its way the robot stands. Leaving the context brings it back to its place, also after an error,
        so that each repeat begins alike.

        Raises:
            FieldkitError: The robot could not be moved, or not brought back.
        """
        ...

    def bring_back(self, role: Role, *, by_itself: bool) -> None:
        """See that a robot that drove by itself stands at its place again.

        Args:
            role: Whose robot.
            by_itself: Whether it says that it is back.

        Raises:
            FieldkitError: It could not be brought.
        """
        ...


@runtime_checkable
class Transient(Protocol):
    """An optional part of a `Testbed`: its robots, and all files on them, end with it."""

    def demand_up(self) -> None:
        """Return if every process that the robots need runs.

        Raises:
            TestbedLostError: One of them has ended, or does not answer any more.
        """
        ...


@runtime_checkable
class Attended(Protocol):
    """An optional part of a `Testbed` whose robots are real: who confirms that robots may move again after a fault.

    Without it nobody does, and after a fault nothing moves by itself again.
    """

    @property
    def operator(self) -> Operator:
        """Who is asked."""
        ...

    @property
    def allow_motion_after_fault(self) -> bool:
        """Whether robots may move from where a fault stopped them, as `--allow-motion-after-fault` says."""
        ...


class Backend(Protocol):
    """A source of robots, made from the lab's site file: `Backend(site, document)`.

    Making it checks the site file and touches nothing else; `ConfigurationError` says what the backend misses there.
    """

    allow_motion: bool
    """Whether fieldkit may drive real robots, as `--allow-motion` says; a new backend may not."""

    @property
    def by_hand(self) -> bool:
        """Whether people rig the robots and carry them to their places."""
        ...

    @property
    def lab_bytes(self) -> int:
        """How many bytes an attempt gets from the testbed itself at most, beside what robots leave."""
        ...

    def cast(self, topology: Topology) -> Cast:
        """Return who plays which role, without touching any robot (`--dry-run` uses this alone).

        Robots with `Robot.drives` are driven by the steps that move them; others `Testbed.moving` moves.

        Raises:
            ConfigurationError: The site file gives no roles for this topology.
        """
        ...

    def open(self, cast: Cast, *, seed: int, sink: Sink, operator: Operator) -> AbstractContextManager[Testbed]:
        """Bring up the lab of a cast from `cast`; leaving the context takes it down without trace.

        Whether every robot can be reached is for `fieldkit.trial.running.preflight` to find out.

        Args:
            cast: What `cast` returned.
            seed: Seed of everything random in the lab.
            sink: Told about phases.
            operator: Does what a backend cannot do by itself.

        Raises:
            ConfigurationError: A right or a program is missing on this machine.
            LinkError: A robot cannot be reached.
        """
        ...

    def standing(self, *, sink: Sink) -> AbstractContextManager[Mapping[str, Shell | FieldkitError]]:
        """Give control connections to the robots of the site file that go on without fieldkit, whatever their roles.

        Args:
            sink: Told about phases.

        Returns:
            A context that gives the connection of each robot by its name, or why there is none; none at all where
            robots end with their lab.
        """
        ...


class BackendFactory(Protocol):
    """What an entry point of the group `fieldkit.backends` names: usually the backend's class."""

    def __call__(self, site: Site | None, document: Document | None) -> Backend:
        """Return the backend for a site file, or for no site file."""
        ...
