"""Antenna patterns, compared with closed forms, an integral over the sphere and scipy's rotations."""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest
import scipy
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fieldkit.config.antennas import AntennaOptions
from fieldkit.config.profiles import Radio
from fieldkit.core.model import Vector
from sim_backends.cosim.scenario.schema import AgentRadio
from sim_backends.network.packets import Packet
from sim_backends.network.radio import RadioNetwork
from sim_backends.radio.antennas import Antenna, antenna_of, decode_antenna
from sim_backends.radio.models.radio_model import WifiInWorld
from sim_backends.radio.propagation.antenna_patterns import (
    NULL_DBI,
    AntennaPattern,
    Dipole,
    GainTable,
    pattern_of,
    rotation,
)
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.radio.world_channel import WorldChannel
from sim_backends.world.motion import Attitude, State

UPRIGHT = Dipole((0.0, 0.0, 1.0))
PEAK_DBI = 2.15
ANGLE = st.floats(-math.pi, math.pi)
LEVEL_TO_THE_EAST = Attitude()
FREE_SPACE = RadioOptions(propagation="free-space", fading=False)


def direction(elevation_deg: float, azimuth_deg: float = 0.0) -> np.ndarray[Any, np.dtype[np.float64]]:
    elevation, azimuth = math.radians(elevation_deg), math.radians(azimuth_deg)
    return np.array(
        [[math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]]
    )


def gain_dbi(pattern: AntennaPattern, elevation_deg: float, azimuth_deg: float = 0.0) -> float:
    return float(pattern.gains_dbi(direction(elevation_deg, azimuth_deg))[0])


def test_a_half_wave_dipole_has_the_gain_and_beam_width_of_textbooks() -> None:
    assert gain_dbi(UPRIGHT, 0.0, 77.0) == pytest.approx(PEAK_DBI, abs=0.005)
    # Balanis, Antenna Theory, 4.6: the half-power beam width is 78 degrees.
    assert gain_dbi(UPRIGHT, 39.0) == pytest.approx(PEAK_DBI - 3.0, abs=0.03)
    assert gain_dbi(UPRIGHT, 90.0) == NULL_DBI


def test_a_dipole_without_losses_radiates_the_power_that_it_receives() -> None:
    """The mean gain over the sphere is 1."""

    def ring(elevation_rad: float) -> float:
        return math.cos(elevation_rad) * math.pow(10, gain_dbi(UPRIGHT, math.degrees(elevation_rad)) / 10)

    mean = scipy.integrate.quad(ring, -math.pi / 2, math.pi / 2)[0] / 2
    assert mean == pytest.approx(1.0, abs=1e-3)


@given(ANGLE, ANGLE, ANGLE)
def test_rotations_equal_those_of_scipy(yaw_rad: float, pitch_rad: float, roll_rad: float) -> None:
    expected = Rotation.from_euler("ZYX", (yaw_rad, pitch_rad, roll_rad)).as_matrix()
    assert rotation(Attitude(yaw_rad, pitch_rad, roll_rad)) == pytest.approx(expected, abs=1e-12)


@given(st.floats(-65, 65), st.floats(-720, 720))
def test_a_table_of_a_dipole_has_the_gains_of_the_dipole(elevation_deg: float, azimuth_deg: float) -> None:
    """Up to 65 degrees, linear interpolation over 5 degrees differs by at most 0.06 dB."""
    elevations_deg = tuple(float(angle) for angle in range(-90, 91, 5))
    dipole = Dipole((0.0, -1.0, 1.0))
    azimuths_deg = tuple(float(angle) for angle in range(-180, 180, 5))
    table_dbi = tuple(tuple(gain_dbi(UPRIGHT, angle, other) for other in azimuths_deg) for angle in elevations_deg)
    table = GainTable(elevations_deg, azimuths_deg, table_dbi, (0.0, 0.0, 0.0))
    assert gain_dbi(table, elevation_deg, azimuth_deg) == pytest.approx(gain_dbi(UPRIGHT, elevation_deg), abs=0.06)
    # Rolled by 45 degrees to the right, its wire points to the right and up.
    rolled = GainTable(elevations_deg, azimuths_deg, table_dbi, (45.0, 0.0, 0.0))
    for elevation in (0.0, 80.0):
        assert gain_dbi(rolled, elevation, 90.0) == pytest.approx(gain_dbi(dipole, elevation, 90.0), abs=0.06)


