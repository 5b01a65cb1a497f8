"""Consecutive repeats of a flight of an emulated ArduCopter follow the same path.

The field backend does not move the drone between repeats, and an ArduCopter turns towards home when it returns.
"""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from fieldkit.core.model import Role, Vector
from tests.helpers.field_robots import start_field_robots
from tests.helpers.paths import ROOT
from tests.helpers.runs import only_trial, rows, run_here
from tests.helpers.texts import site

pytestmark = pytest.mark.emulated

PATH_M = 1.0
HEIGHT_M = 0.4
AIRBORNE_M = 0.1
LAB = site({"turtlebot-1": "turtlebot3_burger", "copter-1": "copter"}, emulated="ros: builtin")
PROCEDURE = """\
name: again
summary: an ArduCopter flies away and returns, again and again
scenario: los
topology: masterless
protocols: [tcp]
repeats: {repeats}
attempts: 3
steps:
  - fly:
      robot: receiver
      height: {height_m:g}m
      path: [{{away: {path_m:g}m}}]
      speed: 3m/s
      climb: 2m/s
      then: return
      lease: 60s
      during: [{{wait: {{duration: 2s}}}}]
"""


def flights(places_m: Sequence[Vector]) -> Iterator[list[Vector]]:
    """Yield the positions of each flight, with the last position on the ground before it and the first after it."""
    ground_m, flight = places_m[0][2], [places_m[0]]
    for place_m in places_m:
        if place_m[2] > ground_m + AIRBORNE_M:
            flight.append(place_m)
        elif len(flight) > 1:
            yield [*flight, place_m]
            flight = [place_m]
        else:
            flight = [place_m]


def farthest_m(flight: Sequence[Vector], start_m: Vector) -> tuple[float, float]:
    """Return the position of a flight that is farthest from the start, relative to the start: east, north."""
    east_m, north_m, _ = max(flight, key=lambda place_m: math.dist(place_m[:2], start_m[:2]))
    return east_m - start_m[0], north_m - start_m[1]


@pytest.mark.parametrize("repeats", [2, pytest.param(10, marks=pytest.mark.nightly)])
def test_consecutive_repeats_fly_the_same_path(repeats: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "robots").mkdir()
    (tmp_path / "procedures").mkdir()
    profile = (ROOT / "robots/duckiedrone.yaml").read_text(encoding="utf-8")
    profile = profile.replace("name: duckiedrone", "name: copter")
    profile = profile.replace("port: 14550", "port: 14550\n  autopilot: ardupilot\n  boot_s: 0")
    (tmp_path / "robots/copter.yaml").write_text(profile, encoding="utf-8")
    (tmp_path / "procedures/again.yaml").write_text(
        PROCEDURE.format(repeats=repeats, height_m=HEIGHT_M, path_m=PATH_M), encoding="utf-8"
    )
    (tmp_path / "lab.yaml").write_text(LAB, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    with start_field_robots(tmp_path, site=tmp_path / "lab.yaml") as field_robots:
        run = run_here(tmp_path, "trial", "again", "5m", "--yes", "--allow-motion", "--allow-motion-after-fault")
        assert run.code == 0, run.err
        track = [place for place in field_robots.testbed.oracle.track(0) if place.role is Role.RECEIVER]
    places_m = [place.position_m for place in track if place.position_m is not None]
    recorded_flights = list(flights(places_m))
    home_m = places_m[0]
    for flight in recorded_flights:
        east_m, north_m = farthest_m(flight, home_m)
        assert 0.4 * PATH_M < east_m < 1.3 * PATH_M, (
            "on a busy machine, the drone must return before the end of its path"
        )
        assert abs(north_m) < 0.3
    # On a busy machine the pilot may be suspended; it then lands the drone, and the attempt is void.
    results = [row for row in rows(only_trial(tmp_path)) if row["status"] != "void"]
    assert [row["status"] for row in results] == ["valid"] * repeats
    attempts = sum(int(row["attempt"]) for row in results)
    assert len(recorded_flights) <= attempts
    if attempts == repeats:
        assert len(recorded_flights) == repeats
        for row, flight in zip(results, recorded_flights, strict=True):
            assert math.dist(flight[-1][:2], home_m[:2]) < 0.5, "it came back"
            assert float(row["fly_farthest_m"]) == pytest.approx(farthest_m(flight, home_m)[0], abs=0.3)
