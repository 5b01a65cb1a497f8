"""The interactive lab, in which all robots of a site file run, without roles, and communicate directly."""

import socket
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from itertools import combinations
from pathlib import Path

import numpy as np

from fieldkit.backends.registry import profiles_of
from fieldkit.config.schema import Document
from fieldkit.config.site import Site
from fieldkit.core.errors import RobotError
from fieldkit.core.model import Vector
from fieldkit.lab.protocol import LabLateness, LabLink, Login, Outline, Overview
from fieldkit.lab.robots import Destination, LabRobot
from sim_backends.emulated import interactive_placement, placement
from sim_backends.emulated.emulated_options import EmulatedOptions, RosChoice
from sim_backends.emulated.mobility import WATCH_S, MotionThread, self_steered_motions
from sim_backends.emulated.motion_sections import mavlink_of
from sim_backends.emulated.robot.spec import USER
from sim_backends.emulated.ros.assigned_path import AssignedPath
from sim_backends.emulated.running_robots import RunningRobots, running_robots
from sim_backends.radio.antennas import antenna_of
from sim_backends.radio.world_channel import WorldChannel
from sim_backends.world.motion import Attitude, State, attitude_of
from sim_backends.world.penetration import Obstacles
from sim_backends.world.world import World


class EmulatedLab:
    """Running robots, in the middle of their world until they are moved.

    Args:
        members: The robots by name.
        running: The running robots and their medium.
        options: The lab's options.
        world: The world around the robots.

    Attributes:
        members: The robots by name.
        login: The login at the robots.

    Raises:
        LinkError: The medium process exited or did not answer.
    """

    def __init__(
        self, members: Mapping[str, LabRobot], running: RunningRobots[str], options: EmulatedOptions, world: World
    ) -> None:
        self._running = running
        self._options = options
        self._world = world
        self._positions_m = interactive_placement.square_m(members, world)
        self._path_starts_ns: dict[str, int] = {}
        self._states: dict[str, State] = {}
        self._watch: MotionThread | None = None
        # A separate thread updates the positions of robots that steer themselves.
        self._lock = threading.RLock()
        for name in members:
            self._assign_position(name, self._positions_m[name])
        running.media.place(self._positions_m)
        running.positions_writer.write(self._positions_m)
        # The lateness of the startup is not reported, so its counts are subtracted from later ones.
        self._first_stats = running.medium.stats() if options.is_cosimulated else None
        self.members = members
        self.login = Login(USER, running.private_key, running.host_keys)

    def connect(self, name: str, timeout_s: float) -> socket.socket:
        """Implement `Lab.connect`: the connection bypasses the radio."""
        return self._running.robots[name].connect(timeout_s)

    def programs(self, name: str) -> tuple[str, ...]:
        """Implement `Lab.programs` from `/proc`, which also works for a robot that does not respond."""
        return tuple(dict.fromkeys(_programs(self._running.robots[name].pid)))

    def place_m(self, name: str) -> Vector:
        """Implement `Lab.place_m`: the position as of the last update."""
        self._running.media.check_alive()
        if self._watch is not None:
            self._watch.check()
        with self._lock:
            return self._positions_m[name]

    def move(self, name: str, to: Destination) -> Vector:
        """Implement `Lab.move`: the robot arrives immediately."""
        with self._lock:
            position_m = interactive_placement.destination_m(self._positions_m[name], to, self._world)
            positions_m = self._positions_m | {name: position_m}
            # As in a trial, the robot is updated before the medium, whose physics simulator refuses a position in an
            # obstacle.
            self._assign_position(name, position_m)
            try:
                self._running.media.place(positions_m)
            except RobotError:
                self._assign_position(name, self._positions_m[name])
                raise
            self._running.positions_writer.write(positions_m)
            self._positions_m = positions_m
            return position_m

    def _assign_position(self, name: str, position_m: Vector) -> None:
        """Send a robot its new position; it faces east there."""
        self._path_starts_ns[name] = start_ns = time.monotonic_ns()
        self._running.robots[name].move(AssignedPath(start_ns, [position_m], speed_m_s=1.0, facing_rad=0.0))

    def watching(self) -> AbstractContextManager[object]:
        """Return a context in which the medium receives the positions of robots that programs on board steer."""
        if not any(robot.spec.steers for robot in self._running.robots.values()):
            return nullcontext()
        self._watch = MotionThread(self._update_positions, "watch")
        return self._watch

    def _update_positions(self) -> float:
        """Update the positions of robots that steer themselves; return the seconds until the next update."""
        with self._lock:
            states = {
                name: motion.state
                if mavlink_of(self.members[name].profile) is not None
                else placement.on_ground(motion.state, self._world)
                for name, motion in self_steered_motions(self._running.robots, self._path_starts_ns).items()
            }
            if states != self._states:
                self._states = states
                self._positions_m = self._positions_m | {name: state.position_m for name, state in states.items()}
                velocities_m_s = {name: state.velocity_m_s for name, state in states.items()}
                attitudes = {name: attitude_of(state, before=Attitude()) for name, state in states.items()}
                self._running.media.place(self._positions_m, velocities_m_s=velocities_m_s, attitudes=attitudes)
                self._running.positions_writer.write(self._positions_m)
        return WATCH_S

    def lateness(self) -> LabLateness | None:
        """Implement `Lab.lateness`: lateness since the start; None without a co-simulation."""
        first_stats = self._first_stats
        if first_stats is None:
            return None
        stats, bound_ns = self._running.medium.stats(), round(self._options.late_bound * 1e9)
        packets = _new_counts(first_stats.packet_lateness_counts, stats.packet_lateness_counts)
        windows = _new_counts(first_stats.window_lateness_counts, stats.window_lateness_counts)
        return LabLateness(
            bound_s=self._options.late_bound,
            packet_max_s=max(packets) / 1e9 if packets else None,
            window_max_s=max(windows) / 1e9 if windows else None,
            windows=windows.total(),
            late=sum(count for late_ns, count in (packets + windows).items() if late_ns > bound_ns),
        )

    def overview(self) -> Overview:
        """Implement `Lab.overview`: the map with the current positions."""
        return overview(self.members, self._positions_m, self._options, self._world)


