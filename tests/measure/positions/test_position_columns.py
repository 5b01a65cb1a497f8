"""Sources of positions: their precedence, clocks, frames and heights, and damaged files of sources."""

import json
import math
from collections.abc import Mapping
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import Geod

from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import FIXED_ROLES, Role, TrackPoint
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.evidence import ping, track
from fieldkit.measure.positions import position_columns, position_sources, recorded_positions
from fieldkit.measure.positions.position_sources import PositionSource, PositionSources
from fieldkit.measure.positions.samples import LOCAL, PLACED, WGS84
from fieldkit.measure.robot_clock import Offset
from tests.ros.bags.test_bag_positions import BEGAN_NS, S, odometry, pose_stamped, write_bag

SENDER, RECEIVER = Role.SENDER, Role.RECEIVER
ENDS = (SENDER, RECEIVER)
ORACLE = (
    TrackPoint(BEGAN_NS, SENDER, (0.0, 0.0, 0.2)),
    TrackPoint(BEGAN_NS, RECEIVER, (100.0, 0.0, 0.2)),
)
MOVING_AWAY = [odometry(BEGAN_NS + n * S, float(n), 0.0) for n in range(5)]
"""Odometry of a robot that moves away at 1 m/s for 4 s."""
ODOMETRY = PositionSource(
    file="track.bag", topic="/where", start=(10.0, 0.0, 0.0), heading_rad=0.0, began_utc_ns=BEGAN_NS, gap_s=1.5
)
ORIGIN_SOURCE = PositionSource(place=(0.0, 0.0, 0.0))


@pytest.fixture
def attempt(tmp_path: Path) -> Path:
    """Return the folder of an attempt in the folder of a trial."""
    folder = tmp_path / "repeats" / "udp-01"
    folder.mkdir(parents=True)
    return folder


def write_sources(
    folder: Path, robots: Mapping[Role, PositionSource], clocks: Mapping[Role, float] | None = None
) -> None:
    offsets = {role: Offset(offset_s, 0.01) for role, offset_s in (clocks or {}).items()}
    (folder / position_sources.FILE).write_text(
        position_sources.text(PositionSources(robots, offsets)), encoding="utf-8"
    )


def mean_m(folder: Path, begin_s: float = 1.0, end_s: float = 3.0) -> float | str:
    """Return the mean distance during these seconds by the sender's clock, or the reason why it is missing."""
    times_ns = [BEGAN_NS + round(at_s * S) for at_s in (begin_s, end_s)]
    measured = position_columns.measure(AttemptEvidence(folder), ping.MOTION_COLUMNS, ENDS, times_ns)
    name = "rtt_distance_mean_m"
    assert measured.values.keys() | measured.missing.keys() == {column.name for column in ping.MOTION_COLUMNS}
    return float(measured.values[name]) if name in measured.values else measured.missing[name]


def test_sources_of_the_trial_precede_those_of_the_attempt_and_of_the_testbed(attempt: Path) -> None:
    assert mean_m(attempt) == "the positions of the robots are unknown"
    (attempt / track.FILE).write_text(track.text(ORACLE), encoding="ascii")
    assert mean_m(attempt) == pytest.approx(100)
    write_bag(attempt, MOVING_AWAY)
    write_sources(attempt, {SENDER: ORIGIN_SOURCE, RECEIVER: ODOMETRY})
    assert mean_m(attempt) == pytest.approx(12)
    assert recorded_positions.sources_text(AttemptEvidence(attempt)) == "sender as placed, receiver /where"
    trial = attempt.parent.parent
    lines = "".join(f"{BEGAN_NS + n * S},{30 + n},0\n" for n in range(5))
    (trial / "positions-receiver.csv").write_text(f"t_ns,x_m,y_m\n{lines}", encoding="ascii")
    local = PositionSource(place=(0.0, 0.0, 0.0), frame=LOCAL)
    write_sources(trial, {SENDER: local, RECEIVER: PositionSource(file="positions-receiver.csv")})
    assert mean_m(attempt) == pytest.approx(32)
    later = PositionSource(file="positions-receiver.csv", offset_s=-1.0)
    write_sources(trial, {SENDER: local, RECEIVER: later})
    assert mean_m(attempt) == pytest.approx(33), "each position was recorded a second earlier"
    write_sources(trial, {RECEIVER: later})
    assert (
        mean_m(attempt)
        == f"the positions of the robots are in different frames: the sender {PLACED}, the receiver {LOCAL}"
    )


