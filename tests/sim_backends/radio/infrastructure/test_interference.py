"""Airtime of neighbours and ovens: measured shares compared with the configured ones, and a robot's goodput."""

import pytest

from fieldkit.core.model import LinkSample
from sim_backends.radio.antennas import Antenna
from sim_backends.radio.mac.channel import Emitter
from sim_backends.radio.models.radio_model import WifiInWorld
from sim_backends.radio.radio_options import RadioOptions

MS, S = 10**6, 10**9
PLACES_M = {"a": (0.0, 0.0, 0.2), "b": (5.0, 0.0, 0.2)}
ANTENNA = Antenna("802.11g", 15.0, -88.0)


def model(**options: object) -> WifiInWorld[int]:
    radio: WifiInWorld[int] = WifiInWorld(
        1, RadioOptions.model_validate({"fading": False, **options}), dict.fromkeys(PLACES_M, ANTENNA), None
    )
    radio.use_meter()
    radio.place(0, PLACES_M, None)
    return radio


def busy_share(radio: WifiInWorld[int], until_ns: int) -> float:
    radio.advance(until_ns)
    sample: LinkSample = radio.sample(until_ns, until_ns)["a"]
    assert sample.busy_ns is not None
    return sample.busy_ns / until_ns


def count_deliveries(radio: WifiInWorld[int], until_ns: int) -> int:
    """Return the number of packets of a saturated sender that arrive."""
    for number in range(900):
        radio.send(0, "a", number, 1000, "b")
    return len(radio.deliveries(until_ns))


@pytest.mark.parametrize("duty", [0.1, 0.4])
def test_the_channel_is_busy_for_the_duty_of_a_neighbour(duty: float) -> None:
    radio = model(neighbours={"office": {"at_m": [10, 0], "duty": f"{100 * duty:g}%"}})
    assert busy_share(radio, 20 * S) == pytest.approx(duty, rel=0.05)


def test_a_robot_out_of_range_of_a_neighbour_finds_its_channel_idle() -> None:
    radio = model(neighbours={"far": {"at_m": [100_000, 0], "duty": "40%"}})
    assert busy_share(radio, S) == 0


def test_a_neighbour_shares_the_channel_with_a_robot() -> None:
    count_alone, count_beside_neighbour = count_deliveries(model(), 300 * MS), count_deliveries(
        model(neighbours={"office": {"at_m": [10, 0], "duty": "40%"}}), 300 * MS
    )  # fmt: skip
    assert count_beside_neighbour == pytest.approx(0.6 * count_alone, rel=0.15)


def test_a_neighbour_is_not_a_robot() -> None:
    radio = model(neighbours={"office": {"at_m": [10, 0], "duty": "40%"}})
    radio.send(0, "a", 1, 100, None)
    losses: list[str] = []
    radio.log_losses(lambda _, __, receiver, ___: losses.append(receiver))
    receivers = [receiver for _, receiver, _, _, _ in radio.deliveries(S)]
    assert receivers + losses == ["b"]
    assert radio.sample(S, S).keys() == {"a", "b"}
    assert radio.counters().keys() == {("a", "b"), ("b", "a")}


@pytest.mark.parametrize("mains_hz", [50, 60])
def test_an_oven_keeps_the_channel_busy_for_half_of_each_cycle(mains_hz: int) -> None:
    oven = {"kitchen": {"at_m": [2, 0], "mains_hz": mains_hz}}
    assert busy_share(model(microwave_ovens=oven), S) == pytest.approx(0.5, abs=0.01)
    assert count_deliveries(model(microwave_ovens=oven), 200 * MS) < 0.55 * count_deliveries(model(), 200 * MS)


def test_an_oven_that_is_weaker_than_the_carrier_sense_threshold_only_adds_noise() -> None:
    oven = {"kitchen": {"at_m": [60, 0], "power_dbm": 30}}
    assert busy_share(model(microwave_ovens=oven), S) == 0
    assert count_deliveries(model(microwave_ovens=oven, mode="g54"), 200 * MS) < 0.8 * count_deliveries(
        model(mode="g54"), 200 * MS
    )


def test_a_jammer_and_an_oven_are_independent() -> None:
    radio = model(microwave_ovens={"kitchen": {"at_m": [5000, 0]}})
    radio.jam(0, [Emitter("kitchen", (2.0, 0.0, 1.0), 30.0)])
    assert count_deliveries(radio, 100 * MS) == 0
    radio.jam(100 * MS, [])
    assert len(radio.deliveries(200 * MS)) > 50
