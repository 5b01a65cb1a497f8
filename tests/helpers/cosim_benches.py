"""Two network namespaces on a co-simulated medium; the test runs in place of the robots' programs."""

import math
import os
import re
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.namespaces import Namespace
from fieldkit.config.profiles import Radio
from fieldkit.core.model import Vector
from sim_backends.emulated.cosimulated.client import CosimulatedClient
from sim_backends.emulated.cosimulated.simulators import RobotBody, Simulators
from sim_backends.emulated.emulated_options import SyncOptions
from sim_backends.emulated.robot.spec import ANTENNA_M
from sim_backends.emulated.robot.velocity_command import VelocityCommand, VelocityCommandRecord
from sim_backends.emulated.ros.assigned_path import AssignedPath, append_path
from sim_backends.emulated.ros.motion_record import MotionRecord, RecordedMotion
from sim_backends.physics.robot_limits import TURTLEBOT3_BURGER
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.world import World

RADIO = Radio(interface="wlan0", standard="802.11n 2.4 GHz", tx_power_dbm=17, sensitivity_dbm=-82)
BODY = RobotBody("turtlebot3_burger", TURTLEBOT3_BURGER)
PLACES: dict[str, Vector] = {"a": (1.0, 5.0, ANTENNA_M), "b": (10.0, 5.0, ANTENNA_M)}
ADDRESSES = {"a": "10.9.0.1", "b": "10.9.0.2"}


@dataclass
class ControlFiles:
    """The files through which a robot is controlled.

    Attributes:
        folder: Their folder.
        descriptors: Descriptors for the physics.
    """

    folder: Path
    descriptors: Sequence[int]

    @classmethod
    def make(cls, folder: Path, *inputs: str) -> "ControlFiles":
        """Create the files of a new robot; `inputs` are the names of its input files, by default `commanded`."""
        folder.mkdir()
        flags = os.O_RDWR | os.O_CREAT
        names = ("steered", "motion", *(inputs or ("commanded",)))
        return cls(folder, [os.open(folder / name, flags, 0o600) for name in names])

    def assign(self, place_m: Vector, facing_rad: float = 0.0) -> None:
        """Assign a place to the robot, as the lab does."""
        append_path(self.folder / "motion", AssignedPath(time.monotonic_ns(), [place_m], 1.0, facing_rad))

    def motion(self) -> RecordedMotion | None:
        """Return the last motion that the physics recorded, or None if it recorded none."""
        record = MotionRecord.open(self.folder / "steered")
        try:
            return record.read()
        finally:
            record.close()

    def drive(self, forward_m_s: float, seconds: float, turn_rad_s: float = 0.0) -> RecordedMotion:
        """Command a velocity at 20 Hz, and return the last motion."""
        record = VelocityCommandRecord.open(self.folder / "commanded")
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            record.write(VelocityCommand(time.monotonic_ns(), forward_m_s, turn_rad_s))
            time.sleep(0.05)
        record.close()
        motion = self.motion()
        assert motion is not None
        return motion


@dataclass
class CosimBench:
    """Two namespaces on a co-simulated medium.

    Attributes:
        medium: The medium.
        spaces: The namespaces of `a` and `b`.
        control_files: The files through which `a` is controlled.
    """

    medium: CosimulatedClient
    spaces: dict[str, Namespace]
    control_files: ControlFiles

    def ping(self, *options: str, count: int = 20, address: str = ADDRESSES["b"]) -> list[float]:
        """Return the round-trip times in ms of pings from a to b."""
        argv = ("ping", "-n", "-i", "0.02", "-W", "2", "-c", str(count), *options, address)
        output = self.spaces["a"].run(*argv, timeout_s=60).stdout
        return [float(value) for value in re.findall(r"time=([\d.]+)", output)]


@contextmanager
def cosim_bench(
    folder: Path,
    *,
    physics: str = "kinematic",
    network: str = "builtin",
    network_options: Mapping[str, Any] | None = None,
    physics_options: Mapping[str, Any] | None = None,
    sync: SyncOptions | None = None,
    radio: RadioOptions | None = None,
    world: World | None = None,
    places_m: dict[str, Vector] = PLACES,
    control_files: ControlFiles | None = None,
    body: RobotBody = BODY,
) -> Iterator[CosimBench]:
    """Yield two placed namespaces on a co-simulated medium; `body` and `control_files` belong to `a`."""
    sync = sync or SyncOptions()
    with ExitStack() as stack:
        medium = stack.enter_context(
            CosimulatedClient(
                radio or RadioOptions(fading=False),
                world,
                seed=1,
                bodies={"a": body, "b": BODY},
                simulators=Simulators(physics, network, sync.step_ns, network_options, physics_options),
                policy={"name": sync.name, **sync.parameters},
            )
        )
        spaces = {name: stack.enter_context(Namespace()) for name in ADDRESSES}
        control_files = control_files or ControlFiles.make(folder / "a")
        for fd in control_files.descriptors:
            stack.callback(os.close, fd)
        for name, space in spaces.items():
            fd = space.tun("wlan0", f"{ADDRESSES[name]}/24")
            fds = control_files.descriptors if name == "a" else ()
            medium.attach(name, f"{ADDRESSES[name]}/24", RADIO, fd, physics_fds=fds)
            os.close(fd)
        control_files.assign(places_m["a"])
        medium.place(places_m)
        yield CosimBench(medium, spaces, control_files)


def distance_m(motion: RecordedMotion, place_m: Vector) -> float:
    """Return the horizontal distance of a motion from a position."""
    return math.dist(motion.position_m[:2], place_m[:2])