def test_gains_between_the_columns_of_a_table_are_interpolated_over_a_full_turn() -> None:
    table = GainTable((0.0,), (-90.0, 0.0, 90.0), ((1.0, 5.0, 3.0),), (0.0, 0.0, 0.0))
    gains_dbi = [gain_dbi(table, 30.0, azimuth) for azimuth in (0.0, 45.0, 90.0, 180.0, -135.0, 225.0)]
    assert gains_dbi == pytest.approx([5.0, 4.0, 3.0, 2.0, 1.5, 1.5])
    turned = GainTable((0.0,), (-90.0, 0.0, 90.0), ((1.0, 5.0, 3.0),), (0.0, 0.0, 90.0))
    assert gain_dbi(turned, 0.0, 90.0) == pytest.approx(5.0), "the antenna faces left"


def channel_of(pattern: Dipole | GainTable | None, options: RadioOptions = FREE_SPACE) -> WorldChannel:
    antennas = {"drone": Antenna("802.11g", 15.0, -90.0, pattern=pattern), "base": Antenna("802.11g", 15.0, -90.0)}
    return WorldChannel(1, antennas, options)


def snr_db(channel: WorldChannel, drone_m: Vector, attitude: Attitude = LEVEL_TO_THE_EAST) -> float:
    channel.move(0, {"drone": drone_m, "base": (0.0, 0.0, 1.0)}, attitudes={"drone": attitude})
    assert channel.snr_db(0, 1) == channel.snr_db(1, 0), "gains are the same in both directions"
    return channel.snr_db(0, 1)


@given(st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(3, 50)), st.builds(Attitude, ANGLE, ANGLE, ANGLE))
def test_the_attitude_of_a_drone_turns_its_dipole(place_m: Vector, attitude: Attitude) -> None:
    """The angle between the turned wire and the path determines the gain."""
    wire = Rotation.from_euler("ZYX", attitude).apply((0.0, 0.0, 1.0))
    east_m, north_m, up_m = place_m
    path_m = np.array((-east_m, -north_m, 1.0 - up_m))
    angle_rad = math.acos(max(-1.0, min(float(wire @ path_m) / math.hypot(*path_m), 1.0)))
    numerator, sine = math.cos(math.pi / 2 * math.cos(angle_rad)), math.sin(angle_rad)
    gain = 0.0 if sine < 1e-5 else 1.6409 * (numerator / sine) ** 2
    expected_db = max(10 * math.log10(max(gain, 1e-9)), NULL_DBI)
    difference_db = snr_db(channel_of(UPRIGHT), place_m, attitude) - snr_db(channel_of(None), place_m)
    assert difference_db == pytest.approx(expected_db, abs=0.01)


def test_a_pattern_acts_on_the_direct_path_and_echoes_arrive_from_all_horizontal_directions() -> None:
    options = FREE_SPACE.model_copy(update={"fading": True})
    k, horizontal = 10 ** (options.k_db / 10), 1.6409
    for elevation_deg in (0.0, 45.0, 90.0):
        east_m, _, up_m = (30 * direction(elevation_deg)[0]).tolist()
        place_m = east_m, 0.0, up_m + 1.0
        direct = 10 ** (gain_dbi(UPRIGHT, elevation_deg) / 10)
        gain_db = 10 * math.log10((k * direct + horizontal) / (k + 1))
        difference_db = snr_db(channel_of(UPRIGHT, options), place_m) - snr_db(channel_of(None, options), place_m)
        assert difference_db == pytest.approx(gain_db, abs=0.002)


