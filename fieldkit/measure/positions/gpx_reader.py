"""Reader of GPX files, which `position_files` runs in a separate process. No other module imports gpxpy."""

from pathlib import Path

import gpxpy

from fieldkit.measure.evidence import sandbox_process
from fieldkit.measure.evidence.sandbox import Json
from fieldkit.measure.positions.samples import utc_ns


def answer(request: Json) -> Json:
    """Return the points of all tracks in the file at `path` of the request.

    A point is a list of time in ns, latitude and longitude in degrees, and height in metres or None.

    Raises:
        Exception: The file cannot be read. gpxpy and its XML parser raise many types of errors for invalid content.
    """
    with Path(request["path"]).open(encoding="utf-8-sig") as file:
        gpx = gpxpy.parse(file)
    points = [point for track in gpx.tracks for segment in track.segments for point in segment.points]
    if any(point.time is not None and point.time.tzinfo is None for point in points):
        raise ValueError("a time has no time zone; times in GPX are UTC, for example 2026-11-22T10:00:00Z")
    timed_points = [point for point in points if point.time is not None]
    if len(timed_points) < len(points):
        raise ValueError(f"{len(points) - len(timed_points)} of {len(points)} points have no time")
    return {
        "points": [
            (utc_ns(point.time), point.latitude, point.longitude, point.elevation)
            for point in timed_points
            if point.time
        ]
    }


if __name__ == "__main__":
    sandbox_process.serve(answer)
