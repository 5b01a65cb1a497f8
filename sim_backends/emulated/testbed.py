"""Emulated robots of one cast, up and on the air."""

import socket
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from functools import partial
from pathlib import Path
from typing import Final

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
    Whereabouts,
)
from fieldkit.core.prompts import DONE, NOBODY, Answer, Operator
from fieldkit.remote.shell import Shell
from fieldkit.remote.ssh import PATIENCE_S, SshShell
from sim_backends.emulated import placement as places
from sim_backends.emulated.medium.client import MediumClient
from sim_backends.emulated.mobility import Mobility
from sim_backends.emulated.nodes import LAPTOP_RADIO, Laptop, Node
from sim_backends.emulated.options import EmulatedOptions, MeshOptions, RosChoice
from sim_backends.emulated.provisioning import LAPTOP_ADDRESS, NETWORK, RobotKey
from sim_backends.emulated.robot.spec import USER
from sim_backends.emulated.startup import RunningRobots, running_robots
from sim_backends.world.world import World

_IP_PROTOCOL: Final = {Protocol.TCP: socket.IPPROTO_TCP, Protocol.UDP: socket.IPPROTO_UDP}


class EmulatedOracle:
    """What the medium knows of the packets that it carries, and where it was told that robots are.

    Args:
        names: Name of each robot.
        medium: Carries their packets.
        mobility: Tells the medium where they are.
        options: The lab's options: whether to record the air, and from which lateness on a repeat is void.
    """

    def __init__(
        self, names: Mapping[Role, str], medium: MediumClient, mobility: Mobility, options: EmulatedOptions
    ) -> None:
        self._names = names
        self._medium = medium
        self._mobility = mobility
        self._late_bound_s = options.late_bound
        self._recorded = options.record_air

    def track(self, since_utc_ns: int) -> tuple[Whereabouts, ...]:
        """See `Oracle.track`; robots are where the medium was told."""
        return self._mobility.track(since_utc_ns)

    def delays(self, source: Role, destination: Role, protocol: Protocol, port: int) -> DelayParts:
        """See `Oracle.delays`."""
        return self._medium.delays(self._names[source], self._names[destination], _IP_PROTOCOL[protocol], port)

    def lateness(self) -> Lateness:
        """See `Oracle.lateness`."""
        return Lateness(bound_ns=round(self._late_bound_s * 1e9), packets=self._medium.stats().late)

    def links(self, *, go_on: bool) -> dict[Role, list[LinkSample]]:
        """See `Oracle.links`."""
        links = self._medium.links(go_on=go_on)
        return {role: links.get(name, []) for role, name in self._names.items()}

    def record_air(self, folder: Path | None) -> None:
        """See `Oracle.record_air`."""
        if self._recorded:
            self._medium.record(folder)


class EmulatedTestbed:
    """Robots on one medium.

    Args:
        cast: Who plays which role.
        up: What runs.
        shells: The robots' control connections.
        options: The lab's options.
        world: What they stand in.
        laptop: From where the shells reach them over the medium; None where they have a way of their own.
        operator: Who is asked what steps want to know.
    """

    def __init__(
        self,
        cast: Cast,
        up: RunningRobots[Role],
        shells: Mapping[Role, Shell],
        *,
        options: EmulatedOptions,
        world: World,
        laptop: Laptop | None,
        operator: Operator,
    ) -> None:
        self.operator = operator
        self.robots = up.robots
        self.medium = up.medium
        self._laptop = laptop
        self._shells = shells
        self._boot_s = options.boot
        self._mobility = Mobility(cast, up.medium, world, laptop, up.robots, show=up.places.write)
        names = {role: robot.name for role, robot in up.robots.items()}
        self._oracle = EmulatedOracle(names, up.medium, self._mobility, options)

    @property
    def shells(self) -> Mapping[Role, Shell]:
        """See `Testbed.shells`."""
        return self._shells

    @property
    def oracle(self) -> EmulatedOracle:
        """See `Testbed.oracle`."""
        return self._oracle

    def demand_up(self) -> None:
        """See `Transient.demand_up`."""
        self.medium.demand_up()
        nodes: list[Node] = [*self.robots.values()]
        for node in nodes if self._laptop is None else [*nodes, self._laptop]:
            node.demand_up()

    def place(self, placement: Placement) -> Answer:
        """See `Testbed.place`; robots arrive at once."""
        self._mobility.place(placement)
        return DONE

    def inject(self, fault: Fault) -> float | None:
        """See `Testbed.inject`; what was begun is undone also when this is interrupted."""
        robot = self.robots[fault.role]
        match fault.kind:
            case FaultKind.LINK_DOWN:
                return _lasting(fault.duration_s, robot.switch_off, robot.switch_on)
            case FaultKind.OUT_OF_RANGE:
                away = partial(self._mobility.put_away, fault.role)
                return _lasting(fault.duration_s, away, partial(self._mobility.put_away, None))
            case FaultKind.REBOOT:
                _lasting(self._boot_s, robot.halt, robot.boot)
            case FaultKind.KILL:
                robot.kill(fault.process)
        return 0.0

    def bring_back(self, role: Role, *, by_itself: bool) -> None:  # noqa: ARG002 (each repeat is to begin alike)
        """See `Testbed.bring_back`; the robot is at its place at once, exactly, whatever its odometry says."""
        self._mobility.put_back(role)

    def watching(self) -> AbstractContextManager[object]:
        """Return a context in which the medium is told of robots that steer themselves."""
        return self._mobility.watching()

    def moving(self, move: Move) -> AbstractContextManager[None]:
        """See `Testbed.moving`; the robot is back at its place at once."""
        return self._mobility.moving(move)


