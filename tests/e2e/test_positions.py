"""True positions of robots compared with odometry, satellite positions and a GPX track that is added later."""

import math
from collections.abc import Mapping
from dataclasses import astuple
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path

import pytest

from fieldkit.core.model import Role, TrackPoint
from fieldkit.measure.evidence import ping, track
from fieldkit.measure.evidence.track import Separation
from fieldkit.ros.bags import bag
from tests.helpers.paths import ROOT
from tests.helpers.runs import only_trial, rows, run_here
from tests.helpers.texts import procedure, site

pytestmark = pytest.mark.emulated

SITE = site(
    {"turtlebot-1": "turtlebot3_burger", "rover-1": "rover"},
    emulated="ros: builtin, radio: {fading: false, shadowing_db: 0.0}",
)
WALK = procedure(
    "walk",
    """\
- track:
    robots: {receiver: {topic: /odom, facing: away}}
    during:
      - move:
          robot: receiver
          path: [{away: 4m}, {left: 2m}]
          speed: 2m/s
          during:
            - ping: {from: sender, to: receiver, count: 16, interval: 200ms, payload_bytes: 500}
""",
    protocols="udp",
)
SPEED_M_S = 2.0
EARTH_M = 111_319.49, 110_574.28
"""Metres per degree east and north at the world's origin, on the equator."""


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    (tmp_path / "fieldkit.yaml").write_text(SITE, encoding="utf-8")
    profile = (ROOT / "robots" / "turtlebot3_burger.yaml").read_text(encoding="utf-8")
    fix = "    - {name: /fix, type: sensor_msgs/NavSatFix, rate: 10Hz, frame: gps}\n"
    for old, new in (
        ("name: turtlebot3_burger", "name: rover"),
        ("max_speed_m_s: 0.22", "max_speed_m_s: 2.0"),
        ("    - {name: /battery_state", fix + "    - {name: /battery_state"),
    ):
        assert old in profile
        profile = profile.replace(old, new)
    for folder, name, text in (("robots", "rover", profile), ("procedures", "walk", WALK)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / f"{name}.yaml").write_text(text, encoding="utf-8")
    return tmp_path


def run_walk(lab: Path) -> Path:
    """Run the procedure and return the folder of its only trial."""
    run = run_here(lab, "trial", "walk", "10m")
    assert run.code == 0, run.out + run.err
    return only_trial(lab)


def true_separation(trial: Path) -> Separation:
    folder = trial / "repeats" / "udp-01"
    times_ns = [at for echo in ping.read(folder / "ping.txt").answers if (at := echo.at_utc_ns)]
    measured = track.separation_between(
        track.read(folder / "track.csv"), Role.SENDER, Role.RECEIVER, min(times_ns), max(times_ns)
    )
    assert measured is not None
    return measured


def max_update_distance_m(trial: Path) -> float:
    """Return the maximum distance that the receiver moved between two updates of the medium.

    It is 0.1 m if the updates were on time.
    """
    track_points = track.read(trial / "repeats" / "udp-01" / "track.csv")
    positions_m = [
        point.position_m for point in track_points if point.role is Role.RECEIVER and point.position_m is not None
    ]
    return max(math.dist(*pair) for pair in pairwise(positions_m[:-1])) + 1e-3


def separation_by_columns(trial: Path) -> Separation:
    (row,) = rows(trial)
    assert row["status"] == "valid", row["reason"]
    names = Separation.__dataclass_fields__
    return Separation(*(float(row[f"rtt_{name}"] or "nan") for name in names))


def assert_similar(first: Separation, second: Separation, *, within_m: float) -> None:
    """Assert that two separations have equal distances, and equal speeds except for corners and noise."""
    assert astuple(first)[:4] == pytest.approx(astuple(second)[:4], abs=within_m)
    assert first.relative_speed_m_s == pytest.approx(second.relative_speed_m_s, abs=0.1 * SPEED_M_S)
    assert first.sender_speed_m_s == second.sender_speed_m_s == 0


