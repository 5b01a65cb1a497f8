"""A lab whose robots a running Gazebo moves: places, a wall, and a Gazebo that is killed."""

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import TestbedLostError
from fieldkit.core.model import Vector
from sim_backends.emulated.emulated_options import SyncOptions
from sim_backends.emulated.robot.spec import ANTENNA_M
from sim_backends.emulated.ros.motion_record import SILENT_NS
from sim_backends.federates.frames import PHYSICS
from sim_backends.federates.named import command_line, default_options
from sim_backends.gazebo.sdf import SdfRobot, world_sdf
from sim_backends.world.world import load_world
from tests.helpers.cosim_benches import BODY, PLACES, CosimBench, cosim_bench
from tests.helpers.gazebo_server import GazeboServer, gazebo_server, missing_libraries
from tests.helpers.sshd import wait_until

pytestmark = [pytest.mark.emulated, pytest.mark.skipif(bool(missing_libraries()), reason=missing_libraries())]

LAWN = load_world("lawn")
NEAR_WALL_M: Vector = (3.6, 18.0, ANTENNA_M)


@pytest.fixture
def server(tmp_path: Path) -> Iterator[GazeboServer]:
    robots = {name: SdfRobot(BODY.limits, (*place_m[:2], 0.0), 0.0) for name, place_m in PLACES.items()}
    folder = tmp_path / "gazebo"
    folder.mkdir()
    with gazebo_server(folder, world_sdf(LAWN, robots)) as started_server:
        yield started_server


def drive_and_check(bench: CosimBench) -> bool:
    """Drive, and raise if the co-simulation has stopped; return False."""
    bench.driven.drive(0.2, 0.1)
    bench.medium.check_alive()
    return False


def test_gazebo_places_robots_and_stops_them_at_the_wall_until_it_is_killed(
    server: GazeboServer, tmp_path: Path
) -> None:
    options = default_options("gazebo", PHYSICS) | server.options
    with cosim_bench(
        tmp_path,
        physics=command_line("gazebo", PHYSICS),
        physics_options=options,
        sync=SyncOptions.model_validate({"name": "sliding_window", "window": "10ms"}),
        world=LAWN,
        places_m={**PLACES, "a": NEAR_WALL_M},
    ) as bench:
        wait_until(lambda: bench.driven.drive(0.2, 2.0).position_m[0] > 3.75, Deadline.after(60))
        wait_until(lambda: not bench.driven.drive(0.2, 0.5).is_moving, Deadline.after(60))
        motion_at_wall = bench.driven.drive(0.2, 0.5)
        assert motion_at_wall.position_m[:2] == pytest.approx((3.831, 18.0), abs=0.02), (
            "the chassis extends 69 mm ahead"
        )
        bench.driven.assign(PLACES["a"])
        bench.medium.place(PLACES)
        wait_until(lambda: bench.driven.drive(0.2, 0.5).position_m[0] > PLACES["a"][0] + 0.1, Deadline.after(60))
        later_motion = bench.driven.drive(0.2, 0.1)
        assert later_motion.position_m[0] < motion_at_wall.position_m[0]
        assert later_motion.position_m[1] == pytest.approx(PLACES["a"][1], abs=0.02)
        assert bench.ping(count=3)
        os.kill(server.process.pid, signal.SIGKILL)
        with pytest.raises(TestbedLostError, match="Gazebo"):
            wait_until(lambda: drive_and_check(bench), Deadline.after(60))
        assert not bench.driven.drive(0.2, 0.1).at(time.monotonic_ns() + SILENT_NS).is_moving