def test_stations_keep_an_attitude_that_is_not_given() -> None:
    channel = channel_of(UPRIGHT)
    tilted_db = snr_db(channel, (30.0, 0.0, 1.0), Attitude(pitch_rad=1.2))
    channel.move(0, {"drone": (0.0, 30.0, 1.0), "base": (0.0, 0.0, 1.0)})
    assert channel.snr_db(0, 1) == pytest.approx(snr_db(channel_of(None), (30.0, 0.0, 1.0)) + PEAK_DBI, abs=0.01)
    channel.move(0, {"drone": (30.0, 0.0, 1.0), "base": (0.0, 0.0, 1.0)})
    assert channel.snr_db(0, 1) == tilted_db


def test_the_network_of_the_cosimulation_passes_the_attitude_of_each_state() -> None:
    horn = GainTable((0.0,), (-90.0, 0.0, 90.0, 180.0), ((0.0, 10.0, 0.0, -10.0),), (0.0, 0.0, 0.0))
    antennas = {"drone": Antenna("802.11g", 15.0, -90.0, pattern=horn), "base": Antenna("802.11g", 15.0, -90.0)}
    radio: WifiInWorld[Any] = WifiInWorld(1, FREE_SPACE, antennas, None)
    network = RadioNetwork(radio, tuple(antennas))
    signals_dbm = []
    radio.use_meter()
    for number, heading_rad in enumerate((0.0, math.pi, None)):
        states = {"drone": State((-30.0, 0.0, 1.0), (0.0, 0.0, 0.0), heading_rad), "base": State((0.0, 0.0, 1.0))}
        at_ns = number * 10**9
        packet = Packet(number, "drone", "base", 100, ("flow", number), at_ns, at_ns)
        network.advance(at_ns + 10**8, [packet], states)
        signals_dbm.append(radio.sample(at_ns + 10**8, 0)["base"].stations[0].signal_dbm or 0.0)
    assert np.diff(signals_dbm) == pytest.approx([-20.0, 0.0], abs=1.0), "without a heading the robot keeps its yaw"


def table(**changes: object) -> dict[str, object]:
    return {"pattern": "table", "elevations_deg": [-90, 90], "gains_dbi": [[-3], [2.5]], **changes}


RADIO = {"interface": "wlan0", "standard": "802.11n 2.4 GHz", "tx_power_dbm": 15, "sensitivity_dbm": -90}


@pytest.mark.parametrize(
    "antenna", [{"pattern": "dipole", "axis": [1, 0, 0.5]}, table(), {"pattern": "isotropic"}], ids=json.dumps
)
def test_the_antenna_of_a_profile_survives_its_encodings(antenna: Mapping[str, object]) -> None:
    radio = Radio.model_validate({**RADIO, "antenna": antenna})
    assert Radio.model_validate(radio.model_dump(mode="json")) == radio
    stations = antenna_of(radio)
    assert decode_antenna(json.loads(json.dumps(asdict(stations)))) == stations
    assert antenna_of(AgentRadio.model_validate({"antenna": antenna})).pattern == stations.pattern
    assert hash(stations) == hash(antenna_of(radio))
    assert (stations.pattern is None) == (antenna["pattern"] == "isotropic")


@pytest.mark.parametrize(
    ("antenna", "message"),
    [
        ({"pattern": "dipole", "axis": [0, 0, 0]}, "the axis has no direction"),
        ({"axis": [1, 0, 0]}, "the pattern isotropic has no axis"),
        (table(axis=[1, 0, 0]), "the pattern table has no axis"),
        ({"pattern": "table"}, "needs elevations_deg and gains_dbi"),
        (table(elevations_deg=[10, -10]), "elevations_deg must be ascending"),
        (table(azimuths_deg=[0, 360]), "within one turn"),
        (table(azimuths_deg=[0, 90]), r"2 rows \(elevations_deg\) with 2 gains"),
        (table(elevations_deg=[0]), "1 rows"),
    ],
)
def test_an_invalid_antenna_is_refused(antenna: Mapping[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        AntennaOptions.model_validate(antenna)


def test_an_isotropic_antenna_has_no_pattern_and_no_cost() -> None:
    assert pattern_of(None) is pattern_of(AntennaOptions()) is None
    assert not WifiInWorld(1, FREE_SPACE, {"a": Antenna("802.11g", 15.0, -90.0)}, None).uses_attitudes
