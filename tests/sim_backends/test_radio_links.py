"""From options and places to link parameters."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit import config
from fieldkit.errors import ConfigurationError
from fieldkit.profiles import Radio
from sim_backends.radio import pathloss
from sim_backends.radio.links import Station, link_parameters, mesh, stations_of
from sim_backends.radio.options import RadioOptions

RADIO = Radio(interface="wlan0", standard="802.11g", tx_power_dbm=17, sensitivity_dbm=-82)
FOOT_M = 0.3048


def options(text: str) -> RadioOptions:
    return config.validate(config.parse(text, source="radio.yaml"), RadioOptions)


def station(east_m: float, *, behind_wall: bool = False) -> Station:
    return Station(RADIO, (east_m, 0.0, 0.0), behind_wall)


def test_empty_options_are_valid() -> None:
    assert options("{}") == RadioOptions()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("loss: 101%", "less than or equal to 1"),
        ("rate: fast", "unlimited"),
        ("rate: 0Mbit/s", "below 1bit/s"),
        ("delay: 5", "has no unit"),
        ("los: 10%", "did you mean 'loss'"),
        ("queue_packets: -1", "greater than or equal to 0"),
    ],
)
def test_wrong_options_say_what_is_wrong(text: str, said: str) -> None:
    with pytest.raises(ConfigurationError, match=said) as caught:
        options(text)
    assert caught.value.where == "radio.yaml:1"


def test_reference_loss_is_free_space_at_one_metre() -> None:
    friis_db = 20 * math.log10(4 * math.pi * 2.437e9 / pathloss.SPEED_OF_LIGHT_M_S)
    assert RadioOptions().reference_loss_db == pytest.approx(friis_db, abs=0.05)


def test_wall_loss_is_a_concrete_wall() -> None:
    permittivity, conductivity = 5.31, 0.0326 * 2.437**0.8095
    absorbed_db = 0.2 * 1636 * conductivity / math.sqrt(permittivity)
    index = math.sqrt(permittivity)
    reflected_db = -20 * math.log10(1 - ((index - 1) / (index + 1)) ** 2)
    assert RadioOptions().wall_loss_db == pytest.approx(absorbed_db + reflected_db, abs=0.5)


def test_log_distance_adds_ten_n_per_decade_and_nothing_nearer_than_a_metre() -> None:
    def loss_db(distance_m: float) -> float:
        return pathloss.log_distance_loss_db(distance_m, exponent=3.0, reference_loss_db=40.0)

    assert loss_db(10.0) == pytest.approx(70.0)
    assert loss_db(0.0) == loss_db(1.0) == pytest.approx(40.0)


@pytest.mark.parametrize(
    ("margin_db", "rate_bit_s"),
    [(-0.1, None), (0.0, 6_000_000), (4.9, 12_000_000), (16.9, 48_000_000), (17.0, 54_000_000)],
)
def test_bit_rate_follows_the_sensitivity_table(margin_db: float, rate_bit_s: int | None) -> None:
    assert pathloss.bit_rate_bit_s(margin_db) == rate_bit_s


def test_noise_raises_the_threshold_above_the_sensitivity() -> None:
    assert pathloss.threshold_dbm(sensitivity_dbm=-82.0, noise_floor_dbm=-95.0) == -82.0
    assert pathloss.threshold_dbm(sensitivity_dbm=-82.0, noise_floor_dbm=-70.0) == -61.0


def test_a_tenth_of_1000_byte_packets_is_lost_at_the_threshold() -> None:
    assert 1 - (1 - pathloss.bit_error_rate(0.0)) ** 8000 == pytest.approx(0.1, rel=1e-4)
    assert pathloss.bit_error_rate(10.0) == pytest.approx(pathloss.bit_error_rate(0.0) / 10)


def test_thirty_feet_in_sight_lose_next_to_nothing_and_far_behind_the_wall_something() -> None:
    near = link_parameters(RadioOptions(), station(0), station(30 * FOOT_M))
    far = link_parameters(RadioOptions(), station(0, behind_wall=True), station(55 * FOOT_M))
    assert near.rate_bit_s == 54_000_000
    assert near.packet_loss(1500) < 0.001
    assert 0.005 < far.packet_loss(1500) < 0.05
    assert far.rate_bit_s is not None
    assert far.rate_bit_s < 54_000_000


@given(nearer_m=st.floats(1, 500), further_m=st.floats(1, 500))
def test_going_away_never_makes_a_link_better(nearer_m: float, further_m: float) -> None:
    nearer_m, further_m = sorted((nearer_m, further_m))
    near, far = (link_parameters(RadioOptions(), station(0), station(at_m)) for at_m in (nearer_m, further_m))
    assert near.packet_loss(1500) <= far.packet_loss(1500)
    assert (near.rate_bit_s or 0) >= (far.rate_bit_s or 0)
    assert near.delay_ns <= far.delay_ns


def test_a_wall_is_between_when_exactly_one_end_is_behind_it() -> None:
    def margin(one: bool, other: bool) -> float:
        link = link_parameters(RadioOptions(), station(0, behind_wall=one), station(15, behind_wall=other))
        return link.bit_error_rate

    assert margin(True, True) == margin(False, False)
    assert margin(True, False) == margin(False, True)
    assert margin(True, False) == pytest.approx(margin(False, False) * 10**1.1)


def test_out_of_range_everything_is_lost() -> None:
    link = link_parameters(RadioOptions(), station(0), station(1000))
    assert link.packet_loss(1) == 1.0
    assert link.rate_bit_s == 6_000_000


def test_given_values_replace_the_models_on_every_link() -> None:
    said = options("{loss: 10%, delay: 5ms, jitter: 1ms, rate: 20Mbit/s, queue_packets: 7}")
    link = link_parameters(said, station(0), station(1000))
    assert [link.packet_loss(64), link.packet_loss(1500)] == pytest.approx([0.1, 0.1])
    assert (link.delay_ns, link.jitter_ns, link.rate_bit_s, link.queue_packets) == (
        5_000_000,
        1_000_000,
        20_000_000,
        7,
    )
    assert link_parameters(options("rate: unlimited"), station(0), station(9)).rate_bit_s is None


def test_modelled_delay_is_processing_and_light() -> None:
    link = link_parameters(options("processing: 1ms"), station(0), station(299.792458))
    assert link.delay_ns == 1_001_000


def test_mesh_has_both_directions_of_every_pair() -> None:
    strong = RADIO.model_copy(update={"tx_power_dbm": 27})
    stations = stations_of(
        {"a": strong, "b": RADIO, "c": RADIO},
        {"a": (0.0, 0.0, 0.0), "b": (60.0, 0.0, 0.0), "c": (0.0, 0.0, 5.0)},
        {"b"},
    )
    links = mesh(RadioOptions(), stations)
    assert set(links) == {("a", "b"), ("b", "a"), ("a", "c"), ("c", "a"), ("b", "c"), ("c", "b")}
    assert links["a", "b"].packet_loss(1500) < links["b", "a"].packet_loss(1500)
