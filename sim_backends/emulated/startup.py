"""Startup of robots: built, on the air, their programs serving; for a trial or to play with."""

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

_AT_ONCE: Final = 16
"""How many robots are built and started at a time: each takes a thread here, and a turn on the machine there."""


@dataclass(frozen=True)
class RunningRobots(Generic[RobotKey]):
    """Robots on one medium, without places yet.

    Attributes:
        robots: The robots.
        medium: Carries their packets.
        places: Takes where each of them is, for the lasers of the others.
        host_keys: Public host key of each.
        private_key: Logs in on all of them, OpenSSH PEM.
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
    """Yield robots that serve; leaving the context ends every process of them. Arguments as `testbed.bring_up`.

    Those that share a ROS master, or a router of Zenoh, start side by side, as people do, and find it over the radio.

    Raises:
        ConfigurationError: They are to send in a mode that one of them does not have.
        FieldkitError: A robot or the medium did not come up.
    """
    fixed_mode(options.radio.mode, {robot.name: standard_of(robot.profile.radio) for robot in robots.values()})
    login, host_keys = KeyPair.make(), {key: KeyPair.make() for key in robots}
    with ExitStack() as stack:
        framing = IP if options.mesh is None else ETHERNET
        medium = stack.enter_context(MediumClient(options.radio, world, seed=seed, framing=framing))
        places = stack.enter_context(closing(PlacesWriter([robot.name for robot in robots.values()])))
        # Entered before the robots and left after them: a robot that ends ends the request that waits for it.
        pool = stack.enter_context(ThreadPoolExecutor(min(len(robots), _AT_ONCE)))
        up: dict[RobotKey, EmulatedRobot] = {}
        for key in robots:
            spec = robot_spec(
                robots, key, ros=ros, login=login, host_key=host_keys[key], options=options, world=world
            )
            up[key] = stack.enter_context(EmulatedRobot(spec, places.fd))
        list(pool.map(_build, up.values()))
        # Who waits for a master of others waits for one that is being started.
        started = pool.map(EmulatedRobot.start, sorted(up.values(), key=lambda one: not one.spec.runs_master))
        for key, one in up.items():
            medium.attach(one.name, one.address, robots[key].profile.radio, one.radio_fd)
        if any(robot.spec.waits_for_another for robot in up.values()):
            medium.place(placement.together_m(robot.name for robot in up.values()))
        list(started)
        yield RunningRobots(up, medium, places, {key: pair.public for key, pair in host_keys.items()}, login.private)
        for one in up.values():
            one.hang_up()


def _build(robot: EmulatedRobot) -> None:
    robot.build()
    robot.open_radio(mesh=robot.spec.mesh_hello_s is not None)