def _lasting(duration_s: float, begin: Callable[[], None], end: Callable[[], None]) -> float:
    """Begin something, end it after `duration_s` whatever happens, and return how long it lasted."""
    begin()
    began_s = time.monotonic()
    try:
        time.sleep(duration_s)
    finally:
        end()
    return time.monotonic() - began_s


@contextmanager
def bring_up(
    cast: Cast,
    *,
    options: EmulatedOptions,
    world: World,
    ros: RosChoice,
    seed: int,
    control: Control = Control.SEPARATE,
    patience_s: float = PATIENCE_S,
    notice: Callable[[str], None] = lambda text: None,  # noqa: ARG005
    operator: Operator = NOBODY,
) -> Iterator[EmulatedTestbed]:
    """Yield the testbed of a cast; leaving the context ends every process of it.

    Args:
        cast: Who plays which role.
        options: The lab's options; `world` and `ros` are what became of those.
        world: What the robots stand in.
        ros: `debian` or `builtin`, for robots with ROS 1.
        seed: Seed of everything random in the medium.
        control: Whether SSH crosses the radio; if so, a robot out of the laptop's range is out of reach.
        patience_s: How long a lost control connection is awaited.
        notice: Told when it is lost, and when it is back.
        operator: Who is asked what steps want to know.

    Raises:
        FieldkitError: A robot or the medium did not come up.
    """
    with ExitStack() as stack:
        up = stack.enter_context(running_robots(cast, options=options, world=world, ros=ros, seed=seed))
        laptop = stack.enter_context(laptop_on_air(up, options.mesh)) if control is Control.RADIO else None
        if laptop is not None:  # it reaches them before they have places of their own
            up.medium.place(places.together_m([*(robot.name for robot in up.robots.values()), laptop.name]))
        shells: dict[Role, Shell] = {}
        for role in up.robots:
            shell = _shell(up, role, laptop, patience_s, notice)
            shells[role] = stack.enter_context(closing(shell))
        testbed = EmulatedTestbed(cast, up, shells, options=options, world=world, laptop=laptop, operator=operator)
        stack.enter_context(testbed.watching())
        yield testbed


@contextmanager
def laptop_on_air(up: RunningRobots[RobotKey], mesh: MeshOptions | None) -> Iterator[Laptop]:
    """Yield the laptop, which has no place yet.

    In a mesh it finds its way over the robots, and forwards for nobody.
    """
    with Laptop(f"{LAPTOP_ADDRESS}/{NETWORK.prefixlen}") as laptop:
        laptop.open_radio(mesh=mesh is not None, guest_hello_s=None if mesh is None else mesh.hello)
        up.medium.attach(laptop.name, laptop.address, LAPTOP_RADIO, laptop.radio_fd)
        yield laptop


def _shell(
    up: RunningRobots[Role], role: Role, laptop: Laptop | None, patience_s: float, notice: Callable[[str], None]
) -> SshShell:
    """Return the control connection of a robot, over the radio where there is a laptop on it."""
    robot = up.robots[role]

    def connect(timeout_s: float) -> socket.socket:
        if laptop is None:
            return robot.connect(timeout_s)
        up.medium.demand_up()  # nobody waits for an answer that nothing carries
        robot.demand_up()
        return laptop.reach(robot.spec.ip, timeout_s)

    return SshShell(
        robot.name,
        connect=connect,
        user=USER,
        host_key=up.host_keys[role],
        private_key=up.private_key,
        patience_s=patience_s,
        notice=notice,
        on_air=laptop is not None,
    )
