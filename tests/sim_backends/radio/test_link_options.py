"""Conversion of radio options to fixed links."""

import pytest

from fieldkit.config import schema
from fieldkit.core.errors import ConfigurationError
from sim_backends.radio.core.links import LinkParameters
from sim_backends.radio.models.fixed_links import mesh
from sim_backends.radio.radio_options import RadioOptions


def options(text: str) -> RadioOptions:
    return schema.validate(schema.parse(text, source="radio.yaml"), RadioOptions)


def test_empty_options_are_valid() -> None:
    assert options("{}") == RadioOptions()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("loss: 101%", "less than or equal to 1"),
        ("rate: fast", "unlimited"),
        ("rate: 0Mbit/s", "below 1bit/s"),
        ("delay: 5", "has no unit"),
        ("los: 10%", "did you mean 'loss'"),
        ("mode: g55", "did you mean 'g5"),
        ("propagation: ray", "two-ray"),
        ("shadowing_db: -1", "greater than or equal to 0"),
        ("queue_packets: -1", "greater than or equal to 0"),
    ],
)
def test_invalid_options_are_named_in_the_error(text: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message) as error_info:
        options(text)
    assert error_info.value.where == "radio.yaml:1"


def test_configured_values_apply_to_every_link() -> None:
    link_options = options("{loss: 10%, delay: 5ms, jitter: 1ms, rate: 20Mbit/s, queue_packets: 7}")
    links = mesh(link_options, ["a", "b", "c"])
    assert set(links) == {("a", "b"), ("b", "a"), ("a", "c"), ("c", "a"), ("b", "c"), ("c", "b")}
    expected = LinkParameters(
        rate_bit_s=20_000_000, delay_ns=5_000_000, jitter_ns=1_000_000, loss=0.1, queue_packets=7
    )
    assert set(links.values()) == {expected}


@pytest.mark.parametrize("text", ["loss: 0%", "delay: 0ms", "rate: unlimited", "jitter: 1ms"])
def test_one_configured_value_makes_every_link_fixed(text: str) -> None:
    assert options(text).is_fixed
    assert not options("{fading: true, queue_packets: 3}").is_fixed
    assert options("rate: unlimited").link().rate_bit_s is None
    assert options("loss: 1%").link() == LinkParameters(rate_bit_s=54_000_000, delay_ns=200_000, loss=0.01)
