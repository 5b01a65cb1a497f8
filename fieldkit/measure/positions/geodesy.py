"""Conversion of WGS 84 coordinates to metres."""

from typing import Final

import numpy as np

from fieldkit.measure.captures.arrays import Floats

SEMI_MAJOR_M: Final = 6_378_137.0
"""Semi-major axis of the ellipsoid (NIMA TR8350.2, table 3.1)."""
FLATTENING: Final = 1 / 298.257223563
"""Flattening of the ellipsoid (the same table)."""

_ECCENTRICITY_2: Final = FLATTENING * (2 - FLATTENING)


def ecef_m(latitude_deg: Floats, longitude_deg: Floats, height_m: Floats) -> Floats:
    """Return earth-centred, earth-fixed coordinates in metres (ECEF; TR8350.2, equation 4-14).

    The straight line between two such points has its true length. Over 1 km it is 1 um shorter than the path along
    the ground: d^3 / 24 R^2.

    Args:
        latitude_deg: Degrees north. Shape (n,).
        longitude_deg: Degrees east. Shape (n,).
        height_m: Metres above the ellipsoid. Shape (n,).

    Returns:
        Shape (n, 3).
    """
    latitude, longitude = np.radians(latitude_deg), np.radians(longitude_deg)
    prime_vertical_m = SEMI_MAJOR_M / np.sqrt(1 - _ECCENTRICITY_2 * np.sin(latitude) ** 2)
    from_axis_m = (prime_vertical_m + height_m) * np.cos(latitude)
    return np.column_stack(
        (
            from_axis_m * np.cos(longitude),
            from_axis_m * np.sin(longitude),
            ((1 - _ECCENTRICITY_2) * prime_vertical_m + height_m) * np.sin(latitude),
        )
    )
