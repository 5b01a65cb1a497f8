"""Startup of emulated robots for a trial or an interactive lab: file systems, radios, programs."""

from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from typing import Final, Generic

from fieldkit.backends.protocols import Robot
from fieldkit.lab.protocol import LabRobot
from sim_backends.emulated import placement
from sim_backends.emulated.medium.client import MediumClient
from sim_backends.emulated.medium.framing import ETHERNET, IP
from sim_backends.emulated.nodes import EmulatedRobot
from sim_backends.emulated.options import EmulatedOptions, RosChoice
from sim_backends.emulated.provisioning import KeyPair, RobotKey, robot_spec
from sim_backends.emulated.ros.neighbours import PlacesWriter
from sim_backends.radio.modes import fixed_mode, standard_of
from sim_backends.world.world import World

_MAX_PARALLEL_STARTS: Final = 16
"""Number of robots that are built and started at the same time; each needs a thread here and processor time."""


@dataclass(frozen=True)
class RunningRobots(Generic[RobotKey]):
    """Running robots on one medium, without places yet.

    Attributes:
        robots: The robots.
        medium: The medium that carries their packets.
        places: Writer of the robots' places, for the lasers of the other robots.
        host_keys: Public host key of each robot.
        private_key: Private key that logs in on all robots, OpenSSH PEM.
    """

    robots: Mapping[RobotKey, EmulatedRobot]
    medium: MediumClient
    places: PlacesWriter
    host_keys: Mapping[RobotKey, str]
    private_key: str = field(repr=False)


@contextmanager
def running_robots(
    robots: Mapping[RobotKey, Robot | LabRobot],
    *,
    options: EmulatedOptions,
    world: World,
    ros: RosChoice,
    seed: int,
) -> Iterator[RunningRobots[RobotKey]]:
    """Yield robots whose programs serve; leaving the context stops all their processes.

    The arguments are those of `testbed.bring_up`. Robots that share a ROS master or a Zenoh router start 1 m apart,
    and connect to it over the radio.

    Raises:
        ConfigurationError: The site file fixes a radio mode that one of the robots does not have.
        FieldkitError: A robot or the medium did not start.
    """
    fixed_mode(options.radio.mode, {robot.name: standard_of(robot.profile.radio) for robot in robots.values()})
    login, host_keys = KeyPair.make(), {key: KeyPair.make() for key in robots}
    with ExitStack() as stack:
        framing = IP if options.mesh is None else ETHERNET
        medium = stack.enter_context(MediumClient(options.radio, world, seed=seed, framing=framing))
        places = stack.enter_context(closing(PlacesWriter([robot.name for robot in robots.values()])))
        # Entered before the robots and left after them: when a robot exits, the request that waits for it fails.
        pool = stack.enter_context(ThreadPoolExecutor(min(len(robots), _MAX_PARALLEL_STARTS)))
        up: dict[RobotKey, EmulatedRobot] = {}
        for key in robots:
            spec = robot_spec(
                robots, key, ros=ros, login=login, host_key=host_keys[key], options=options, world=world
            )
            up[key] = stack.enter_context(EmulatedRobot(spec, places.fd))
        list(pool.map(_build, up.values()))
        # Robots with a ROS master start first, because the other robots wait for it.
        started = pool.map(EmulatedRobot.start, sorted(up.values(), key=lambda robot: not robot.spec.runs_master))
        for key, robot in up.items():
            medium.attach(robot.name, robot.address, robots[key].profile.radio, robot.radio_fd)
        if any(robot.spec.waits_for_another for robot in up.values()):
            medium.place(placement.side_by_side_m(robot.name for robot in up.values()))
        list(started)
        yield RunningRobots(up, medium, places, {key: pair.public for key, pair in host_keys.items()}, login.private)
        for robot in up.values():
            robot.hang_up()


def _build(robot: EmulatedRobot) -> None:
    robot.build()
    robot.open_radio(mesh=robot.spec.mesh_hello_s is not None)