@contextmanager
def bring_up(
    members: Mapping[str, LabRobot], *, options: EmulatedOptions, world: World, ros: RosChoice, seed: int
) -> Iterator[EmulatedLab]:
    """Yield running robots in the middle of their world.

    Raises:
        FieldkitError: A robot or the medium did not start.
    """
    with running_robots(members, options=options, world=world, ros=ros, seed=seed) as running:
        lab = EmulatedLab(members, running, options, world)
        with lab.watching():
            yield lab


def members_of(site: Site, document: Document | None, addresses: Mapping[str, str]) -> dict[str, LabRobot]:
    """Return the robots of a site file, by name.

    Args:
        site: The site file.
        document: The document of the site file, for error messages with line numbers; or None.
        addresses: Radio address of each robot.

    Raises:
        ConfigurationError: A profile is missing or wrong.
    """
    roles: dict[str, list[str]] = {name: [] for name in site.robots}
    for topology, cast in site.roles.items():
        for role, name in cast.items():
            roles[name].append(f"{role} ({topology})")
    profiles = profiles_of(site, document, site.robots)
    return {name: LabRobot(name, profile, addresses[name], tuple(roles[name])) for name, profile in profiles.items()}


def overview(
    members: Mapping[str, LabRobot], positions_m: Mapping[str, Vector], options: EmulatedOptions, world: World
) -> Overview:
    """Return the map of the lab, computed without fading, and without shadowing, which depends on the seed."""
    antennas = {name: antenna_of(member.profile.radio) for name, member in members.items()}
    channel = WorldChannel(
        0, antennas, options.radio.model_copy(update={"shadowing_db": 0.0, "fading": False}), world
    )
    channel.move(0, positions_m)
    names = list(members)
    pairs = [] if options.radio.is_fixed else list(combinations(range(len(names)), 2))
    # The positions of the first robot of each pair, and those of the second one.
    first, second = (np.array([positions_m[names[pair[end]]] for pair in pairs]).reshape(-1, 3) for end in (0, 1))
    links = [
        LabLink(
            (names[first_index], names[second_index]),
            min(channel.snr_db(first_index, second_index), channel.snr_db(second_index, first_index)),
            channel.are_linked(first_index, second_index),
            tuple(dict.fromkeys(crossing.obstacle for crossing in crossings)),
        )
        for (first_index, second_index), crossings in zip(
            pairs, Obstacles(world).crossings(first, second), strict=True
        )
    ]
    # In drawing order: a higher part covers a lower one.
    parts = sorted(world.parts, key=lambda part: part.shape.top_m)
    outlines = [Outline(part.material, part.shape.corners_m()) for part in parts]
    robots = {name: position_m[:2] for name, position_m in positions_m.items()}
    return Overview(world.name, world.area_m, outlines, robots, links)


def _new_counts(before: Mapping[int, int], after: Mapping[int, int]) -> Counter[int]:
    """Return the counts by which a histogram has increased."""
    return Counter(after) - Counter(before)


def _programs(robot_pid: int) -> Iterator[str]:
    """Yield the name of each process of a robot except its init process."""
    # The robot's outermost process is `unshare`, whose only child is the init process.
    pending = [pid for init_pid in _children(robot_pid) for pid in _children(init_pid)]
    while pending:
        yield from filter(None, map(_name, pending))
        pending = [child for pid in pending for child in _children(pid)]


def _children(pid: int) -> list[int]:
    try:
        return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii").split()]
    except OSError:
        return []  # the process has exited


def _name(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/comm").read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
