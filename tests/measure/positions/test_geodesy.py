"""Conversion of coordinates compared with PROJ, which uses different formulas."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import Geod, Transformer

from fieldkit.measure.positions.samples import ecef_m

EARTH = Geod(ellps="WGS84")
TO_CENTRE = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
LATITUDES = st.floats(-90, 90)
LONGITUDES = st.floats(-180, 180)


@given(LATITUDES, LONGITUDES, st.floats(0, 360), st.floats(0, 1000))
def test_distances_up_to_a_kilometre_equal_the_geodesic_within_a_millimetre(
    latitude: float, longitude: float, azimuth: float, distance_m: float
) -> None:
    to_longitude, to_latitude, _ = EARTH.fwd(longitude, latitude, azimuth, distance_m)
    start, end = ecef_m(np.array([latitude, to_latitude]), np.array([longitude, to_longitude]), np.zeros(2))
    assert np.linalg.norm(end - start) == pytest.approx(distance_m, abs=1e-4)


@given(LATITUDES, LONGITUDES, st.floats(-500, 10_000))
def test_coordinates_with_heights_equal_those_of_proj(latitude: float, longitude: float, height_m: float) -> None:
    (position_m,) = ecef_m(np.array([latitude]), np.array([longitude]), np.array([height_m]))
    assert position_m == pytest.approx(TO_CENTRE.transform(longitude, latitude, height_m), abs=1e-6)
