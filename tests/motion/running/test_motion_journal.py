"""The journal of motions, and the fence in random attempts, faults and resumes of a robot that brakes slowly."""

import math
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldkit.agent.driving.drive_plan import BACK, OUT, START_M, DriveTask
from fieldkit.agent.driving.steering import Driver, DriveVelocity, OdometryPose
from fieldkit.core import laptop_files
from fieldkit.core.errors import MotionHeldError
from fieldkit.core.model import Distance, Placement, Role, Scenario, Topology
from fieldkit.motion.logs import drive_checks
from fieldkit.motion.origins import MotionOrigin
from fieldkit.motion.running.motion_journal import (
    MOTION_FILE,
    JournaledOrigins,
    MotionEvent,
    MotionJournal,
    journal_of,
)

ORIGIN = MotionOrigin("odometry", "boot", 1.0, 2.0, 0.5)
ROBOTS = {Role.SENDER: "rover-2", Role.RECEIVER: "rover-1"}
NEAR = Placement(Scenario.LOS, Topology.MASTERLESS, Distance(5.0, "5m"))
FAR = Placement(Scenario.LOS, Topology.MASTERLESS, Distance(10.0, "10m"))
TICK_S = 0.05
DECELERATION_M_S2 = 1.0
SPEED_M_S = 1.0
MARGIN_M = SPEED_M_S * 2 * TICK_S + SPEED_M_S**2 / (2 * DECELERATION_M_S2)
"""Distance beyond the fence: two cycles of the control loop, and the braking distance v^2 / (2 a)."""
TASK = DriveTask(
    legs=[(4.0, 0.0)],
    speed_m_s=SPEED_M_S,
    turn_rad_s=2.0,
    acceleration_m_s2=1.0,
    fence_m=3.0,
    lease_s=2.0,
    odometry_s=0.5,
    limit_s=60.0,
)


def open_origins(folder: Path, placement: Placement = NEAR, *, may_return: bool = False) -> JournaledOrigins:
    """Return the origins of a trial, read by a new run of fieldkit."""
    return JournaledOrigins(MotionJournal(folder / MOTION_FILE), folder, ROBOTS, placement, may_return=may_return)


def test_an_origin_is_valid_in_later_runs_while_the_robot_is_at_its_place(tmp_path: Path) -> None:
    open_origins(tmp_path).record(Role.RECEIVER, ORIGIN)
    open_origins(tmp_path).record(Role.SENDER, replace(ORIGIN, x_m=9.0))
    assert open_origins(tmp_path).get(Role.RECEIVER) == ORIGIN
    assert open_origins(tmp_path, FAR).get(Role.RECEIVER) == ORIGIN, "the sender is moved, the receiver is not"
    assert open_origins(tmp_path, FAR).get(Role.SENDER) is None


def test_a_place_is_new_if_the_last_origin_belongs_to_another_place(tmp_path: Path) -> None:
    assert not open_origins(tmp_path).is_new_place(Role.SENDER), "there is no origin before the first motion"
    for role in ROBOTS:
        open_origins(tmp_path).record(role, ORIGIN)
    assert not open_origins(tmp_path).is_new_place(Role.SENDER)
    assert open_origins(tmp_path, FAR).is_new_place(Role.SENDER)
    assert not open_origins(tmp_path, FAR).is_new_place(Role.RECEIVER), "the receiver is not moved"
    MotionJournal(tmp_path / MOTION_FILE).add(MotionEvent.CONFIRMED, "rover-2")
    assert open_origins(tmp_path, FAR).is_new_place(Role.SENDER), "the confirmation was for the former place"
    open_origins(tmp_path, FAR).record(Role.SENDER, ORIGIN)
    assert open_origins(tmp_path, NEAR).is_new_place(Role.SENDER), "no person confirmed the return to the first place"


@pytest.mark.parametrize("at_place", [True, False])
def test_only_a_confirmation_lets_robots_move_after_a_fault(tmp_path: Path, at_place: bool) -> None:
    first = open_origins(tmp_path)
    first.record(Role.RECEIVER, ORIGIN)
    with first.moving(Role.RECEIVER) as motion:
        motion.mark_ended(ORIGIN)
    with pytest.raises(ValueError, match="fault"), first.moving(Role.RECEIVER):
        raise ValueError("fault")
    for role in ROBOTS:
        with pytest.raises(MotionHeldError, match="rover-1"), open_origins(tmp_path).moving(role):
            pytest.fail("the robot moved")
    journal = MotionJournal(tmp_path / MOTION_FILE)
    journal.confirm("how", at_place=at_place)
    reopened_origins = open_origins(tmp_path)
    reopened_origins.require()
    assert reopened_origins.get(Role.RECEIVER) == (None if at_place else ORIGIN)


