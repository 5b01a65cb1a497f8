"""Keys of the physical layer of a radio in robot profiles: valid combinations, and errors for other combinations."""

import re

import pytest
from pydantic import ValidationError

from fieldkit.config.profiles import Radio
from sim_backends.radio.antennas import antenna_of


def radio(standard: str, **phy: int) -> Radio:
    return Radio.model_validate(
        {"interface": "wlan0", "standard": standard, "tx_power_dbm": 17, "sensitivity_dbm": -82, "phy": phy}
    )


@pytest.mark.parametrize(
    ("standard", "phy", "message"),
    [
        ("802.11n 2.4 GHz", {"guard_interval_ns": 1600}, "802.11n has no guard interval of 1600 ns"),
        ("802.11ax 5 GHz", {"guard_interval_ns": 400}, "802.11ax has no guard interval of 400 ns"),
        ("802.11ax 5 GHz", {"width_mhz": 160}, "a width of 160 MHz is not modelled; write 20, 40 or 80"),
        ("802.11n 5 GHz", {"width_mhz": 80}, "802.11n 5 GHz has no width of 80 MHz; write phy.width_mhz: 20 or 40"),
        ("802.11ax 2.4 GHz", {"width_mhz": 80}, "802.11ax 2.4 GHz has no width of 80 MHz"),
        ("802.11ac 2.4 GHz", {}, "802.11ac does not exist at 2.4 GHz; it exists at 5 GHz"),
        ("802.11n 6 GHz", {}, "802.11n does not exist at 6 GHz; it exists at 2.4 GHz, 5 GHz"),
        ("802.11ax", {}, "phy needs a standard with its band, not '802.11ax'"),
        ("802.11be 6 GHz", {}, "phy needs a standard with its band"),
        ("802.11ac 5 GHz", {"streams": 3}, "3 streams are not modelled; write 1 or 2"),
        ("802.11ac 5 GHz", {"guard_interval_ns": 500}, "there is no guard interval of 500 ns"),
    ],
)
def test_impossible_combinations_are_rejected(standard: str, phy: dict[str, int], message: str) -> None:
    with pytest.raises(ValidationError, match=re.escape(message)):
        radio(standard, **phy)


def test_each_standard_that_the_remedy_lists_is_accepted() -> None:
    with pytest.raises(ValidationError, match="write one of: ") as error_info:
        radio("802.11ax")
    text = str(error_info.value).partition("write one of: ")[2]
    standards = [standard.partition(" [")[0].strip() for standard in text.splitlines()[0].split(", ")]
    assert len(standards) == 6
    for standard in standards:
        assert radio(standard).standard == standard


def test_possible_combinations_are_passed_to_the_model() -> None:
    for standard, width_mhz in (("802.11n 5 GHz", 40), ("802.11ac 5 GHz", 80), ("802.11ax 6 GHz", 80)):
        phy = antenna_of(radio(standard, width_mhz=width_mhz, streams=2)).phy
        assert phy is not None
        assert (f"802.11{phy.amendment} {phy.band_name}", phy.width_mhz, phy.streams) == (standard, width_mhz, 2)


def test_a_radio_without_phy_has_the_standard_of_its_text_or_802_11g() -> None:
    fields = {"interface": "wlan0", "tx_power_dbm": 17, "sensitivity_dbm": -82}
    for standard, expected_standard in (
        ("802.11n 2.4 GHz", "802.11n"),
        ("802.11ac", "802.11g"),
        ("any text", "802.11g"),
    ):
        antenna = antenna_of(Radio.model_validate({**fields, "standard": standard}))
        assert (antenna.standard, antenna.phy) == (expected_standard, None)
