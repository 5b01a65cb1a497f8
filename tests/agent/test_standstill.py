"""Detection of standstill from odometry with exact paths."""

import pytest

from fieldkit.agent.driving.standstill import WINDOW_S, Standstill
from fieldkit.agent.driving.steering import OdometryPose


def standstill_after(speed_m_s: float, turn_rad_s: float, duration_s: float, rate_hz: float = 20.0) -> Standstill:
    standstill = Standstill()
    for number in range(round(duration_s * rate_hz) + 1):
        at_s = number / rate_hz
        standstill.add_pose(100.0 + at_s, OdometryPose(speed_m_s * at_s, 1.0, turn_rad_s * at_s))
    return standstill


@pytest.mark.parametrize(
    ("speed_m_s", "turn_rad_s", "stationary"),
    [(0.0, 0.0, True), (0.02, 0.0, True), (0.03, 0.0, False), (0.0, 0.09, True), (0.0, 0.12, False)],
)
def test_motion_above_the_limits_is_detected(speed_m_s: float, turn_rad_s: float, *, stationary: bool) -> None:
    assert standstill_after(speed_m_s, turn_rad_s, 1.0).stationary is stationary


def test_short_observation_is_not_a_standstill() -> None:
    assert not Standstill().stationary
    assert not standstill_after(0.0, 0.0, WINDOW_S - 0.05).stationary
    assert standstill_after(0.0, 0.0, WINDOW_S).stationary


def test_stopped_robot_is_stationary_after_the_window() -> None:
    standstill = standstill_after(0.5, 0.0, 1.0)
    final_pose = OdometryPose(0.5, 1.0, 0.0)
    for number in range(1, 5):
        assert not standstill.stationary
        standstill.add_pose(101.0 + number / 20, final_pose)
    assert standstill.stationary
