"""Tracks of robots: writing, reading, damaged files, and columns."""

from dataclasses import astuple
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import FIXED_ROLES, Role, TrackPoint
from fieldkit.measure.evidence import track
from tests.helpers.measures import measure

S = 10**9
ENDS = (Role.SENDER, Role.RECEIVER)
SENDER_POINT = TrackPoint(5 * S, Role.SENDER, (1.0, 0.0, 0.2))
RECEIVER_POINT = TrackPoint(5 * S, Role.RECEIVER, (4.0, 4.0, 0.2))
MOVING_AWAY = (
    SENDER_POINT,
    RECEIVER_POINT,
    TrackPoint(10 * S, Role.SENDER, (1.0, 0.0, 0.2), (-3.0, 0.0, 0.0)),
    TrackPoint(11 * S, Role.SENDER, (-4.0, 4.0, 0.2), (-3.0, 0.0, 4.0)),
    TrackPoint(12 * S, Role.RELAY, (0.0, 0.0, 0.2)),
    TrackPoint(13 * S, Role.SENDER, None),
    TrackPoint(15 * S, Role.SENDER, (1.0, 0.0, 0.2)),
)
PING = """\
PING 10.42.0.2 (10.42.0.2) 502(530) bytes of data.
[10.500000] 510 bytes from 10.42.0.2: icmp_seq=1 ttl=64 time=2 ms
[12.500000] 510 bytes from 10.42.0.2: icmp_seq=2 ttl=64 time=2 ms
3 packets transmitted, 2 received, 33% packet loss, time 3000ms
"""

COORDINATES = st.integers(-(10**7), 10**7).map(lambda tenths: tenths / 1e4)
VECTORS = st.tuples(COORDINATES, COORDINATES, COORDINATES)
TRACKS = st.lists(
    st.builds(TrackPoint, st.integers(0, 2**63), st.sampled_from(FIXED_ROLES), st.none() | VECTORS, VECTORS),
    max_size=20,
).map(lambda track: sorted(track, key=lambda entry: entry.utc_ns))


def test_distance_and_speed_are_means_over_times_with_positions() -> None:
    separation = track.separation_between(MOVING_AWAY, *ENDS, 10 * S + S // 2, 14 * S)
    # 0.5 s at 5 m, 2 s at 8 m, then 1 s without a position.
    assert separation is not None
    assert astuple(separation) == pytest.approx((5.0, 5.0, 18.5 / 2.5, 8.0, 11.5 / 2.5, 11.5 / 2.5))


def test_a_single_time_has_a_distance_and_a_time_without_a_position_has_none() -> None:
    assert track.separation_between(MOVING_AWAY, *ENDS, 11 * S, 11 * S) == track.Separation(
        8.0, 8.0, 8.0, 8.0, 5.0, 5.0
    )
    assert track.separation_between(MOVING_AWAY, *ENDS, 13 * S, 14 * S) is None
    assert track.separation_between(MOVING_AWAY, *ENDS, 1 * S, 14 * S) is None
    assert track.separation_between((SENDER_POINT,), *ENDS, 6 * S, 14 * S) is None


def test_distances_change_with_both_robots_but_not_with_the_relay() -> None:
    assert list(track.distances_m(MOVING_AWAY, *ENDS)) == [
        (5 * S, 5.0),
        (10 * S, 5.0),
        (11 * S, 8.0),
        (13 * S, None),
        (15 * S, 5.0),
    ]


def test_columns_have_the_distance_between_first_and_last_reply(tmp_path: Path) -> None:
    (tmp_path / "ping.txt").write_text(PING, encoding="ascii")
    without_track = measure(tmp_path, None)
    assert without_track.rtt_distance_start_m is None
    (tmp_path / "track.csv").write_text(track.text(MOVING_AWAY), encoding="ascii")
    row = measure(tmp_path, None)
    assert (row.rtt_distance_start_m, row.rtt_distance_min_m, row.rtt_distance_max_m) == (5.0, 5.0, 8.0)
    assert row.rtt_distance_mean_m == pytest.approx((0.5 * 5 + 1.5 * 8) / 2)
    assert row.rtt_sender_speed_m_s == pytest.approx((0.5 * 3 + 1.5 * 5) / 2)
    assert row.transfer_distance_start_m is None
    (tmp_path / "track.csv").write_text(track.text(MOVING_AWAY)[:-1], encoding="ascii")
    assert measure(tmp_path, None) == without_track


@given(TRACKS)
def test_a_written_track_is_read(tmp_path_factory: pytest.TempPathFactory, points: list[TrackPoint]) -> None:
    path = tmp_path_factory.getbasetemp() / "track.csv"
    path.write_text(track.text(points), encoding="ascii")
    assert track.read(path) == tuple(points)


TEXT = track.text(MOVING_AWAY)


@pytest.mark.parametrize(
    "content",
    [
        "",
        TEXT[:-1],
        TEXT + "\n",
        TEXT.replace("utc_ns", "t"),
        TEXT.replace("sender", "Laptop"),
        TEXT.replace("4.0000,4.0000", "4.0000,"),
        TEXT.replace("4.0000,4.0000", "4.0000,nan"),
        TEXT.replace("4.0000,4.0000", "4.0000,1e3"),
        TEXT.replace(f"{15 * S}", f"{9 * S}"),
    ],
)
def test_invalid_contents_are_refused(tmp_path: Path, content: str) -> None:
    assert content != TEXT
    path = tmp_path / "track.csv"
    path.write_text(content, encoding="ascii")
    with pytest.raises(EvidenceError, match="is not a track of robots"):
        track.read(path)


def test_minus_zero_is_written_as_zero() -> None:
    assert "-0.0000" not in track.text([TrackPoint(1, Role.SENDER, (-0.0, -1e-9, 0.0), (-0.0, 0.0, 0.0))])
