"""Emulated robots of one cast, up and on the air."""

from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager

from fieldkit.backends import Cast
from fieldkit.model import Placement, Role
from fieldkit.remote.shell import Shell
from fieldkit.remote.ssh import SshShell
from sim_backends.emulated import placement as places
from sim_backends.emulated.keys import KeyPair
from sim_backends.emulated.medium_client import MediumClient
from sim_backends.emulated.options import RosChoice
from sim_backends.emulated.robot import EmulatedRobot
from sim_backends.emulated.spec import RobotSpec, Sensor
from sim_backends.radio.options import RadioOptions

USER = "root"
NETWORK_BITS = 24


class EmulatedLab:
    """Robots on one medium.

    Args:
        cast: Who plays which role.
        robots: The robots.
        shells: Their control connections.
        medium: Carries their packets.
    """

    def __init__(
        self, cast: Cast, robots: Mapping[Role, EmulatedRobot], shells: Mapping[Role, Shell], medium: MediumClient
    ) -> None:
        self._cast = cast
        self.robots = robots
        self._shells = shells
        self.medium = medium

    @property
    def shells(self) -> Mapping[Role, Shell]:
        """See `Lab.shells`."""
        return self._shells

    def place(self, placement: Placement) -> None:
        """See `Lab.place`; robots arrive at once."""
        self.medium.place(
            places.positions_m(self._cast, placement),
            behind_wall=places.behind_wall(self._cast, placement),
            relay=places.relay(self._cast, placement),
        )


@contextmanager
def bring_up(cast: Cast, *, radio: RadioOptions, ros: RosChoice, seed: int) -> Iterator[EmulatedLab]:
    """Yield the lab of a cast; leaving the context ends every process of it.

    Args:
        cast: Who plays which role.
        radio: The radio between them.
        ros: `debian` or `builtin`.
        seed: Seed of everything random in the medium.

    Raises:
        FieldkitError: A robot or the medium did not come up.
    """
    login, host_keys = KeyPair.make(), {role: KeyPair.make() for role in cast}
    with ExitStack() as stack:
        medium = stack.enter_context(MediumClient(radio, seed=seed))
        # Entered before the robots and left after them: a robot that ends ends the request that waits for it.
        pool = stack.enter_context(ThreadPoolExecutor(len(cast)))
        robots: dict[Role, EmulatedRobot] = {}
        for role in cast:
            spec = specification(cast, role, ros=ros, login=login, host_key=host_keys[role])
            robots[role] = stack.enter_context(EmulatedRobot(spec))
        list(pool.map(_build, robots.values()))
        started = pool.map(EmulatedRobot.start, robots.values())
        for role, robot in robots.items():
            medium.attach(robot.spec.name, robot.spec.address, cast[role].profile.radio, robot.radio_fd)
        list(started)
        shells: dict[Role, Shell] = {
            role: stack.enter_context(closing(_shell(robot, login, host_keys[role])))
            for role, robot in robots.items()
        }
        yield EmulatedLab(cast, robots, shells, medium)
        for robot in robots.values():
            robot.hang_up()


def _build(robot: EmulatedRobot) -> None:
    robot.build()
    robot.open_radio()


def _shell(robot: EmulatedRobot, login: KeyPair, host_key: KeyPair) -> SshShell:
    return SshShell(
        robot.spec.name,
        connect=robot.connect,
        user=USER,
        host_key=host_key.public,
        private_key=login.private,
    )


def sensors_of(cast: Cast, role: Role) -> tuple[Sensor, ...]:
    """Return what the robot in `role` publishes."""
    topics = cast[role].profile.ros.topics
    return tuple(Sensor(one.name, one.type, one.rate, one.frame, one.points) for one in topics)


def specification(cast: Cast, role: Role, *, ros: RosChoice, login: KeyPair, host_key: KeyPair) -> RobotSpec:
    """Return what the robot in `role` is told about itself."""
    robot = cast[role]
    command = robot.profile.ros.command
    return RobotSpec(
        name=robot.name,
        interface=robot.profile.radio.interface,
        address=f"{robot.address}/{NETWORK_BITS}",
        hosts={one.name: one.address for one in cast.values()},
        host_key=host_key.private,
        authorized_key=login.public,
        ros=ros.value,
        distribution=command.distribution,
        setup=command.setup,
        sensors=sensors_of(cast, role),
    )
