"""Starts the robots of an emulated lab and attaches them to their media."""

from collections.abc import Collection, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Final, Generic

from fieldkit.backends.protocols import Robot
from sim_backends.emulated import placement
from sim_backends.emulated.emulated_options import EmulatedOptions, RosChoice
from sim_backends.emulated.medium.framing import ETHERNET, IP, Framing
from sim_backends.emulated.medium.media import Media
from sim_backends.emulated.medium.medium_client import MediumClient
from sim_backends.emulated.nodes import EmulatedRobot
from sim_backends.emulated.provisioning import KeyPair, RobotKey, robot_spec
from sim_backends.emulated.robot.spec import WifiSpec
from sim_backends.emulated.ros.lab_positions import PositionsWriter
from sim_backends.radio.antennas import antenna_of, fixed_mode
from sim_backends.world.world import World

if TYPE_CHECKING:
    from fieldkit.lab.robots import LabRobot
    from sim_backends.emulated.linux_wifi.radios import HwsimRadio

_MAX_PARALLEL_STARTS: Final = 16
"""Maximum number of robots that are built and started at the same time; each needs a thread and processor time."""


@dataclass(frozen=True)
class RunningRobots(Generic[RobotKey]):
    """Running robots, attached to their media but not placed yet, or placed 1 m apart (`running_robots`).

    Attributes:
        robots: The robots.
        medium: The medium of the radio under test.
        media: This medium and those of further links.
        positions_writer: Writer of the robots' positions, for the laser scanners of the other robots.
        host_keys: Public host key of each robot.
        private_key: Private key that logs in on all robots, OpenSSH PEM.
    """

    robots: Mapping[RobotKey, EmulatedRobot]
    medium: MediumClient
    media: Media
    positions_writer: PositionsWriter
    host_keys: Mapping[RobotKey, str]
    private_key: str = field(repr=False)


@contextmanager
def running_robots(
    robots: "Mapping[RobotKey, Robot | LabRobot]",
    *,
    options: EmulatedOptions,
    world: World,
    ros: RosChoice,
    seed: int,
) -> Iterator[RunningRobots[RobotKey]]:
    """Yield robots whose programs are ready; leaving the context stops all their processes.

    The arguments are those of `testbed.bring_up`; `robots` is its `cast`. If robots share a ROS master or a Zenoh
    router, or are stations of an access point, all robots and access points are placed 1 m apart when they start,
    because the robots connect over the radio.

    Raises:
        ConfigurationError: The site file fixes a radio mode that one of the robots does not have.
        FieldkitError: A robot or the medium did not start.
    """
    fixed_mode(options.radio.mode, {robot.name: antenna_of(robot.profile.radio) for robot in robots.values()})
    login, host_keys = KeyPair.make(), {key: KeyPair.make() for key in robots}
    with ExitStack() as stack:
        framing = IP if options.mesh is None else ETHERNET  # in a mesh, MAC addresses identify the next hop
        wifi, radios = _linux_wifi(robots, options)
        medium = stack.enter_context(
            _medium(robots, options, world, seed=seed, framing=framing, wifi=wifi.values(), radios=radios)
        )
        used_links = {name for robot in robots.values() for name in robot.profile.further_links}
        links = {
            name: stack.enter_context(MediumClient(link_options, world, seed=seed, framing=framing))
            for name, link_options in options.links.items()
            if name in used_links
        }
        media = Media(medium, links)
        positions_writer = stack.enter_context(closing(PositionsWriter([robot.name for robot in robots.values()])))
        # The pool is shut down after the robots have exited, because a waiting request ends when its robot exits.
        pool = stack.enter_context(ThreadPoolExecutor(min(len(robots), _MAX_PARALLEL_STARTS)))
        running: dict[RobotKey, EmulatedRobot] = {}
        for key in robots:
            spec = robot_spec(
                robots, key, ros=ros, login=login, host_key=host_keys[key], options=options, world=world
            )
            spec = replace(spec, wifi=wifi.get(key))
            running[key] = stack.enter_context(EmulatedRobot(spec, positions_writer.fd))
        list(pool.map(partial(_build, radios=radios), running.values()))
        # Robots with a ROS master start first, because the other robots wait for it.
        startups = pool.map(
            EmulatedRobot.start, sorted(running.values(), key=lambda robot: not robot.spec.runs_master)
        )
        for key, robot in running.items():
            radio, fd = robots[key].profile.radio, robot.radio_fd if robot.has_device else None
            medium.attach(robot.name, robot.address, radio, fd, physics_fds=robot.physics_fds)
            for name, link_fd in robot.link_fds.items():
                links[name].attach(robot.name, robot.spec.links[name][1], radio, link_fd)
        if any(robot.spec.waits_for_another for robot in running.values()):
            names = [*(robot.name for robot in running.values()), *(options.radio.access_points if wifi else ())]
            media.place(placement.side_by_side_m(names))
        list(startups)  # waits until the programs are ready, and raises their errors
        yield RunningRobots(
            running,
            medium,
            media,
            positions_writer,
            {key: pair.public for key, pair in host_keys.items()},
            login.private,
        )
        for robot in running.values():
            robot.request_exit()


