"""The driver of a ground robot: its velocities are within the limits for all inputs, and it stops in time."""

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldkit.agent.driving.drive_plan import BACK, END, OUT, DriveTask, path_duration_s
from fieldkit.agent.driving.steering import ZERO_VELOCITY, Driver, DriveVelocity, OdometryPose

TICK_S = 0.05
TASK = DriveTask(
    legs=[(1.0, 0.0), (0.0, 0.5)],
    speed_m_s=0.4,
    turn_rad_s=1.5,
    acceleration_m_s2=0.5,
    fence_m=5.0,
    lease_s=2.0,
    odometry_s=0.5,
    limit_s=60.0,
)
METRES = st.floats(-3, 3).map(lambda metres: metres if abs(metres) > 0.2 else 0.5)
LEGS = st.lists(st.tuples(METRES, METRES), min_size=1, max_size=3)


class Robot:
    """A base without inertia, whose odometry is noisy and delayed by a tick."""

    def __init__(self, start: OdometryPose, noise_m: float = 0.0, seed: int = 0) -> None:
        self.pose = start
        self.noise = Random(seed)
        self.noise_m = noise_m

    def drive(self, velocity: DriveVelocity, for_s: float) -> None:
        x, y, yaw = self.pose
        middle = yaw + velocity.turn_rad_s * for_s / 2
        ahead = velocity.forward_m_s * for_s
        self.pose = OdometryPose(
            x + ahead * math.cos(middle), y + ahead * math.sin(middle), yaw + velocity.turn_rad_s * for_s
        )

    def odometry(self) -> OdometryPose:
        x, y, yaw = self.pose
        errors = [self.noise.gauss(0.0, self.noise_m) for _ in range(3)]
        return OdometryPose(x + errors[0], y + errors[1], yaw + errors[2])


def run(
    driver: Driver, robot: Robot, *, now_s: float = 0.0, command: str = OUT, ticks: int = 4000
) -> Iterator[DriveVelocity]:
    """Yield each velocity until the drive ends or the robot stops at the end of its path; the lease is renewed."""
    for number in range(ticks):
        at_s = now_s + number * TICK_S
        driver.on_odometry(at_s, robot.odometry())
        driver.on_order(at_s, command)
        velocity = driver.tick(at_s)
        yield velocity
        if driver.is_finished or (command == OUT and driver.phase == "there"):
            return
        robot.drive(velocity, TICK_S)


def is_within_limits(task: DriveTask, velocities: list[DriveVelocity]) -> bool:
    is_slow_enough = all(
        abs(velocity.forward_m_s) <= task.speed_m_s and abs(velocity.turn_rad_s) <= task.turn_rad_s + 1e-9
        for velocity in velocities
    )
    max_change = task.acceleration_m_s2 * TICK_S + 1e-9
    is_smooth = all(after.forward_m_s - before.forward_m_s <= max_change for before, after in pairwise(velocities))
    return is_slow_enough and is_smooth


@settings(max_examples=20)
@given(
    LEGS,
    st.builds(OdometryPose, st.floats(-99, 99), st.floats(-99, 99), st.floats(-7, 7)),
    st.floats(0, 0.005),
    st.integers(0, 99),
)
def test_robot_drives_out_and_back_to_its_pose(
    legs: list[tuple[float, float]], start: OdometryPose, noise_m: float, seed: int
) -> None:
    task = replace(TASK, legs=legs, fence_m=50.0, limit_s=500.0)
    driver, robot = Driver(task, 0.0), Robot(start, noise_m, seed)
    out_velocities = list(run(driver, robot))
    assert (driver.phase, driver.stop_reason) == ("there", "")
    cos, sin = math.cos(start.yaw_rad), math.sin(start.yaw_rad)
    ahead, left = map(sum, zip(*legs, strict=True))
    goal = start.x_m + cos * ahead - sin * left, start.y_m + sin * ahead + cos * left
    assert math.dist(robot.pose[:2], goal) < 0.05 + 5 * noise_m + 3 * noise_m * len(legs)
    return_velocities = list(run(driver, robot, now_s=len(out_velocities) * TICK_S, command=BACK))
    assert (driver.phase, driver.stop_reason) == ("home", "")
    assert math.dist(robot.pose[:2], start[:2]) < 0.05 + 10 * noise_m
    assert abs(math.remainder(robot.pose.yaw_rad - start.yaw_rad, math.tau)) < 0.1 + 5 * noise_m
    assert out_velocities[-1] == return_velocities[-1] == ZERO_VELOCITY
    assert is_within_limits(task, out_velocities)
    assert is_within_limits(task, return_velocities)


