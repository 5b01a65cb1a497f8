"""The field backend: real robots over SSH, placed by a person."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Final

from fieldkit.backends import field_shells
from fieldkit.backends.protocols import Cast, Testbed
from fieldkit.backends.registry import cast_of
from fieldkit.config.profiles import RobotProfile
from fieldkit.config.schema import Document
from fieldkit.config.site import Site, is_ipv4
from fieldkit.core import geometry
from fieldkit.core.errors import ConfigurationError, FieldkitError, describe_exception
from fieldkit.core.events import Note, Sink
from fieldkit.core.model import Control, Fault, FaultKind, Move, Placement, Role, Scenario, Topology
from fieldkit.core.prompts import Answer, Operator
from fieldkit.core.units import format_distance
from fieldkit.remote import passwords
from fieldkit.remote.shell import Shell


class FieldBackend:
    """Real robots over SSH, placed by a person.

    Args:
        site: The site file.
        document: The parsed site file, which gives the lines in error messages.
        ask: Prompts the operator for a password without echo.

    Attributes:
        permissions: Names of the permissions that the operator gave. Without permission to move robots, the operator
            is asked to move them.
    """

    by_hand: Final = True
    lab_bytes: Final = 0  # the testbed writes no files of its own

    def __init__(
        self,
        site: Site | None,
        document: Document | None,
        ask: passwords.PasswordSource = passwords.read_from_terminal,
    ) -> None:
        if site is None or document is None:
            raise ConfigurationError(
                "the field backend needs a site file",
                remedy="fieldkit init, then fill it in; or name a site file with --site",
            )
        if site.has_default_robots:
            raise ConfigurationError(
                "the field backend needs robots and roles, and the site file has none",
                where=document.where(()),
                remedy="add robots: and roles: to it, as in the file of fieldkit init --out example.yaml",
            )
        for name, robot in site.robots.items():
            for key in ("host", "user", "host_key"):
                if getattr(robot, key) is None:
                    remedy = f"fieldkit enroll {name}" if key == "host_key" else f"add {key}: to it"
                    if site.emulated is not None and robot.host is None:
                        remedy += "; or, for emulated robots, write backend: emulated"
                    raise ConfigurationError(
                        f"robot {name!r} has no {key}", where=document.where(("robots", name)), remedy=remedy
                    )
        self._site = site
        self._document = document
        self._ask = ask
        self.permissions: frozenset[str] = frozenset()
        self._passwords: dict[str, str | None] = {}

    def cast(self, topology: Topology) -> Cast:
        """Return the robot in each role; see `Backend.cast`."""
        addresses = {name: robot.address or robot.host or "" for name, robot in self._site.robots.items()}
        link_addresses = {name: robot.links for name, robot in self._site.robots.items()}
        cast = cast_of(self._site, self._document, topology, addresses, link_addresses)
        for robot in cast.values():
            if not is_ipv4(robot.address):
                raise ConfigurationError(
                    f"robot {robot.name!r} has no IPv4 address on the radio: its host is {robot.address!r}",
                    where=self._document.where(("robots", robot.name)),
                    remedy="add address: to it",
                )
            same_address_names = [
                other.name for other in cast.values() if other.address == robot.address and other is not robot
            ]
            if same_address_names:
                raise ConfigurationError(
                    f"robots {robot.name!r} and {same_address_names[0]!r} have the same address on the radio, "
                    f"{robot.address}",
                    where=self._document.where(("robots", robot.name)),
                    remedy="correct address: of one of them",
                )
        return {
            role: robot.model_copy(update={"abilities": self._abilities(robot.profile)})
            for role, robot in cast.items()
        }

    def _abilities(self, profile: RobotProfile) -> frozenset[str]:
        """Return the sections of a profile that steps may use to move the robot, with the given permissions."""
        sections = profile.sections.items()
        return frozenset(key for key, section in sections if section.permission in self.permissions)

    @contextmanager
    def open(self, cast: Cast, *, seed: int, sink: Sink, operator: Operator) -> Iterator[Testbed]:  # noqa: ARG002 (real robots need no seed)
        """Yield the testbed; see `Backend.open`. Each robot is connected at its first command."""
        shells: dict[Role, Shell] = {}
        try:
            for role, robot in cast.items():
                shells[role] = self._shell(robot.name, sink)
            yield FieldTestbed(cast, shells, operator, permissions=self.permissions)
        finally:
            for shell in shells.values():
                shell.close()

    @contextmanager
    def persistent_shells(self, *, sink: Sink) -> Iterator[Mapping[str, Shell | FieldkitError]]:
        """Yield the connection or the error of each robot; see `Backend.persistent_shells`.

        Each robot is connected at its first command.
        """
        shells = {name: _shell_or_error(partial(self._shell, name, sink)) for name in self._site.robots}
        try:
            yield shells
        finally:
            for shell in shells.values():
                if not isinstance(shell, FieldkitError):
                    shell.close()

    def _shell(self, name: str, sink: Sink) -> Shell:
        robot = self._site.robots[name]
        if name not in self._passwords:  # requested once per run
            self._passwords[name] = field_shells.find_password(name, robot, self._ask)
        return field_shells.open_shell(
            name,
            robot,
            self._passwords[name],
            reconnect_timeout_s=self._site.patience,
            on_notice=lambda text: sink(Note(text)),
            crosses_radio=self._site.control is Control.RADIO,
        )


def _shell_or_error(open_shell: Callable[[], Shell]) -> Shell | FieldkitError:
    try:
        return open_shell()
    except FieldkitError as error:
        return error


class FieldTestbed:
    """Real robots that the operator places and moves.

    Args:
        cast: The robot in each role.
        shells: Control connection of each robot.
        operator: The operator.
        permissions: Actions that the operator has permitted; see `Attended`.
    """

    oracle: Final = None  # the true loss and delay of real radios are unknown

    def __init__(
        self,
        cast: Cast,
        shells: Mapping[Role, Shell],
        operator: Operator,
        *,
        permissions: frozenset[str] = frozenset(),
    ) -> None:
        self.permissions = permissions
        self._cast = cast
        self._shells = shells
        self.operator = operator

    @property
    def shells(self) -> Mapping[Role, Shell]:
        """The control connection of each robot of the cast."""
        return self._shells

    def place(self, placement: Placement) -> Answer:
        """Ask the operator to place the robots; see `Testbed.place`."""
        names, topology = {role: robot.name for role, robot in self._cast.items()}, placement.topology
        sender, receiver = names[Role.SENDER], names[Role.RECEIVER]
        distance = format_distance(placement.distance)
        is_nlos = placement.scenario is Scenario.NLOS
        if topology is Topology.MASTER:
            text = f"move {sender} and {receiver} to {distance} from {names[Role.RELAY]}, on opposite sides of it"
            wall = f"{sender} behind the wall"
        else:
            text = f"move {sender} to {distance} from {receiver}"
            wall = "behind the wall"
        posts = "".join(
            f"; put {names[post.role]} {geometry.describe_leg(post.leg)} of {names[post.near]}, as seen from "
            + names[geometry.other_end(post.near, topology)]
            for post in placement.posts
        )
        directions = "".join(
            "; " + section.placement.format(robot=robot.name, other=names[geometry.other_end(role, topology)])
            for role, robot in self._cast.items()
            for key, section in robot.profile.sections.items()
            if key in robot.abilities and section.placement
        )
        return self.operator.ask(
            f"{text}, {wall if is_nlos else 'nothing between them'}{posts}{directions}", may_skip=True
        )

    def inject(self, fault: Fault) -> float | None:
        """Ask the operator to cause a fault; see `Testbed.inject`.

        The duration of `link-down` is the time between the operator's two answers.
        """
        name = self._cast[fault.role].name
        match fault.kind:
            case FaultKind.LINK_DOWN:
                what = f"the link {fault.link}" if fault.link else "the Wi-Fi"
                self.operator.ask(f"switch {what} of {name} off")
                start_s = time.monotonic()
                time.sleep(fault.duration_s)
                self.operator.ask(f"switch {what} of {name} on again")
                return time.monotonic() - start_s
            case FaultKind.OUT_OF_RANGE:
                self.operator.ask(f"carry {name} out of range, wait {fault.duration_s:g} s, and carry it back")
                return None  # the operator cannot observe where the radio range ends
            case FaultKind.REBOOT:
                self.operator.ask(f"reboot {name}")
            case FaultKind.KILL:
                self.operator.ask(f"kill {fault.process} on {name}")
        return 0.0

    @contextmanager
    def moving(self, move: Move) -> Iterator[None]:
        """Ask the operator to move a robot, and to bring it back unless the trial is interrupted."""
        name = self._cast[move.role].name
        topology = Topology.MASTER if Role.RELAY in self._cast else Topology.MASTERLESS
        other = self._cast[geometry.other_end(move.role, topology)].name
        self.operator.ask(
            f"move {name}, as seen from {other}: {geometry.describe_move(move)}; answer when it starts to move"
        )
        try:
            yield
        except Exception as error:
            try:
                self._bring_back(name)
            except ConfigurationError as operator_error:
                operator_error.what += f"; before that, the move failed: {describe_exception(error)}"
                raise
            raise
        self._bring_back(name)

    def bring_back(self, role: Role, *, has_returned: bool) -> None:
        """Ask the operator to bring back a robot that did not drive back; see `Testbed.bring_back`."""
        if not has_returned:
            self._bring_back(self._cast[role].name)

    def _bring_back(self, name: str) -> None:
        self.operator.ask(f"bring {name} back to its place")
