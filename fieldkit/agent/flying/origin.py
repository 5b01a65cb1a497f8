"""The origin of a trial's flights, which is the position and heading of the first start, and the fence around it.

All directions and distances of a plan are relative to the origin, so that each repeat flies the same path, regardless
of the drone's initial heading. The origin is a position in LOCAL_POSITION_NED, whose frame is valid until the
autopilot reboots. With latitude and longitude, if they are known, the position is converted to the frame of a later
start.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Mapping, Tuple

Position = Tuple[float, float, float]
"""North, east, down, in metres."""

FRAME = "local"
"""Name of the frame of LOCAL_POSITION_NED in an origin."""
START_M = 2.0
"""Maximum horizontal distance between the start of a flight and its origin."""
FENCE_MARGIN_M = 2.0
"""Tolerance of the fence for overshoot and errors of the position estimate."""
_METRES_PER_DEGREE = 111_318.84502145034
"""Metres per degree of latitude (ArduPilot, AP_Common/Location.h, LOCATION_SCALING_FACTOR)."""
_SAME_BOOT_S = 10.0
"""Maximum difference between two estimates of one boot time, because the clocks of autopilot and computer drift."""


class OriginError(Exception):
    """A flight must not start at this position; the text is for the operator."""


@dataclass(frozen=True)
class FlightOrigin:
    """Position and heading of a drone at its first start in a trial. The fields are the same as in `MotionOrigin`.

    Attributes:
        frame: `FRAME`.
        frame_id: Identifies the frame until the autopilot reboots; see the function `frame_id`.
        x_m: Position north.
        y_m: Position east.
        heading_rad: Heading, clockwise from north.
        latitude_deg: Latitude; None if unknown.
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
    def from_values(cls, values: Mapping[str, Any]) -> FlightOrigin:
        """Return the origin from the values in a plan, whose keys are the field names."""
        return cls(**{name: values.get(name) for name in cls.__dataclass_fields__})  # type: ignore[arg-type]

    def position_at(self, ahead_m: float, left_m: float, down_m: float) -> Position:
        """Return the position of a point. `ahead_m` and `left_m` are relative to the origin; `down_m` is absolute."""
        cos, sin = math.cos(self.heading_rad), math.sin(self.heading_rad)
        north_m, east_m = self.x_m + ahead_m * cos + left_m * sin, self.y_m + ahead_m * sin - left_m * cos
        return north_m, east_m, down_m

    def relative_m(self, position_m: Position) -> tuple[float, float]:
        """Return the distances of a position ahead of the origin, and to its left, in metres."""
        north_m, east_m = position_m[0] - self.x_m, position_m[1] - self.y_m
        cos, sin = math.cos(self.heading_rad), math.sin(self.heading_rad)
        return north_m * cos + east_m * sin, north_m * sin - east_m * cos

    def distance_m(self, position_m: Position) -> float:
        """Return the horizontal distance of a position from the origin."""
        return math.hypot(position_m[0] - self.x_m, position_m[1] - self.y_m)


def frame_id(computer: str, boot_time_s: float) -> str:
    """Return the identifier of an autopilot's local frame, which is valid until the autopilot reboots.

    Args:
        computer: Boot ID of the drone's computer.
        boot_time_s: Boot time of the autopilot by CLOCK_BOOTTIME of the computer, in seconds.
    """
    return f"{computer} {boot_time_s:.1f}"


def is_same_frame(identifier: str, other_identifier: str) -> bool:
    """Return True if two identifiers from `frame_id` denote the same frame: the autopilot has not rebooted."""
    (computer, _, boot_time), (other_computer, _, other_boot_time) = (
        identifier.rpartition(" "),
        other_identifier.rpartition(" "),
    )
    try:
        return computer == other_computer and abs(float(boot_time) - float(other_boot_time)) < _SAME_BOOT_S
    except ValueError:
        return False


def resolve_origin(recorded_origin: FlightOrigin | None, start: FlightOrigin) -> FlightOrigin:
    """Return the origin of a flight in the frame of its start.

    The heading of the recorded origin is kept. If latitude and longitude of both positions are known, the position of
    the origin in the frame of the start is computed from them. Otherwise, the frame must be the same as at the first
    start.

    Args:
        recorded_origin: The origin of the trial; None for its first start, which becomes the origin.
        start: Current position and heading of the drone.

    Raises:
        OriginError: The drone is more than `START_M` from the origin, or its distance from the origin is unknown.
    """
    if recorded_origin is None:
        return start
    north_m, east_m = start.x_m - recorded_origin.x_m, start.y_m - recorded_origin.y_m
    coordinates = recorded_origin.latitude_deg, recorded_origin.longitude_deg, start.latitude_deg, start.longitude_deg
    if None not in coordinates:
        latitude, longitude, start_latitude, start_longitude = (float(value or 0.0) for value in coordinates)
        north_m = (start_latitude - latitude) * _METRES_PER_DEGREE
        longitude_difference = math.remainder(start_longitude - longitude, 360.0)
        east_m = longitude_difference * _METRES_PER_DEGREE * math.cos(math.radians(latitude))
    elif not is_same_frame(recorded_origin.frame_id, start.frame_id):
        raise OriginError(
            "its autopilot has rebooted since the first flight of this trial, and latitude and longitude of its "
            "origin are not known: wait for GPS, or put the drone at its start position and start a new trial"
        )
    if (distance_m := math.hypot(north_m, east_m)) > START_M:
        bearing_deg = math.degrees(math.atan2(east_m, north_m)) % 360
        raise OriginError(
            f"it is {distance_m:.1f} m from the place where its first flight of this trial started, at a bearing of "
            f"{bearing_deg:.0f} degrees; at most {START_M:g} m are allowed: carry it back"
        )
    return FlightOrigin(
        start.frame,
        start.frame_id,
        start.x_m - north_m,
        start.y_m - east_m,
        recorded_origin.heading_rad,
        recorded_origin.latitude_deg,
        recorded_origin.longitude_deg,
    )


@dataclass(frozen=True)
class FlightFence:
    """A cylinder around the origin that a drone must not leave.

    Attributes:
        origin: The centre.
        ground_m: Down coordinate of the ground.
        radius_m: The radius.
        ceiling_m: The height over the ground.
    """

    origin: FlightOrigin
    ground_m: float
    radius_m: float
    ceiling_m: float

    def clamped(self, position_m: Position) -> Position:
        """Return the nearest point inside the fence."""
        scale = min(1.0, self.radius_m / max(self.origin.distance_m(position_m), 1e-9))
        return (
            self.origin.x_m + scale * (position_m[0] - self.origin.x_m),
            self.origin.y_m + scale * (position_m[1] - self.origin.y_m),
            min(max(position_m[2], self.ground_m - self.ceiling_m), self.ground_m),
        )

    def breach(self, position_m: Position) -> str:
        """Return the reason if a position is more than `FENCE_MARGIN_M` outside the fence, else an empty string."""
        for distance_m, limit_m, direction in (
            (self.origin.distance_m(position_m), self.radius_m, "from its origin"),
            (self.ground_m - position_m[2], self.ceiling_m, "above the ground"),
        ):
            if distance_m > limit_m + FENCE_MARGIN_M:
                return f"it is {distance_m:.1f} m {direction}, and its fence ends at {limit_m:g} m"
        return ""