@given(
    st.lists(
        st.tuples(
            st.floats(0, 1),
            st.one_of(st.none(), st.builds(OdometryPose, *[st.floats(allow_nan=True)] * 3)),
            st.sampled_from(["", OUT, BACK, END]),
        ),
        max_size=60,
    )
)
def test_any_odometry_and_order_keep_the_limits(
    inputs: list[tuple[float, OdometryPose | None, str]],
) -> None:
    driver, now_s, last_velocity, stop_reason = Driver(TASK, 0.0), 0.0, ZERO_VELOCITY, ""
    for for_s, pose, order in inputs:
        now_s += for_s
        if pose is not None:
            driver.on_odometry(now_s, pose)
        if order:
            driver.on_order(now_s, order)
        velocity = driver.tick(now_s)
        assert 0 <= velocity.forward_m_s <= TASK.speed_m_s
        assert abs(velocity.turn_rad_s) <= TASK.turn_rad_s
        assert velocity.forward_m_s - last_velocity.forward_m_s <= TASK.acceleration_m_s2 * for_s + 1e-9
        assert not stop_reason or (velocity == ZERO_VELOCITY and driver.stop_reason == stop_reason), (
            "the stop is final"
        )
        last_velocity, stop_reason = velocity, driver.stop_reason


def moving(task: DriveTask = TASK) -> tuple[Driver, Robot, float]:
    """Return a moving driver, its robot, and the present time."""
    driver, robot = Driver(task, 0.0), Robot(OdometryPose(7.0, 8.0, 1.0))
    velocities = list(run(driver, robot, ticks=30))
    assert velocities[-1].forward_m_s > 0.3
    return driver, robot, 29 * TICK_S


def stopped_after_s(driver: Driver, since_s: float, robot: Robot, *, renews: bool, has_odometry: bool) -> float:
    now_s = since_s
    while not driver.stop_reason:
        now_s += TICK_S
        if has_odometry:
            driver.on_odometry(now_s, robot.odometry())
        if renews:
            driver.on_order(now_s, OUT)
        robot.drive(driver.tick(now_s), TICK_S)
        assert now_s < since_s + 100
    assert driver.tick(now_s) == ZERO_VELOCITY
    driver.on_order(now_s, BACK)
    driver.on_odometry(now_s, robot.odometry())
    assert driver.tick(now_s + TICK_S) == ZERO_VELOCITY, "the stop is final"
    return now_s - since_s


def test_lost_laptop_stops_the_robot_within_its_lease() -> None:
    driver, robot, since_s = moving(replace(TASK, legs=[(4.0, 0.0)]))
    assert stopped_after_s(driver, since_s, robot, renews=False, has_odometry=True) <= TASK.lease_s + TICK_S
    assert driver.stop_reason == "no order from the laptop for 2 s"


def test_silent_odometry_stops_the_robot() -> None:
    driver, robot, since_s = moving()
    assert stopped_after_s(driver, since_s, robot, renews=True, has_odometry=False) <= TASK.odometry_s + TICK_S
    assert driver.stop_reason == "no odometry for 0.5 s"


def test_robot_stops_at_its_fence_and_after_its_time_limit() -> None:
    driver, robot, since_s = moving(replace(TASK, legs=[(4.0, 0.0)], fence_m=2.0))
    stopped_after_s(driver, since_s, robot, renews=True, has_odometry=True)
    assert driver.stop_reason == "beyond the fence, 2 m from its origin"
    assert math.dist(robot.pose[:2], (7.0, 8.0)) < 2.0 + 2 * TASK.speed_m_s * TICK_S
    driver, robot, since_s = moving(replace(TASK, legs=[(4.0, 0.0)], limit_s=3.0))
    assert stopped_after_s(driver, since_s, robot, renews=True, has_odometry=True) <= 3.0
    assert driver.stop_reason == "the path was not finished in 3 s"


def test_jumping_odometry_and_an_order_stop_the_robot() -> None:
    driver, robot, since_s = moving()
    robot.pose = robot.pose._replace(x_m=robot.pose.x_m + 1.0)
    driver.on_odometry(since_s + TICK_S, robot.odometry())
    assert driver.tick(since_s + TICK_S) == ZERO_VELOCITY
    assert driver.stop_reason.startswith("odometry jumped by 1")
    driver, _, since_s = moving()
    driver.on_order(since_s, END)
    assert (driver.tick(since_s), driver.stop_reason) == (ZERO_VELOCITY, "ordered to stop")


def test_robot_waits_for_its_laptop_and_turns_back_at_its_position() -> None:
    driver = Driver(TASK, 0.0)
    driver.on_odometry(0.0, OdometryPose(0.0, 0.0, 0.0))
    assert [driver.tick(number * TICK_S) for number in range(20)] == [ZERO_VELOCITY] * 20
    driver, robot, since_s = moving(replace(TASK, legs=[(2.0, 0.0), (0.0, 2.0)]))
    farthest = 0.0
    for _ in run(driver, robot, now_s=since_s, command=BACK):
        farthest = max(farthest, math.dist(robot.pose[:2], (7.0, 8.0)))
    assert driver.phase == "home"
    assert farthest < 1.0, "it returns on the shortest path"