@pytest.mark.parametrize(
    ("clocks", "metres"),
    [
        ({}, 12),
        ({SENDER: 0.5}, 11.5),
        ({RECEIVER: 0.5}, 12.5),
        ({SENDER: -3600.0, RECEIVER: -3600.0}, 12),
    ],
)
def test_times_of_robots_are_converted_to_one_clock(
    attempt: Path, clocks: Mapping[Role, float], metres: float
) -> None:
    clock_error_ns = round(1e9 * clocks.get(RECEIVER, 0.0)) if clocks.get(RECEIVER) == -3600 else 0
    write_bag(
        attempt,
        [odometry(BEGAN_NS + clock_error_ns + n * S, float(n), 0.0) for n in range(-1, 6)],
        late_ns=clock_error_ns,
    )
    start = PositionSource(
        file="track.bag",
        topic="/where",
        start=(10.0, 0.0, 0.0),
        heading_rad=0.0,
        began_utc_ns=BEGAN_NS - round(1e9 * clocks.get(RECEIVER, 0.0)) * (not clock_error_ns),
    )
    write_sources(attempt, {SENDER: ORIGIN_SOURCE, RECEIVER: start}, clocks)
    begin_s, end_s = (1.0 + clock_error_ns / 1e9, 3.0 + clock_error_ns / 1e9)
    assert mean_m(attempt, begin_s, end_s) == pytest.approx(metres)
    assert recorded_positions.clock_error_s(AttemptEvidence(attempt)) == (
        pytest.approx(0.01 * len(clocks)) if clocks else None
    )


@pytest.mark.parametrize(
    ("begin_s", "end_s", "reason"),
    [
        (-1, 2, "the positions of the receiver from /where begin 1.0 s too late"),
        (2, 6, "the positions of the receiver from /where end 2.0 s too early"),
    ],
)
def test_times_that_are_not_covered_are_missing_with_a_reason(
    attempt: Path, begin_s: float, end_s: float, reason: str
) -> None:
    write_bag(attempt, MOVING_AWAY)
    write_sources(attempt, {SENDER: ORIGIN_SOURCE, RECEIVER: ODOMETRY})
    assert mean_m(attempt, begin_s, end_s) == reason


def test_positions_in_a_gap_are_not_interpolated(attempt: Path) -> None:
    write_bag(attempt, MOVING_AWAY[:2] + MOVING_AWAY[3:])
    write_sources(attempt, {SENDER: ORIGIN_SOURCE, RECEIVER: ODOMETRY})
    reason = "the positions of the receiver from /where have a gap of 2.0 s, but at most 1.5 s are allowed"
    assert mean_m(attempt) == reason


def test_distances_over_time_use_the_senders_clock_and_are_none_in_a_gap(attempt: Path) -> None:
    write_bag(attempt, MOVING_AWAY[:2] + MOVING_AWAY[3:])
    write_sources(attempt, {SENDER: ORIGIN_SOURCE, RECEIVER: ODOMETRY}, {SENDER: 0.25})
    distances = position_columns.distances_m(AttemptEvidence(attempt), ENDS)
    begin_ns = BEGAN_NS + S // 4
    gap_entry = (begin_ns + S + 1, None)
    assert distances == [
        (begin_ns, 10),
        (begin_ns + S, 11),
        gap_entry,
        (begin_ns + 3 * S, 13),
        (begin_ns + 4 * S, 14),
    ]
    (attempt / "track.bag").unlink()
    assert position_columns.distances_m(AttemptEvidence(attempt), ENDS) == ()


def test_a_robot_without_a_source_has_no_distance(attempt: Path) -> None:
    write_bag(attempt, MOVING_AWAY)
    write_sources(attempt, {RECEIVER: ODOMETRY})
    assert mean_m(attempt) == "there is no source for the position of the sender"
    (attempt / "track.bag").unlink()
    write_sources(attempt, {SENDER: ORIGIN_SOURCE, RECEIVER: ODOMETRY})
    assert "cannot be read" in str(mean_m(attempt))


def test_a_tracker_and_a_fixed_position_in_its_frame_give_a_distance(attempt: Path) -> None:
    write_bag(attempt, [pose_stamped(BEGAN_NS + n * S, 3.0, float(n)) for n in range(5)])
    tracker = PositionSource(file="track.bag", topic="/where")
    write_sources(attempt, {SENDER: PositionSource(place=(0.0, 2.0, 0.0), frame="frame map"), RECEIVER: tracker})
    assert mean_m(attempt, 2.0, 2.0) == pytest.approx(3)
    write_sources(attempt, {SENDER: ORIGIN_SOURCE, RECEIVER: tracker})
    assert (
        mean_m(attempt)
        == "the positions of the robots are in different frames: the sender as placed, the receiver frame map"
    )


