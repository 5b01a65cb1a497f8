"""The testbed of the emulated robots of one cast (the robot of each role in a trial)."""

import socket
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from functools import partial
from pathlib import Path
from typing import Final

from typing_extensions import override

from fieldkit.backends.protocols import Cast
from fieldkit.core.model import (
    Control,
    DelayParts,
    Fault,
    FaultKind,
    Lateness,
    LinkSample,
    Move,
    Placement,
    Protocol,
    Role,
    TrackPoint,
)
from fieldkit.core.prompts import DONE, UNATTENDED, Answer, Operator
from fieldkit.remote.shell import Shell
from fieldkit.remote.ssh import RECONNECT_TIMEOUT_S, SshShell
from sim_backends.emulated import placement as positions
from sim_backends.emulated.emulated_options import EmulatedOptions, RosChoice
from sim_backends.emulated.medium.media import Media
from sim_backends.emulated.mobility import Mobility
from sim_backends.emulated.nodes import LAPTOP_RADIO, Laptop, Node
from sim_backends.emulated.provisioning import LAPTOP_ADDRESS, NETWORK, RobotKey
from sim_backends.emulated.robot.mesh_options import MeshOptions
from sim_backends.emulated.robot.spec import USER
from sim_backends.emulated.running_robots import RunningRobots, running_robots
from sim_backends.world.world import World

_IP_PROTOCOL: Final = {Protocol.TCP: socket.IPPROTO_TCP, Protocol.UDP: socket.IPPROTO_UDP}


class EmulatedOracle:
    """Ground truth of the medium: delays and lateness of packets, positions of robots, link samples.

    Args:
        names: Name of each robot.
        media: The media that carry the robots' packets.
        mobility: The object that places the robots in the medium.
        options: The lab's options, with the limit of lateness and the option that records transmissions.
    """

    def __init__(self, names: Mapping[Role, str], media: Media, mobility: Mobility, options: EmulatedOptions) -> None:
        self._names = names
        self._media = media
        self._medium = media.radio
        self._mobility = mobility
        self._late_bound_s = options.late_bound
        self._records_air = options.record_air
        # A co-simulation exchanges data at the end of windows of time; a window can be late like a packet.
        self._has_windows = options.is_cosimulated

    def track(self, since_utc_ns: int) -> tuple[TrackPoint, ...]:
        """Implement `Oracle.track` from the positions that the medium received."""
        return self._mobility.track(since_utc_ns)

    def delays(self, source: Role, destination: Role, protocol: Protocol, port: int, *, link: str = "") -> DelayParts:
        """Implement `Oracle.delays`: the medium sums the delays of the flow."""
        return self._media.medium_of(link).delays(
            self._names[source], self._names[destination], _IP_PROTOCOL[protocol], port
        )

    def lateness(self) -> Lateness:
        """Implement `Oracle.lateness`: counts of packets, and of windows of a co-simulation, by lateness."""
        windows = self._medium.stats().window_lateness_counts if self._has_windows else None
        return Lateness(
            bound_ns=round(self._late_bound_s * 1e9), packets=self._media.lateness_counts(), windows=windows
        )

    def links(self, *, continue_sampling: bool) -> dict[Role, list[LinkSample]]:
        """Implement `Oracle.links`: samples of the radio under test."""
        links = self._medium.links(continue_sampling=continue_sampling)
        return {role: links.get(name, []) for role, name in self._names.items()}

    def record_air(self, folder: Path | None) -> None:
        """Implement `Oracle.record_air`: record transmissions if the site file enables this."""
        if self._records_air:
            self._medium.record(folder)


class EmulatedTestbed:
    """Running robots on one medium, in the roles of a cast.

    Args:
        cast: The robot of each role.
        running: The running robots and their medium.
        shells: Control connection of each robot.
        options: The lab's options.
        world: The world around the robots.
        laptop: The node from which SSH reaches the robots over the medium; None if SSH bypasses the medium.
        operator: The person who answers the questions of steps.

    Attributes:
        robots: The handle of each robot.
        medium: The medium of the radio under test.
    """

    def __init__(
        self,
        cast: Cast,
        running: RunningRobots[Role],
        shells: Mapping[Role, Shell],
        *,
        options: EmulatedOptions,
        world: World,
        laptop: Laptop | None,
        operator: Operator,
    ) -> None:
        self.operator = operator
        self.robots = running.robots
        self.medium = running.medium
        self._media = running.media
        self._laptop = laptop
        self._shells = shells
        self._boot_s = options.boot
        self._mobility = Mobility(
            cast, running.media, world, laptop, running.robots, write_positions=running.positions_writer.write
        )
        names = {role: robot.name for role, robot in running.robots.items()}
        self._oracle = EmulatedOracle(names, running.media, self._mobility, options)

    @property
    def shells(self) -> Mapping[Role, Shell]:
        """Implement `Testbed.shells`: the control connection of each robot."""
        return self._shells

    @property
    def oracle(self) -> EmulatedOracle:
        """Implement `Testbed.oracle`: the ground truth of the medium."""
        return self._oracle

    def check_alive(self) -> None:
        """Implement `Transient.check_alive`: check the media, the robots and the laptop."""
        self._media.check_alive()
        nodes: list[Node] = [*self.robots.values()]
        for node in nodes if self._laptop is None else [*nodes, self._laptop]:
            node.check_alive()

    def place(self, placement: Placement) -> Answer:
        """Implement `Testbed.place`; robots arrive immediately."""
        self._mobility.place(placement)
        return DONE

    def inject(self, fault: Fault) -> float | None:
        """Implement `Testbed.inject`; after an interrupt, the link, the position or the power is restored."""
        robot = self.robots[fault.role]
        match fault.kind:
            case FaultKind.LINK_DOWN:
                switch_off, switch_on = partial(robot.switch_off, fault.link), partial(robot.switch_on, fault.link)
                return _apply_for(fault.duration_s, switch_off, switch_on)
            case FaultKind.OUT_OF_RANGE:
                move_away = partial(self._mobility.set_out_of_range, fault.role)
                return _apply_for(fault.duration_s, move_away, partial(self._mobility.set_out_of_range, None))
            case FaultKind.REBOOT:
                _apply_for(self._boot_s, robot.halt, robot.boot)
            case FaultKind.KILL:
                robot.kill(fault.process)
        return 0.0

    def bring_back(self, role: Role, *, has_returned: bool) -> None:  # noqa: ARG002 (all repeats must start in the same way)
        """Implement `Testbed.bring_back`; the robot returns exactly to its place, independently of its odometry."""
        self._mobility.return_to_place(role)

    def watching(self) -> AbstractContextManager[object]:
        """Return a context in which the medium receives the positions of robots that programs on board steer."""
        return self._mobility.watching()

    def moving(self, move: Move) -> AbstractContextManager[None]:
        """Implement `Testbed.moving`; the robot returns to its position immediately."""
        return self._mobility.moving(move)


