"""Read GPX with gpxpy; run by `recorded` in a process of its own. The only module that imports gpxpy."""

from pathlib import Path

import gpxpy

from fieldkit.measure.evidence import confined
from fieldkit.measure.evidence.confined import Json
from fieldkit.measure.positions.samples import utc_ns


def answer(question: Json) -> Json:
    """Return the points of all tracks in the file at `path`: time, latitude, longitude, and height where it has one.

    Raises:
        Exception: It cannot be read; any, as gpxpy and what it is built on raise for bytes that are no GPX.
    """
    with Path(question["path"]).open(encoding="utf-8-sig") as file:
        told = gpxpy.parse(file)
    points = [point for track in told.tracks for segment in track.segments for point in segment.points]
    if any(point.time is not None and point.time.tzinfo is None for point in points):
        raise ValueError("a time has no zone; GPX writes them in UTC, 2026-11-22T10:00:00Z")
    timed = [point for point in points if point.time is not None]
    if len(timed) < len(points):
        raise ValueError(f"{len(points) - len(timed)} of {len(points)} points have no time")
    return {
        "points": [
            (utc_ns(point.time), point.latitude, point.longitude, point.elevation) for point in timed if point.time
        ]
    }


if __name__ == "__main__":
    confined.serve(answer)