def test_wgs84_heights_are_used_only_if_requested(attempt: Path) -> None:
    latitude, longitude = 39.74, -104.99  # at 1600 m, the same angle is 0.25 mm per metre longer than at sea level
    to_longitude, to_latitude, _ = Geod(ellps="WGS84").fwd(longitude, latitude, 60.0, 1000.0)
    high, low = (latitude, longitude, 1650.0), (to_latitude, to_longitude, 1600.0)
    robots = {SENDER: PositionSource(place=high, frame=WGS84), RECEIVER: PositionSource(place=low, frame=WGS84)}
    write_sources(attempt, robots)
    horizontal_m = 1000 * (1 + 1625 / 6_371_000)
    assert mean_m(attempt) == pytest.approx(horizontal_m, abs=0.002)
    (attempt / position_sources.FILE).write_text(
        position_sources.text(PositionSources(robots, heights=True)), encoding="utf-8"
    )
    assert mean_m(attempt) == pytest.approx(math.hypot(horizontal_m, 50), abs=0.002)
    without_height = robots | {SENDER: PositionSource(place=(latitude, longitude, None), frame=WGS84)}
    (attempt / position_sources.FILE).write_text(
        position_sources.text(PositionSources(without_height, heights=True)), encoding="utf-8"
    )
    assert mean_m(attempt) == "heights are required, but some positions have no height"


FLOATS = st.floats(-1e9, 1e9)
PLACES = st.tuples(FLOATS, FLOATS, st.none() | FLOATS)
SOURCES = st.builds(
    PositionSource,
    place=st.none() | PLACES,
    frame=st.text(max_size=10),
    file=st.sampled_from(["", "track_sender.bag", "track/track_0.db3"]),
    topic=st.text(max_size=10),
    gap_s=FLOATS,
    start=st.tuples(FLOATS, FLOATS, FLOATS),
    heading_rad=st.none() | FLOATS,
    began_utc_ns=st.integers(0, 2**62 - 1),
)
ANY_SOURCES = st.builds(
    PositionSources,
    st.dictionaries(st.sampled_from(FIXED_ROLES), SOURCES),
    st.dictionaries(st.sampled_from(FIXED_ROLES), st.builds(Offset, FLOATS, FLOATS)),
    st.booleans(),
)


@given(ANY_SOURCES)
def test_sources_are_written_and_read(
    tmp_path_factory: pytest.TempPathFactory, written_sources: PositionSources
) -> None:
    path = tmp_path_factory.getbasetemp() / position_sources.FILE
    path.write_text(position_sources.text(written_sources), encoding="utf-8")
    assert position_sources.read(path) == written_sources


@pytest.mark.parametrize(
    "damage",
    [
        {"robots": []},
        {"robots": {"Laptop": {}}},
        {"robots": {"sender": {"plac": [0, 0, 0]}}},
        {"robots": {"sender": {"place": [0, 0]}}},
        {"robots": {"sender": {"place": [0, None, 0]}}},
        {"robots": {"sender": {"place": [0, 0, math.inf]}}},
        {"robots": {"sender": {"start": [0, 0, None]}}},
        {"robots": {"sender": {"file": "../../etc/passwd"}}},
        {"robots": {"sender": {"file": "/etc/passwd"}}},
        {"robots": {"sender": {"file": "a/b/c.bag"}}},
        {"robots": {"sender": {"topic": 3}}},
        {"robots": {"sender": {"gap_s": "3"}}},
        {"robots": {"sender": {"gap_s": 10**400}}},
        {"robots": {"sender": {"began_utc_ns": -1}}},
        {"robots": {"sender": {"began_utc_ns": True}}},
        {"clocks": {"sender": {"offset_s": 1.0}}},
        {"heights": 1},
        {"more": 1},
    ],
)
def test_invalid_sources_are_rejected_and_leave_the_columns_empty(attempt: Path, damage: object) -> None:
    assert isinstance(damage, dict)
    path = attempt / position_sources.FILE
    path.write_text(json.dumps({"robots": {}, "clocks": {}, "heights": False} | damage), encoding="utf-8")
    with pytest.raises(EvidenceError, match="list of position sources"):
        position_sources.read(path)
    assert "list of position sources" in str(mean_m(attempt))