class LinuxWifiTestbed(EmulatedTestbed):
    """Robots with Linux Wi-Fi. Their radio is measured with the tools of real robots, so there is no oracle.

    The arguments are those of the base class.
    """

    @property
    @override
    def oracle(self) -> None:  # type: ignore[override]  # the protocol permits None
        return None


def _apply_for(duration_s: float, apply: Callable[[], None], revert: Callable[[], None]) -> float:
    """Call `apply`, and `revert` after `duration_s` or on an interrupt.

    Return the seconds from the end of `apply` to the end of `revert`.
    """
    apply()
    start_s = time.monotonic()
    try:
        time.sleep(duration_s)
    finally:
        revert()
    return time.monotonic() - start_s


@contextmanager
def bring_up(
    cast: Cast,
    *,
    options: EmulatedOptions,
    world: World,
    ros: RosChoice,
    seed: int,
    control: Control = Control.SEPARATE,
    reconnect_timeout_s: float = RECONNECT_TIMEOUT_S,
    on_notice: Callable[[str], None] = lambda text: None,  # noqa: ARG005
    operator: Operator = UNATTENDED,
) -> Iterator[EmulatedTestbed]:
    """Yield the testbed of a cast; leaving the context stops all its processes.

    Args:
        cast: The robot of each role.
        options: The lab's options; `world` and `ros` override the options of these names.
        world: The world around the robots.
        ros: Source of ROS for robots with ROS 1, `debian` or `builtin`.
        seed: Seed of all random numbers of the medium.
        control: Network of SSH; over the radio, a robot out of the laptop's range cannot be reached.
        reconnect_timeout_s: Time to wait for a lost control connection.
        on_notice: Called with a message when a control connection is lost or restored.
        operator: The person who answers the questions of steps.

    Raises:
        FieldkitError: A robot or the medium did not start.
    """
    with ExitStack() as stack:
        running = stack.enter_context(running_robots(cast, options=options, world=world, ros=ros, seed=seed))
        laptop = stack.enter_context(laptop_on_air(running, options.mesh)) if control is Control.RADIO else None
        if laptop is not None:  # it connects to the robots before they are placed
            running.media.place(
                positions.side_by_side_m([*(robot.name for robot in running.robots.values()), laptop.name])
            )
        shells: dict[Role, Shell] = {}
        for role in running.robots:
            shell = _shell(running, role, laptop, reconnect_timeout_s, on_notice)
            shells[role] = stack.enter_context(closing(shell))
        testbed_class = LinuxWifiTestbed if options.has_linux_wifi else EmulatedTestbed
        testbed = testbed_class(cast, running, shells, options=options, world=world, laptop=laptop, operator=operator)
        stack.enter_context(testbed.watching())
        yield testbed


@contextmanager
def laptop_on_air(running: RunningRobots[RobotKey], mesh: MeshOptions | None) -> Iterator[Laptop]:
    """Yield the laptop, attached to the medium but not placed.

    In a mesh it uses the routes of the robots, and forwards no packets.
    """
    with Laptop(f"{LAPTOP_ADDRESS}/{NETWORK.prefixlen}") as laptop:
        laptop.open_radio(mesh=mesh is not None, guest_hello_s=None if mesh is None else mesh.hello_s)
        running.medium.attach(laptop.name, laptop.address, LAPTOP_RADIO, laptop.radio_fd)
        yield laptop


def _shell(
    running: RunningRobots[Role],
    role: Role,
    laptop: Laptop | None,
    reconnect_timeout_s: float,
    on_notice: Callable[[str], None],
) -> SshShell:
    """Return the control connection of a robot, over the radio if the laptop is on the air."""
    robot = running.robots[role]

    def connect(timeout_s: float) -> socket.socket:
        if laptop is None:
            return robot.connect(timeout_s)
        running.medium.check_alive()  # otherwise a connection attempt would wait for an answer that cannot arrive
        robot.check_alive()
        return laptop.reach(robot.spec.ip, timeout_s)

    return SshShell(
        robot.name,
        connect=connect,
        user=USER,
        host_key=running.host_keys[role],
        private_key=running.private_key,
        reconnect_timeout_s=reconnect_timeout_s,
        on_notice=on_notice,
        crosses_radio=laptop is not None,
    )