def _linux_wifi(
    robots: "Mapping[RobotKey, Robot | LabRobot]", options: EmulatedOptions
) -> "tuple[Mapping[RobotKey, WifiSpec], Mapping[str, HwsimRadio]]":
    """Return the Wi-Fi settings of each robot and the kernel's radios by name; both are empty without Linux Wi-Fi."""
    if not options.has_linux_wifi:
        return {}, {}
    from sim_backends.emulated.linux_wifi import lab  # noqa: PLC0415 (only some labs use it)

    wifi = lab.wifi_specs(robots, options.linux_wifi, options.radio, options.mesh)
    return wifi, lab.radios_of(robots.values(), options.radio)


def _medium(
    robots: "Mapping[RobotKey, Robot | LabRobot]",
    options: EmulatedOptions,
    world: World,
    *,
    seed: int,
    framing: Framing,
    wifi: Collection[WifiSpec],
    radios: "Mapping[str, HwsimRadio]",
) -> AbstractContextManager[MediumClient]:
    """Return the medium of the radio under test; `wifi` and `radios` are those of `_linux_wifi`."""
    if options.has_linux_wifi:
        from sim_backends.emulated.linux_wifi import lab  # noqa: PLC0415 (as above)

        return lab.medium(options.radio, world, seed, radios, wifi)
    if options.is_cosimulated:
        return _cosimulated_medium(options, world, robots, seed, framing)
    return MediumClient(options.radio, world, seed=seed, framing=framing)


def _cosimulated_medium(
    options: EmulatedOptions, world: World, robots: "Mapping[RobotKey, Robot | LabRobot]", seed: int, framing: Framing
) -> MediumClient:
    """Start the medium of a lab on the co-simulation."""
    from sim_backends.emulated import simulator_choice  # noqa: PLC0415 (other labs import no simulator)
    from sim_backends.emulated.cosimulated.client import CosimulatedClient  # noqa: PLC0415 (as above)

    simulators = simulator_choice.resolve(options)
    sync = simulator_choice.sync_of(options)
    policy = {"name": sync.name, **sync.parameters}
    bodies = simulator_choice.bodies_of(robots.values())
    return CosimulatedClient(
        options.radio, world, seed=seed, framing=framing, bodies=bodies, simulators=simulators, policy=policy
    )


def _build(robot: EmulatedRobot, radios: "Mapping[str, HwsimRadio]") -> None:
    """Build a robot and bring up its interfaces; `radios` are the kernel's radios of robots with Linux Wi-Fi."""
    robot.build()
    radio = radios.get(robot.name)
    if radio is not None:
        radio.move_to_namespace(robot.pid)
        robot.open_wifi(radio.interface)
    else:
        robot.open_radio(mesh=robot.spec.mesh_hello_s is not None)
    robot.open_links()
