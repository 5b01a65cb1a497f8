"""The origin of a trial's flights: the place and heading of the first start, and the fence around that place.

All directions and distances of a plan are relative to the origin, so that each repeat flies the same way, whatever
the heading of the drone is when it starts. The origin is a position in LOCAL_POSITION_NED, whose frame lasts until
the autopilot reboots. Latitude and longitude, where they are known, place it in the frame of a later start.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Mapping, Tuple

Place = Tuple[float, float, float]
"""North, east, down, in metres."""

FRAME = "local"
"""Name of the frame of LOCAL_POSITION_NED in an origin."""
START_M = 2.0
"""A flight starts at most this far from its origin, over the ground."""
FENCE_MARGIN_M = 2.0
"""A position is beyond the fence where it is farther out than the limit by more than this: overshoot, estimate."""
_DEGREE_M = 111_318.84502145034
"""Metres of latitude in a degree (ArduPilot, AP_Common/Location.h, LOCATION_SCALING_FACTOR)."""
_SAME_BOOT_S = 10.0
"""Two estimates of the boot time of one autopilot differ by less: its clock drifts against the computer's."""


class OriginError(Exception):
    """A flight does not start here; the text is for people."""


@dataclass(frozen=True)
class FlightOrigin:
    """Place and heading of a drone at its first start in a trial. The fields are those of a `MotionOrigin`.

    Attributes:
        frame: `FRAME`.
        frame_id: Identity of the life of that frame, from `frame_id`.
        x_m: North.
        y_m: East.
        heading_rad: Direction of its nose, from north to east.
        latitude_deg: Latitude of the place; None if unknown.
        longitude_deg: Longitude; None if unknown.
    """

    frame: str
    frame_id: str
    x_m: float
    y_m: float
    heading_rad: float
    latitude_deg: float | None = None
    longitude_deg: float | None = None

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> FlightOrigin:
        """Return the origin in the values of a plan; the names are those of the fields."""
        return cls(**{name: values.get(name) for name in cls.__dataclass_fields__})  # type: ignore[arg-type]

    def at(self, ahead_m: float, left_m: float, down_m: float) -> Place:
        """Return the position of a point that is given relative to the origin, over the ground; `down_m` is kept."""
        cos, sin = math.cos(self.heading_rad), math.sin(self.heading_rad)
        north_m, east_m = self.x_m + ahead_m * cos + left_m * sin, self.y_m + ahead_m * sin - left_m * cos
        return north_m, east_m, down_m

    def seen(self, place_m: Place) -> tuple[float, float]:
        """Return how far ahead of the origin, and to the left of it, a position is; in metres."""
        north_m, east_m = place_m[0] - self.x_m, place_m[1] - self.y_m
        cos, sin = math.cos(self.heading_rad), math.sin(self.heading_rad)
        return north_m * cos + east_m * sin, north_m * sin - east_m * cos

    def off_m(self, place_m: Place) -> float:
        """Return the distance of a position from the origin, over the ground."""
        return math.hypot(place_m[0] - self.x_m, place_m[1] - self.y_m)


def frame_id(computer: str, booted_s: float) -> str:
    """Return the identity of the life of an autopilot's local frame.

    Args:
        computer: Identity of the boot of the drone's own computer.
        booted_s: When the autopilot booted, by the clock that the computer counts from its own boot; in seconds.
    """
    return f"{computer} {booted_s:.1f}"


def is_same_frame(one: str, other: str) -> bool:
    """Return whether two identities of `frame_id` are of one life of the frame."""
    (computer, _, booted), (other_computer, _, other_booted) = one.rpartition(" "), other.rpartition(" ")
    try:
        return computer == other_computer and abs(float(booted) - float(other_booted)) < _SAME_BOOT_S
    except ValueError:
        return False


def settled(recorded: FlightOrigin | None, start: FlightOrigin) -> FlightOrigin:
    """Return the origin of a flight in the frame of its start.

    A recorded origin keeps its heading. Where both places are known in degrees, these give its position in the frame
    of the start; without them the frame must be the one of the first start.

    Args:
        recorded: The origin of the trial; None for its first start, which becomes the origin.
        start: Place and heading of the drone now.

    Raises:
        OriginError: The drone is more than `START_M` from the origin, or it is not known how far.
    """
    if recorded is None:
        return start
    north_m, east_m = start.x_m - recorded.x_m, start.y_m - recorded.y_m
    degrees = recorded.latitude_deg, recorded.longitude_deg, start.latitude_deg, start.longitude_deg
    if None not in degrees:
        latitude, longitude, start_latitude, start_longitude = (float(value or 0.0) for value in degrees)
        north_m = (start_latitude - latitude) * _DEGREE_M
        turn = math.remainder(start_longitude - longitude, 360.0)
        east_m = turn * _DEGREE_M * math.cos(math.radians(latitude))
    elif not is_same_frame(recorded.frame_id, start.frame_id):
        raise OriginError(
            "its autopilot has rebooted since the first flight of this trial, and latitude and longitude of its "
            "place are not known: wait for GPS, or begin a new trial with the drone at its place"
        )
    if (off_m := math.hypot(north_m, east_m)) > START_M:
        bearing_deg = math.degrees(math.atan2(east_m, north_m)) % 360
        raise OriginError(
            f"it is {off_m:.1f} m from the place where its first flight of this trial began, at a bearing of "
            f"{bearing_deg:.0f} degrees; at most {START_M:g} m are allowed: carry it back"
        )
    return FlightOrigin(
        start.frame,
        start.frame_id,
        start.x_m - north_m,
        start.y_m - east_m,
        recorded.heading_rad,
        recorded.latitude_deg,
        recorded.longitude_deg,
    )


@dataclass(frozen=True)
class FlightFence:
    """A cylinder around the origin in which a drone flies.

    Attributes:
        origin: The centre.
        ground_m: Position of the ground, down.
        radius_m: The radius.
        ceiling_m: The height over the ground.
    """

    origin: FlightOrigin
    ground_m: float
    radius_m: float
    ceiling_m: float

    def clamped(self, place_m: Place) -> Place:
        """Return the nearest point inside the fence, straight towards its axis and vertically."""
        share = min(1.0, self.radius_m / max(self.origin.off_m(place_m), 1e-9))
        return (
            self.origin.x_m + share * (place_m[0] - self.origin.x_m),
            self.origin.y_m + share * (place_m[1] - self.origin.y_m),
            min(max(place_m[2], self.ground_m - self.ceiling_m), self.ground_m),
        )

    def breach(self, place_m: Place) -> str:
        """Return how a reported position is beyond the fence and `FENCE_MARGIN_M`; empty where it is not."""
        for value_m, most_m, what in (
            (self.origin.off_m(place_m), self.radius_m, "from its origin"),
            (self.ground_m - place_m[2], self.ceiling_m, "high"),
        ):
            if value_m > most_m + FENCE_MARGIN_M:
                return f"it is {value_m:.1f} m {what}, and its fence ends at {most_m:g} m"
        return ""