@pytest.mark.parametrize("data", [{"legs": [["x", 0]]}, {"legs": []}, {}])
def test_incomplete_task_is_rejected(data: dict[str, object]) -> None:
    with pytest.raises((TypeError, ValueError, KeyError)):
        DriveTask.from_json(data)


@settings(max_examples=30)
@given(LEGS, st.floats(0.1, 1.5), st.floats(0.3, 3.0), st.floats(0.2, 2.0))
def test_predicted_duration_of_a_path_is_correct(
    legs: list[tuple[float, float]], speed_m_s: float, turn_rad_s: float, acceleration_m_s2: float
) -> None:
    task = replace(TASK, legs=legs, speed_m_s=speed_m_s, turn_rad_s=turn_rad_s, fence_m=20.0, limit_s=1e3)
    task = replace(task, acceleration_m_s2=acceleration_m_s2)
    driver = Driver(task, 0.0)
    duration_s = len(list(run(driver, Robot(OdometryPose(1.0, 2.0, 0.5)), ticks=20_000))) * TICK_S
    assert driver.phase == "there"
    assert path_duration_s(task) == pytest.approx(duration_s, rel=0.1, abs=0.5 + 0.5 * len(legs))


@pytest.mark.parametrize("inputs", [(1.0, 0.0), (0.0, 1.0)])
def test_constant_odometry_stops_the_robot(inputs: tuple[float, float]) -> None:
    driver, pose = Driver(replace(TASK, legs=[inputs]), 0.0), OdometryPose(0.0, 0.0, math.atan2(*reversed(inputs)))
    driver.on_odometry(0.0, OdometryPose(0.0, 0.0, 0.0))
    distance_m = 0.0
    for number in range(1, 1200):
        at_s = number * TICK_S
        driver.on_odometry(at_s, pose if driver.phase != "waits" else OdometryPose(0.0, 0.0, 0.0))
        driver.on_order(at_s, OUT)
        distance_m += driver.tick(at_s).forward_m_s * TICK_S
        if driver.stop_reason:
            break
    assert driver.stop_reason.startswith("1.3 m were commanded, but by its odometry the robot drove 0.0 m")
    assert distance_m < 1.5, "the fence is at 5 m"


@pytest.mark.parametrize(
    ("start", "last_pose", "reason"),
    [
        ((6.0, 0.0, 0.0), None, "it is 6.00 m from its origin, outside its fence of 5 m"),
        ((0.5, 0.0, 0.0), None, "it is 0.50 m and 0.00 rad from its origin"),
        ((0.0, 0.0, 0.6), None, "it is 0.00 m and 0.60 rad from its origin"),
        ((0.0, 0.0, 0.0), (2.0, 0.0, 0.0), "its odometry is 2.00 m and 0.00 rad from the end of its last motion"),
    ],
)
def test_robot_that_is_not_at_its_place_does_not_start(
    start: tuple[float, float, float], last_pose: tuple[float, float, float] | None, reason: str
) -> None:
    driver = Driver(replace(TASK, origin=(0.0, 0.0, 0.0), last=last_pose), 0.0)
    assert set(run(driver, Robot(OdometryPose(*start)))) == {ZERO_VELOCITY}
    assert (driver.stop_reason, driver.refused) == (reason, True)


def test_later_repeats_use_the_heading_of_the_origin() -> None:
    driver = Driver(replace(TASK, legs=[(2.0, 0.0)], origin=(0.0, 0.0, 0.0)), 0.0)
    robot = Robot(OdometryPose(0.1, -0.1, 0.25))
    list(run(driver, robot))
    assert robot.pose[:2] == pytest.approx((2.0, 0.0), abs=0.05)


def test_gap_between_two_iterations_stops_the_robot() -> None:
    driver, robot, since_s = moving()
    driver.on_order(since_s + 6.0, OUT)
    driver.on_odometry(since_s + 6.0, robot.odometry())
    assert driver.tick(since_s + 6.0) == ZERO_VELOCITY
    assert driver.stop_reason == "its program was suspended for 6.0 s"


def test_robot_first_returns_along_its_path_if_allowed() -> None:
    task = replace(TASK, legs=[(2.0, 0.0), (0.0, 1.5)], origin=(0.0, 0.0, 0.0), may_return=True)
    driver, robot = Driver(task, 0.0), Robot(OdometryPose(2.0, 1.0, 1.5))
    path_error_m = 0.0
    for _ in run(driver, robot):
        x_m, y_m, _ = robot.pose
        path_error_m = max(path_error_m, min(abs(y_m), abs(x_m - 2.0)))
    assert (driver.phase, driver.stop_reason) == ("there", "")
    assert path_error_m < 0.2, "it follows the path around the corner"
    assert driver.driven_m == pytest.approx(3.5, abs=0.3), "the return does not count"
    driver = Driver(task, 0.0)
    assert set(run(driver, Robot(OdometryPose(0.5, 2.0, 0.0)))) == {ZERO_VELOCITY}
    assert driver.stop_reason.endswith("more than 1 m off its path")
