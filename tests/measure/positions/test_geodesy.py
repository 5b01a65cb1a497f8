"""Places on the earth against PROJ, which computes with other formulas."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import Geod, Transformer

from fieldkit.measure.positions.geodesy import ecef_m

EARTH = Geod(ellps="WGS84")
TO_CENTRE = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
LATITUDES = st.floats(-90, 90)
LONGITUDES = st.floats(-180, 180)


@given(LATITUDES, LONGITUDES, st.floats(0, 360), st.floats(0, 1000))
def test_over_a_kilometre_it_is_the_geodesic_to_below_a_millimetre(
    latitude: float, longitude: float, azimuth: float, far_m: float
) -> None:
    to_longitude, to_latitude, _ = EARTH.fwd(longitude, latitude, azimuth, far_m)
    one, other = ecef_m(np.array([latitude, to_latitude]), np.array([longitude, to_longitude]), np.zeros(2))
    assert np.linalg.norm(other - one) == pytest.approx(far_m, abs=1e-4)


@given(LATITUDES, LONGITUDES, st.floats(-500, 10_000))
def test_heights_count_as_proj_counts_them(latitude: float, longitude: float, height_m: float) -> None:
    (found,) = ecef_m(np.array([latitude]), np.array([longitude]), np.array([height_m]))
    assert found == pytest.approx(TO_CENTRE.transform(longitude, latitude, height_m), abs=1e-6)
