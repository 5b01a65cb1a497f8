"""The origin of flights and their fence: later starts, reboots, and points outside the fence."""

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.agent.flying.origin import (
    FENCE_MARGIN_M,
    START_M,
    FlightFence,
    FlightOrigin,
    OriginError,
    frame_id,
    is_same_frame,
    resolve_origin,
)

FIRST = FlightOrigin("local", frame_id("boot", 100.0), 3.0, -4.0, 0.7, 48.0, 11.0)
metres = st.floats(-200, 200)


def test_first_start_is_the_origin() -> None:
    assert resolve_origin(None, FIRST) == FIRST


def test_later_start_keeps_heading_and_position_of_the_first() -> None:
    start = replace(FIRST, x_m=4.0, heading_rad=0.7 + math.pi, latitude_deg=None, longitude_deg=None)
    origin = resolve_origin(FIRST, start)
    assert (origin.x_m, origin.y_m, origin.heading_rad) == (3.0, -4.0, 0.7)


def test_after_a_reboot_latitude_and_longitude_give_the_position() -> None:
    """A degree of latitude is 111.2 km on a sphere; one of longitude at 48 degrees is cos(48 degrees) times that."""
    rebooted = frame_id("boot", 500.0)
    start = replace(FIRST, frame_id=rebooted, x_m=0.0, y_m=0.0, latitude_deg=48.0 + 1.0 / 111_200)
    origin = resolve_origin(FIRST, start)
    assert (origin.x_m, origin.y_m) == pytest.approx((-1.0, 0.0), abs=0.01)
    farther_east = replace(
        start, latitude_deg=48.0, longitude_deg=11.0 + 1.0 / (111_200 * math.cos(math.radians(48)))
    )
    assert resolve_origin(FIRST, farther_east).y_m == pytest.approx(-1.0, abs=0.01)


def test_distant_start_and_reboot_without_gps_are_rejected() -> None:
    without_gps = {"latitude_deg": None, "longitude_deg": None}
    with pytest.raises(OriginError, match=r"2\.5 m from the place .* bearing of 90 degrees"):
        resolve_origin(FIRST, replace(FIRST, y_m=FIRST.y_m + START_M + 0.5, **without_gps))  # type: ignore[arg-type]
    with pytest.raises(OriginError, match="has rebooted"):
        resolve_origin(FIRST, replace(FIRST, frame_id=frame_id("boot", 500.0), **without_gps))  # type: ignore[arg-type]


def test_frame_is_the_same_until_a_reboot() -> None:
    assert is_same_frame(frame_id("boot", 100.0), frame_id("boot", 103.0))
    assert not is_same_frame(frame_id("boot", 100.0), frame_id("other", 100.0))
    assert not is_same_frame(frame_id("boot", 100.0), frame_id("boot", 160.0))
    assert not is_same_frame("boot", "boot")


@given(metres, metres, metres)
def test_set_points_are_clamped_to_the_fence(north_m: float, east_m: float, down_m: float) -> None:
    fence = FlightFence(FIRST, -1.0, radius_m=20.0, ceiling_m=5.0)
    north, east, down = fence.clamped((north_m, east_m, down_m))
    assert math.hypot(north - FIRST.x_m, east - FIRST.y_m) <= 20.0 + 1e-6
    assert -6.0 <= down <= -1.0
    if math.hypot(north_m - FIRST.x_m, east_m - FIRST.y_m) <= 20.0 and -6.0 <= down_m <= -1.0:
        assert (north, east, down) == pytest.approx((north_m, east_m, down_m))


def test_position_beyond_fence_and_margin_is_a_breach() -> None:
    fence = FlightFence(FIRST, 0.0, radius_m=20.0, ceiling_m=5.0)
    limit_m = 20.0 + FENCE_MARGIN_M
    assert not fence.breach((FIRST.x_m + limit_m - 0.1, FIRST.y_m, -4.0))
    assert "from its origin" in fence.breach((FIRST.x_m + limit_m + 0.1, FIRST.y_m, -4.0))
    assert "above the ground" in fence.breach((FIRST.x_m, FIRST.y_m, -5.1 - FENCE_MARGIN_M))


@given(metres, metres)
def test_relative_position_is_the_inverse_of_position_at(ahead_m: float, left_m: float) -> None:
    assert FIRST.relative_m(FIRST.position_at(ahead_m, left_m, 0.0)) == pytest.approx((ahead_m, left_m), abs=1e-6)