def test_a_stop_by_the_operator_holds_the_robots_of_a_campaign(tmp_path: Path) -> None:
    (tmp_path / laptop_files.CAMPAIGN).write_text("{}", encoding="utf-8")
    trials = tmp_path / "first", tmp_path / "second"
    first = JournaledOrigins(MotionJournal(journal_of(trials[0])), trials[0], ROBOTS, NEAR)
    first.require()
    with pytest.raises(KeyboardInterrupt), first.moving(Role.RECEIVER):
        raise KeyboardInterrupt
    second = JournaledOrigins(MotionJournal(journal_of(trials[1])), trials[1], ROBOTS, NEAR)
    with pytest.raises(MotionHeldError, match="rover-1: stopped by the operator") as error_info:
        second.require()
    assert "the same fieldkit campaign command" in error_info.value.remedy


def test_a_kill_during_a_motion_holds_the_robots(tmp_path: Path) -> None:
    MotionJournal(tmp_path / MOTION_FILE).add(MotionEvent.STARTED, "rover-1")
    with pytest.raises(MotionHeldError, match="fieldkit stopped while it moved"):
        open_origins(tmp_path).require()


def test_two_robots_move_at_the_same_time(tmp_path: Path) -> None:
    origins = open_origins(tmp_path)
    with origins.moving(Role.SENDER) as sender_motion, origins.moving(Role.RECEIVER) as receiver_motion:
        receiver_motion.mark_ended()
        sender_motion.mark_ended()
    origins.require()


def test_the_trials_of_a_campaign_share_a_journal(tmp_path: Path) -> None:
    trial = tmp_path / "trial"
    assert journal_of(trial) == trial / MOTION_FILE
    (tmp_path / "campaign.yaml").touch()
    assert journal_of(trial) == tmp_path / MOTION_FILE


def test_logs_and_robots_have_the_same_maximum_start_distance() -> None:
    assert drive_checks._START_M == START_M


class BrakingBase:
    """A base that decelerates with `DECELERATION_M_S2`, and has exact odometry."""

    def __init__(self) -> None:
        self.pose = OdometryPose(0.0, 0.0, 0.0)
        self.forward_m_s = 0.0

    def drive(self, velocity: DriveVelocity) -> None:
        braked_m_s = max(self.forward_m_s - DECELERATION_M_S2 * TICK_S, velocity.forward_m_s)
        self.forward_m_s = braked_m_s
        x_m, y_m, yaw_rad = self.pose
        ahead_m = self.forward_m_s * TICK_S
        yaw_rad += velocity.turn_rad_s * TICK_S
        self.pose = OdometryPose(x_m + ahead_m * math.cos(yaw_rad), y_m + ahead_m * math.sin(yaw_rad), yaw_rad)


ATTEMPTS = st.lists(st.tuples(st.integers(0, 400), st.sampled_from(["lease", "suspended", "back"])), max_size=6)


@settings(max_examples=30, deadline=None)
@given(ATTEMPTS)
def test_robot_remains_within_the_fence_in_any_sequence_of_attempts(attempts: list[tuple[int, str]]) -> None:
    """Each attempt is a new run, with the option that allows motion from the position after a fault."""
    base, now_s = BrakingBase(), 0.0
    farthest_m = 0.0
    with TemporaryDirectory() as temporary_folder:
        folder = Path(temporary_folder)
        for ticks, end in attempts:
            origins = open_origins(folder, may_return=True)
            MotionJournal(folder / MOTION_FILE).confirm("option", at_place=False)
            origins = open_origins(folder, may_return=True)
            origin = origins.get(Role.RECEIVER)
            task = TASK if origin is None else replace(TASK, origin=(origin.x_m, origin.y_m, origin.heading_rad))
            driver = Driver(replace(task, may_return=True), now_s)
            order = OUT
            for number in range(4000):
                now_s += 3.0 if number == ticks and end == "suspended" else TICK_S
                driver.on_odometry(now_s, base.pose)
                if number == ticks and end == "back":
                    order = BACK
                if driver.ready and origins.get(Role.RECEIVER) is None:
                    origins.record(Role.RECEIVER, MotionOrigin("odometry", "boot", *base.pose))
                if not (number >= ticks and end == "lease"):
                    driver.on_order(now_s, order)
                base.drive(driver.tick(now_s))
                farthest_m = max(farthest_m, math.hypot(*base.pose[:2]))
                if driver.is_finished and not base.forward_m_s:
                    break
            assert driver.is_finished
    assert farthest_m <= TASK.fence_m + MARGIN_M
