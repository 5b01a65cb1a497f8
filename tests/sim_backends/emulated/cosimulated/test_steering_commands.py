"""Commanded velocities of a robot, also while the simulation lags behind real time."""

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from sim_backends.emulated.cosimulated.steering import Command, GroundSteering
from sim_backends.emulated.robot.base_controller import TIMEOUT_NS
from sim_backends.emulated.robot.spec import ANTENNA_M
from sim_backends.emulated.robot.velocity_command import VelocityCommand, VelocityCommandRecord
from sim_backends.physics.body import Twist
from tests.helpers.cosim_benches import Driven

MS = 1_000_000


@pytest.fixture
def driven(tmp_path: Path) -> Driven:
    driven = Driven.make(tmp_path / "robot")
    driven.assign((1.0, 2.0, ANTENNA_M))
    return driven


@pytest.fixture
def record(driven: Driven) -> Iterator[VelocityCommandRecord]:
    record = VelocityCommandRecord.open(driven.folder / "commanded")
    yield record
    record.close()


def place_robot(driven: Driven) -> tuple[GroundSteering, int]:
    """Return the steering of a robot at its place, and the time of its placement."""
    start_ns = time.monotonic_ns()
    steering = GroundSteering(driven.descriptors, start_ns)
    assert steering.poll_placement(start_ns) is not None
    return steering, start_ns


def test_a_simulation_that_lags_applies_every_velocity_at_its_time(
    driven: Driven, record: VelocityCommandRecord
) -> None:
    """The lag of 200 ms exceeds the interval of the velocities, 50 ms, so each is read before its time."""
    steering, start_ns = place_robot(driven)
    applied_commands: list[tuple[int, Command]] = []
    for command in range(1, 21):
        at_ns = start_ns + 50 * MS * command
        record.write(VelocityCommand(at_ns, 0.01 * command, 0.0))
        applied_commands += steering.commands(at_ns - 200 * MS)
    assert applied_commands == [(start_ns + 50 * MS * command, Twist(0.01 * command)) for command in range(1, 17)]


def test_the_stop_after_a_missing_velocity_precedes_a_later_one(
    driven: Driven, record: VelocityCommandRecord
) -> None:
    steering, start_ns = place_robot(driven)
    first_ns, later_ns = start_ns + MS, start_ns + MS + 2 * TIMEOUT_NS
    record.write(VelocityCommand(first_ns, 0.2, 0.1))
    assert list(steering.commands(first_ns)) == [(first_ns, Twist(0.2, 0.1))]
    record.write(VelocityCommand(later_ns, 0.1, 0.0))
    assert list(steering.commands(later_ns)) == [(first_ns + TIMEOUT_NS, Twist()), (later_ns, Twist(0.1))]
    assert list(steering.commands(later_ns + TIMEOUT_NS)) == [(later_ns + TIMEOUT_NS, Twist())]


def test_a_velocity_from_before_a_placement_is_dropped(driven: Driven, record: VelocityCommandRecord) -> None:
    steering, start_ns = place_robot(driven)
    record.write(VelocityCommand(start_ns + 10 * MS, 0.2, 0.0))
    assert list(steering.commands(start_ns)) == []
    driven.assign((3.0, 2.0, ANTENNA_M))
    assert steering.poll_placement(start_ns + 20 * MS) is not None
    assert list(steering.commands(start_ns + 30 * MS)) == []
