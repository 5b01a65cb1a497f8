"""Comparison of recorded positions with the planned placement: accepted and rejected differences."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.model import Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.positions import position_columns, position_sources
from fieldkit.measure.positions.position_sources import PositionSource, PositionSources
from fieldkit.measure.positions.samples import LOCAL, WGS84
from fieldkit.steps import position_recording
from fieldkit.steps.view import View
from fieldkit.trial import placements
from tests.helpers.casts import los_plan

DEGREE_M = 110_574.28
"""Metres per degree of latitude at the equator."""


def write_sources(folder: Path, receiver: PositionSource, sender: PositionSource) -> AttemptEvidence:
    stored = PositionSources({Role.SENDER: sender, Role.RECEIVER: receiver})
    (folder / position_sources.FILE).write_text(position_sources.text(stored), encoding="utf-8")
    return AttemptEvidence(folder)


def write_local_positions(folder: Path, distance_m: float) -> AttemptEvidence:
    sender, receiver = (PositionSource(place=(at_m, 0.0, 0.0), frame=LOCAL) for at_m in (5.0, 5.0 + distance_m))
    return write_sources(folder, receiver, sender)


def write_satellite_positions(folder: Path, distance_m: float) -> AttemptEvidence:
    sender, receiver = (PositionSource(place=(at_m / DEGREE_M, 0.0, None), frame=WGS84) for at_m in (0.0, distance_m))
    return write_sources(folder, receiver, sender)


PLAN = los_plan()
SCENE = PLAN.scene(next(iter(PLAN.repeats_in_order())), "")
PLANNED_M = math.dist(SCENE.places_m[Role.SENDER], SCENE.places_m[Role.RECEIVER])
"""Distance of the stations: each is 30 ft from the relay."""


@pytest.mark.parametrize(
    ("distance_m", "agrees"), [(18.288, True), (18.897, True), (17.0, True), (24.0, False), (200.0, False)]
)
def test_positions_in_metres_have_a_tolerance_of_two_metres(distance_m: float, agrees: bool, tmp_path: Path) -> None:
    """The distance of the stations is 18.897 m if each is 31 ft instead of 30 ft from the relay."""
    reason = placements.contradiction(SCENE, write_local_positions(tmp_path, distance_m))
    assert (reason is None) is agrees
    if reason:
        assert reason.startswith(
            "the planned distance of the sender and the receiver is 18.3 m, but the distance of their recorded"
        )


@given(error_m=st.floats(-18, 300))
def test_satellite_positions_have_a_tolerance_for_their_error(
    error_m: float, tmp_path_factory: pytest.TempPathFactory
) -> None:
    contradiction = placements.contradiction(
        SCENE, write_satellite_positions(tmp_path_factory.getbasetemp(), PLANNED_M + error_m)
    )
    tolerance_m = placements.SATELLITE_M + placements.SHARE * PLANNED_M
    if not math.isclose(abs(error_m), tolerance_m, abs_tol=0.2):
        assert (contradiction is None) is (abs(error_m) < tolerance_m)


def test_missing_positions_do_not_contradict_the_placement(tmp_path: Path) -> None:
    assert placements.contradiction(SCENE, AttemptEvidence(tmp_path)) is None
    fixed_receiver = PositionSources({Role.RECEIVER: PositionSource(place=(300.0, 0.0, 0.0), frame=LOCAL)})
    (tmp_path / position_sources.FILE).write_text(position_sources.text(fixed_receiver), encoding="utf-8")
    assert placements.contradiction(SCENE, AttemptEvidence(tmp_path)) is None
    assert placements.contradiction(replace(SCENE, placement=None), write_local_positions(tmp_path, 300.0)) is None


@pytest.mark.parametrize(
    ("error_m", "expected_reason"), [(0.0, None), (200.0, "the receiver is 200.0 m away from its placement")]
)
def test_a_position_recorded_by_the_laptop_is_compared_with_the_plan(
    error_m: float, expected_reason: str | None, tmp_path: Path
) -> None:
    places_m = SCENE.places_m
    x, y, z = places_m[Role.RECEIVER]
    evidence = write_sources(
        tmp_path, PositionSource(place=(x + error_m, y, z)), PositionSource(place=places_m[Role.SENDER])
    )
    problems = list(position_recording.problems(View(SCENE, evidence), ()))
    assert (
        (problems == []) if expected_reason is None else [expected_reason in reason for reason in problems] == [True]
    )


@pytest.mark.parametrize(
    ("column", "is_dependent"),
    [
        ("transfer_distance_start_m", True),
        ("up.rtt_distance_max_m", True),
        ("rtt_relative_speed_m_s", True),
        ("transfer_sender_speed_m_s", True),
        ("distance_m", False),
        ("drive_farthest_m", False),
        ("rtt_median_s", False),
    ],
)
def test_columns_of_distances_and_speeds_depend_on_positions(column: str, is_dependent: bool) -> None:
    assert position_columns.depends_on_positions(column) is is_dependent


def test_every_column_of_positions_depends_on_them() -> None:
    from fieldkit.measure.evidence.track import Separation  # noqa: PLC0415

    assert all(position_columns.depends_on_positions(f"rtt_{name}") for name in Separation.__dataclass_fields__)
