"""Records of a robot's motion: complete when read, extrapolated, and void after the lab has placed the robot."""

import math
import os
import struct
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_backends.emulated.ros.assigned_path import AssignedPath, append_path
from sim_backends.emulated.ros.motion_record import SILENT_NS, MotionRecord, RecordedMotion
from sim_backends.emulated.ros.robot_motion import MotionReporter, Odometer

S = 10**9
FLOATS = st.floats(-1e3, 1e3)
VECTORS = st.tuples(FLOATS, FLOATS, FLOATS)
TIMES = st.integers(0, 10**18)
MOTIONS = st.builds(
    RecordedMotion,
    *(TIMES, TIMES, VECTORS, VECTORS),
    heading_rad=FLOATS,
    turn_rad_s=st.floats(-3, 3),
    odometry=VECTORS,
    tilt_rad=st.tuples(FLOATS, FLOATS),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("steered")


def new_path(folder: Path) -> Path:
    (folder / "record").unlink(missing_ok=True)
    return folder / "record"


@given(st.lists(MOTIONS, max_size=5))
def test_readers_return_the_last_motion(folder: Path, motions: list[RecordedMotion]) -> None:
    path = new_path(folder)
    writer, reader = MotionRecord.open(path), MotionRecord.open(path)
    assert reader.read() is None
    for motion in motions:
        writer.write(motion)
        assert reader.read() == motion
    later_reader = MotionRecord.open(path)
    assert later_reader.read() == (motions[-1] if motions else None)
    later_reader.write(RecordedMotion(1, 2, (3.0, 4.0, 5.0)))  # a new process continues after a killed one
    assert reader.read() == RecordedMotion(1, 2, (3.0, 4.0, 5.0))
    for record in (writer, reader, later_reader):
        record.close()


@given(MOTIONS, MOTIONS, st.data())
def test_a_partly_written_record_is_ignored(
    folder: Path, first: RecordedMotion, second: RecordedMotion, data: st.DataObject
) -> None:
    path = new_path(folder)
    writer = MotionRecord.open(path)
    writer.write(first)
    before = path.read_bytes()
    writer.write(second)
    after = path.read_bytes()
    new_slot = after[: len(after) // 2]  # its slot is the first of both
    n_written = data.draw(st.integers(0, len(new_slot) - 1))
    path.write_bytes(new_slot[:n_written] + bytes(len(new_slot) - n_written) + before[len(new_slot) :])
    reader = MotionRecord.open(path)
    is_complete = not any(new_slot[n_written:])  # the missing bytes are zeros
    assert reader.read() == (second if is_complete else first)
    path.write_bytes(b"")
    assert reader.read() == reader._last, "a truncated file keeps the last motion"
    writer.close()
    reader.close()


@given(MOTIONS, st.integers(0, 2 * SILENT_NS))
def test_motion_is_extrapolated_until_the_timeout(motion: RecordedMotion, age_ns: int) -> None:
    motion_now = motion.at(motion.time_ns + age_ns)
    extrapolated_s = min(age_ns, SILENT_NS) / 1e9
    assert motion_now.position_m == pytest.approx(
        [p + v * extrapolated_s for p, v in zip(motion.position_m, motion.velocity_m_s, strict=True)], abs=1e-6
    )
    assert motion_now.heading_rad == pytest.approx(motion.heading_rad + motion.turn_rad_s * extrapolated_s)
    assert motion_now.is_moving == (motion.is_moving and age_ns < SILENT_NS)
    assert motion.at(motion.time_ns - age_ns).position_m == motion.position_m, "never extrapolated into the past"
    x, y, _ = motion_now.odometry
    assert math.hypot(x - motion.odometry[0], y - motion.odometry[1]) == pytest.approx(
        abs(motion.speed_m_s) * extrapolated_s, abs=1e-6
    )


def test_the_reporter_reads_its_placement_and_sensors_follow_the_reported_motion(tmp_path: Path) -> None:
    paths, record = tmp_path / "motion", tmp_path / "steered"
    append_path(paths, AssignedPath(5 * S, [(3.0, 6.0, 0.2)], 1.0, math.pi / 2))
    reporter, odometer = MotionReporter(paths, record, 6 * S), Odometer(paths, 6 * S, record)
    placement = reporter.poll_placement(6 * S)
    assert placement is not None
    assert (placement.position_m, placement.heading_rad, placement.x_m) == ((3.0, 6.0, 0.2), math.pi / 2, 0.0)
    assert reporter.poll_placement(7 * S) is None
    reporter.write(
        7 * S, (3.0, 7.0, 0.2), (0.0, 0.5, 0.0), heading_rad=math.pi / 2, turn_rad_s=0.1, odometry=(1.0, 0.0, 0.0)
    )
    motion_now = odometer.at(7 * S + S // 10)
    assert motion_now.position_m == pytest.approx((3.0, 7.05, 0.2))
    assert (motion_now.x_m, motion_now.speed_m_s, motion_now.turn_rad_s) == pytest.approx((1.05, 0.5, 0.1))
    append_path(paths, AssignedPath(8 * S, [(3.0, 6.0, 0.2)], 1.0, math.pi / 2))
    placed_motion = odometer.at(9 * S)
    assert placed_motion.position_m == (3.0, 6.0, 0.2)
    assert placed_motion.x_m > 1.0, "odometry continues"
    reporter.write(9 * S, (3.0, 9.0, 0.2), odometry=(1.25, 0.0, 0.05))
    assert odometer.at(9 * S).position_m == (3.0, 6.0, 0.2), (
        "the lab has placed the robot after the motion that the report is based on"
    )
    second_placement = reporter.poll_placement(9 * S)
    assert second_placement is not None
    assert second_placement.position_m == placed_motion.position_m
    assert second_placement.x_m == pytest.approx(placed_motion.x_m, abs=0.01)


def test_a_restarted_reporter_continues_at_the_last_position(tmp_path: Path) -> None:
    paths, record = tmp_path / "motion", tmp_path / "steered"
    append_path(paths, AssignedPath(S, [(0.0, 0.0, 0.2)], 1.0, 0.0))
    reporter = MotionReporter(paths, record, 2 * S)
    reporter.poll_placement(2 * S)
    reporter.write(3 * S, (4.0, 0.0, 0.2), (1.0, 0.0, 0.0), odometry=(4.0, 0.0, 0.0))
    restart_ns = 60 * S
    motion = MotionReporter(paths, record, restart_ns).poll_placement(restart_ns)
    assert motion is not None
    assert motion.position_m == pytest.approx((4.0 + SILENT_NS / 1e9, 0.0, 0.2))
    assert motion.speed_m_s == 0.0


@given(st.lists(st.tuples(st.floats(-1, 1), st.floats(-2, 2)), min_size=2, max_size=20))
def test_extrapolated_odometry_agrees_with_the_reporter(
    folder: Path, speeds_and_turns: list[tuple[float, float]]
) -> None:
    """With twenty records per second, the extrapolated odometry equals that of the next record."""
    path, step_s = new_path(folder), 0.05
    record, pose = MotionRecord.open(path), (0.0, 0.0, 0.0)
    motions = []
    for number, (speed, turn) in enumerate(speeds_and_turns):
        x, y, yaw = pose
        velocity = (speed * math.cos(yaw), speed * math.sin(yaw), 0.0)
        motions.append(RecordedMotion(round(number * step_s * S), 0, (x, y, 0.0), velocity, yaw, turn, pose))
        pose = x + speed * step_s * math.cos(yaw), y + speed * step_s * math.sin(yaw), yaw + turn * step_s
    for motion, after in pairwise(motions):
        record.write(motion)
        record_read = record.read()
        assert record_read is not None
        assert record_read.at(after.time_ns).odometry == pytest.approx(after.odometry, abs=1e-9)
    record.close()


def test_a_file_without_a_valid_record_is_read_as_none(tmp_path: Path) -> None:
    path = tmp_path / "record"
    path.write_bytes(struct.pack("<Q", 7) + os.urandom(300))
    assert MotionRecord.open(path).read() is None
