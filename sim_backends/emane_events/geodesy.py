"""Conversions between positions east, north and up of a reference point and geodetic positions (WGS 84, TR8350.2)."""

import math
from typing import Final

from fieldkit.core.model import Vector
from sim_backends.emane_events.events import EmaneVelocity

_A_M: Final = 6_378_137.0
_F: Final = 1 / 298.257223563
_E2: Final = _F * (2 - _F)
"""Semi-major axis, flattening and squared eccentricity of the ellipsoid."""
_CONVERGED_RAD: Final = 1e-15
_ITERATIONS: Final = 20
"""The computation of a latitude ends when the latitude changes by less than this angle, or after 20 iterations."""

Geodetic = tuple[float, float, float]
"""Latitude and longitude in degrees, height above the ellipsoid in metres."""


class LocalFrame:
    """The tangent plane at a reference point.

    Args:
        reference: The point, which has the position (0, 0, 0).
    """

    def __init__(self, reference: Geodetic) -> None:
        latitude, longitude = math.radians(reference[0]), math.radians(reference[1])
        sin_lat, cos_lat = math.sin(latitude), math.cos(latitude)
        sin_lon, cos_lon = math.sin(longitude), math.cos(longitude)
        self._origin_m = _ecef_m(latitude, longitude, reference[2])
        # Unit vectors east, north and up, in earth-centred, earth-fixed coordinates (ECEF).
        self._axes = (
            (-sin_lon, cos_lon, 0.0),
            (-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat),
            (cos_lat * cos_lon, cos_lat * sin_lon, sin_lat),
        )

    def geodetic(self, position_m: Vector) -> Geodetic:
        """Return the geodetic position of a position east, north, up."""
        x, y, z = (
            self._origin_m[axis]
            + sum(metres * local_axis[axis] for metres, local_axis in zip(position_m, self._axes, strict=True))
            for axis in range(3)
        )
        axis_distance_m = math.hypot(x, y)
        latitude = math.atan2(z, axis_distance_m * (1 - _E2))
        for _ in range(_ITERATIONS):
            radius_m = _A_M / math.sqrt(1 - _E2 * math.sin(latitude) ** 2)  # of curvature in the prime vertical
            previous, latitude = latitude, math.atan2(z + _E2 * radius_m * math.sin(latitude), axis_distance_m)
            if abs(latitude - previous) < _CONVERGED_RAD:
                break
        sin, cos = math.sin(latitude), math.cos(latitude)
        # This formula is valid at the poles as well as at the equator.
        height_m = axis_distance_m * cos + z * sin - _A_M * math.sqrt(1 - _E2 * sin * sin)
        return math.degrees(latitude), math.degrees(math.atan2(y, x)), height_m

    def position_m(self, position: Geodetic) -> Vector:
        """Return the position east, north, up of a geodetic position."""
        ecef_m = _ecef_m(math.radians(position[0]), math.radians(position[1]), position[2])
        offset_m = [metres - origin_m for metres, origin_m in zip(ecef_m, self._origin_m, strict=True)]
        east_m, north_m, up_m = (
            sum(metres * component for metres, component in zip(offset_m, axis, strict=True)) for axis in self._axes
        )
        return east_m, north_m, up_m


def _ecef_m(latitude_rad: float, longitude_rad: float, height_m: float) -> Vector:
    """Return the earth-centred, earth-fixed coordinates of a geodetic position, in metres."""
    sin, cos = math.sin(latitude_rad), math.cos(latitude_rad)
    radius_m = _A_M / math.sqrt(1 - _E2 * sin * sin)  # of curvature in the prime vertical
    axis_distance_m = (radius_m + height_m) * cos
    return (
        axis_distance_m * math.cos(longitude_rad),
        axis_distance_m * math.sin(longitude_rad),
        (radius_m * (1 - _E2) + height_m) * sin,
    )


def emane_velocity(velocity_m_s: Vector) -> EmaneVelocity:
    """Return a velocity east, north, up as azimuth, elevation and magnitude."""
    east, north, up = velocity_m_s
    return EmaneVelocity(
        math.degrees(math.atan2(east, north)) % 360,
        math.degrees(math.atan2(up, math.hypot(east, north))),
        math.hypot(east, north, up),
    )


def velocity_m_s(velocity: EmaneVelocity) -> Vector:
    """Return a velocity as metres per second east, north, up."""
    azimuth, elevation = math.radians(velocity.azimuth_deg), math.radians(velocity.elevation_deg)
    horizontal_m_s = velocity.speed_m_s * math.cos(elevation)
    return (
        horizontal_m_s * math.sin(azimuth),
        horizontal_m_s * math.cos(azimuth),
        velocity.speed_m_s * math.sin(elevation),
    )