def test_odometry_equals_the_true_positions_and_the_motion_of_the_robot(lab: Path) -> None:
    trial = run_walk(lab)
    (row,) = rows(trial)
    error_m = SPEED_M_S * float(row["positions_clock_error_s"]) + max_update_distance_m(trial)
    assert_similar(separation_by_columns(trial), true_separation(trial), within_m=error_m)
    assert row["positions_from"] == "sender as placed, receiver /odom"

    folder = trial / "repeats" / "udp-01"
    samples = bag.positions(folder / "track_receiver.bag", "/odom", "")["rows"]
    steps_m = [math.dist(before[2:4], after[2:4]) for before, after in pairwise(samples)]
    assert sum(steps_m) == pytest.approx(6.0, abs=0.1), "4 m away and 2 m to the left, minus a cut corner"
    assert samples[-1][2:4] == pytest.approx([4.0, 2.0])
    assert samples[-1][5] == pytest.approx(math.pi / 2)
    moving = {round(sample[2] + sample[3], 3): sample[1] for sample in samples if 0 < sample[2] < 4}
    (first_m, first_ns), (last_m, last_ns) = min(moving.items()), max(moving.items())
    assert (last_m - first_m) / ((last_ns - first_ns) / 1e9) == pytest.approx(SPEED_M_S, rel=0.1)

    before = (trial / "trial.csv").read_bytes()
    assert run_here(lab, "rebuild", str(trial)).out.endswith("the same bytes as before\n")
    assert (trial / "trial.csv").read_bytes() == before
    output = run_here(lab, "positions", str(trial)).out
    assert output.startswith("udp-01  rtt: 10.")
    assert output.endswith(" m, sender as placed, receiver /odom\n")


def test_satellite_positions_equal_the_true_positions(lab: Path) -> None:
    file = lab / "procedures" / "walk.yaml"
    place = f"{{lat: {6 / EARTH_M[1]:.9f}, lon: {3 / EARTH_M[0]:.9f}}}"  # position of the sender on the lawn
    robots = f"{{receiver: {{topic: /fix}}, sender: {{at: {place}}}}}"
    file.write_text(WALK.replace("{receiver: {topic: /odom, facing: away}}", robots), encoding="utf-8")
    trial = run_walk(lab)
    expected, measured = true_separation(trial), separation_by_columns(trial)
    # A fix has a standard deviation of 0.1 m, and extremes deviate by three standard deviations.
    assert measured.distance_mean_m == pytest.approx(expected.distance_mean_m, abs=0.15)
    assert (measured.distance_min_m, measured.distance_max_m) == pytest.approx(
        (expected.distance_min_m, expected.distance_max_m), abs=0.5
    )


def gpx(path: Path, places: tuple[TrackPoint, ...], late_s: float) -> None:
    """Write the path of the receiver as a phone of an accompanying person, whose clock is `late_s` late."""
    points = []
    for point, next_point in pairwise(point for point in places if point.role is Role.RECEIVER):
        assert point.position_m is not None
        place = f'lat="{point.position_m[1] / EARTH_M[1]:.9f}" lon="{point.position_m[0] / EARTH_M[0]:.9f}"'
        for utc_ns in (
            *range(point.utc_ns, next_point.utc_ns - 1_000_000, 200_000_000),
            next_point.utc_ns - 1_000_000,
        ):
            at = datetime.fromtimestamp(utc_ns / 1e9 - late_s, UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")
            points.append(f"<trkpt {place}><ele>{point.position_m[2]}</ele><time>{at}</time></trkpt>")
    text = f"<trk><trkseg>{''.join(points)}</trkseg></trk>"
    path.write_text(f'<gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1">{text}</gpx>', encoding="utf-8")


def tables(trial: Path) -> Mapping[str, bytes]:
    return {name: (trial / name).read_bytes() for name in ("trial.csv", "summary.csv")}


def test_gpx_of_an_accompanying_person_can_be_added_and_removed_later(lab: Path) -> None:
    procedure_text = WALK.replace("  - track:\n", "")
    procedure_text = procedure_text.replace("      robots: {receiver: {topic: /odom, facing: away}}\n", "")
    procedure_text = procedure_text.replace("      during:\n        - move:", "  - move:", 1)
    (lab / "procedures" / "walk.yaml").write_text(procedure_text, encoding="utf-8")
    trial = run_walk(lab)
    before, expected = tables(trial), true_separation(trial)
    assert_similar(separation_by_columns(trial), expected, within_m=1e-6)
    points = track.read(trial / "repeats" / "udp-01" / "track.csv")
    sender = f"sender={6 / EARTH_M[1]:.9f},{3 / EARTH_M[0]:.9f}"
    gpx(lab / "walk.gpx", points, late_s=2.5)

    run = run_here(lab, "positions", str(trial), "receiver=walk.gpx", sender, "--offset", "2.5s")
    assert run.code == 0, run.err
    assert run.out.startswith("changed: trial.csv")
    assert "receiver positions-receiver.gpx" in run.out
    assert_similar(separation_by_columns(trial), expected, within_m=max_update_distance_m(trial))
    assert run_here(lab, "verify", str(trial)).code == 0
    assert run_here(lab, "positions", str(trial), "--clear").code == 0
    assert tables(trial) == before
    assert not list(trial.glob("positions*"))
    assert run_here(lab, "verify", str(trial)).code == 0
