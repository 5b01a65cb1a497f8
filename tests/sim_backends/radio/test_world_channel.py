"""Moves of stations: only the links of moved stations are computed again, and fading is continuous."""

from collections.abc import Callable
from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Vector
from sim_backends.radio.antennas import Antenna
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.radio.world_channel import WorldChannel
from sim_backends.world.penetration import Obstacles
from sim_backends.world.world import load_world

NAMES = ("a", "b", "c", "d")
ANTENNAS = {name: Antenna("802.11n", 17.0, -82.0) for name in NAMES}
STEADY = RadioOptions(fading=False, shadowing_db=4.0)
FADING = RadioOptions(fading=True, shadowing_db=0.0, stir_m_s=0.1)
BAYLANDS = load_world("baylands")
METRES = st.integers(0, 400).map(lambda decimetres: decimetres / 10)
PLACES = st.dictionaries(st.sampled_from(NAMES), st.tuples(METRES, METRES, st.just(0.2)))


def link_states(channel: WorldChannel) -> list[tuple[list[float], list[int], list[bool]]]:
    stations = range(len(channel.names))
    return [
        (
            channel.powers_mw(first, 10**12),
            [channel.delay_ns(first, second) for second in stations if channel.are_linked(first, second)],
            [channel.are_linked(first, second) for second in stations],
        )
        for first in stations
    ]


@given(st.lists(PLACES, min_size=1, max_size=5))
def test_links_depend_only_on_the_last_positions(moves: list[dict[str, Vector]]) -> None:
    moved_channel, new_channel = (
        WorldChannel(1, ANTENNAS, STEADY, BAYLANDS),
        WorldChannel(1, ANTENNAS, STEADY, BAYLANDS),
    )
    for now_ns, places in enumerate(moves):
        moved_channel.move(now_ns, places)
    new_channel.move(0, moves[-1])
    assert link_states(moved_channel) == link_states(new_channel)


def count_computed_links(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return a list that receives the number of links of each loss computation from now on."""
    computed_counts: list[int] = []
    original: Callable[..., Any] = Obstacles.penetration_loss_db

    def counting_loss(obstacles: Obstacles, start_m: Any, *others: Any) -> Any:  # noqa: ANN401 (the original signature)
        computed_counts.append(len(start_m))
        return original(obstacles, start_m, *others)

    monkeypatch.setattr(Obstacles, "penetration_loss_db", counting_loss)
    return computed_counts


def test_only_the_links_of_moved_stations_are_computed_again(monkeypatch: pytest.MonkeyPatch) -> None:
    computed_counts = count_computed_links(monkeypatch)
    channel = WorldChannel(1, ANTENNAS, FADING, load_world("lawn"))
    places: dict[str, Vector] = {name: (float(number), 0.0, 0.2) for number, name in enumerate(NAMES)}
    channel.move(0, places)
    link_states(channel)
    assert sum(computed_counts) == 6, "each link once"
    channel.move(1, places)
    link_states(channel)
    assert sum(computed_counts) == 6
    channel.move(2, places | {"b": (9.0, 0.0, 0.2)})
    link_states(channel)
    assert computed_counts[-1] == 3
    assert sum(computed_counts) == 6 + 3
    channel.move(3, places | {"b": (9.0, 0.0, 0.2)}, {"c": (1.0, 0.0, 0.0)})
    link_states(channel)
    assert sum(computed_counts) == 6 + 3 + 3


def test_a_move_does_not_change_the_powers_of_a_frame_on_the_air() -> None:
    channel = WorldChannel(1, ANTENNAS, STEADY)
    channel.move(0, {"a": (0.0, 0.0, 0.2), "b": (5.0, 0.0, 0.2)})
    frame_powers_mw = channel.powers_mw(0, 0)
    powers_before_mw = list(frame_powers_mw)
    channel.move(1, {"a": (0.0, 0.0, 0.2), "b": (50.0, 0.0, 0.2)})
    assert frame_powers_mw == powers_before_mw
    assert channel.powers_mw(0, 1) != powers_before_mw


@given(
    times_ns=st.lists(st.integers(1, 10**8), min_size=1, max_size=20),
    velocity=st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.just(0.0)),
)
def test_fading_is_continuous_across_position_updates(times_ns: list[int], velocity: Vector) -> None:
    """A link has the same gain after any number of position updates as by dead reckoning from the first."""
    places: dict[str, Vector] = {"a": (0.0, 0.0, 0.2), "b": (20.0, 0.0, 0.2)}
    updated_channel, reckoned_channel = WorldChannel(7, ANTENNAS, FADING), WorldChannel(7, ANTENNAS, FADING)
    now_ns = 0
    for channel in (updated_channel, reckoned_channel):
        channel.move(0, places, {"b": velocity})
    for step_ns in times_ns:
        now_ns += step_ns
        current_place = 20.0 + velocity[0] * now_ns / 1e9, velocity[1] * now_ns / 1e9, 0.2
        # Station c is not part of the link.
        updated_channel.move(now_ns, places | {"b": current_place, "c": (1.0, now_ns / 1e9, 0.2)}, {"b": velocity})
        updated_channel.powers_mw(1, now_ns)
    gains = [
        channel.powers_mw(0, now_ns)[1] / 10 ** ((17.0 - channel.loss_db(*as_arrays(places["a"], place_m))[0]) / 10)
        for channel, place_m in ((updated_channel, current_place), (reckoned_channel, places["b"]))
    ]
    assert gains[0] == pytest.approx(gains[1], rel=1e-5)


def as_arrays(first: Vector, second: Vector) -> tuple[Any, Any]:
    return np.array([first]), np.array([second])


@given(st.lists(st.integers(0, 10**9), min_size=2, max_size=20), st.randoms(use_true_random=False))
def test_powers_do_not_depend_on_earlier_calls(times_ns: list[int], order: Random) -> None:
    places: dict[str, Vector] = {name: (3.0 * number, 1.0, 0.2) for number, name in enumerate(NAMES)}
    velocities: dict[str, Vector] = {"b": (1.0, 0.5, 0.0), "d": (-1.0, 0.0, 0.0)}
    called_once, called_often = (
        WorldChannel(7, ANTENNAS, FADING, BAYLANDS),
        WorldChannel(7, ANTENNAS, FADING, BAYLANDS),
    )
    for channel in (called_once, called_often):
        channel.move(0, places, velocities)
    queries = [(at_ns, order.randrange(len(NAMES))) for at_ns in sorted(times_ns)]
    powers_often = [called_often.powers_mw(station, at_ns) for at_ns, station in queries]
    at_ns, station = queries[-1]
    assert called_once.powers_mw(station, at_ns) == powers_often[-1]


def test_links_of_many_moving_stations_are_computed_only_for_senders(monkeypatch: pytest.MonkeyPatch) -> None:
    computed_counts = count_computed_links(monkeypatch)
    antennas = {f"r{number}": Antenna("802.11n", 17.0, -82.0) for number in range(20)}
    channel = WorldChannel(1, antennas, FADING, load_world("lawn"))
    for step in range(1, 100):
        channel.move(step, {name: (step / 10 + number, 0.0, 0.2) for number, name in enumerate(antennas)})
    assert not computed_counts
    channel.powers_mw(2, 100)
    assert computed_counts == [19]
    channel.are_linked(2, 0)
    channel.delay_ns(2, 1)
    assert computed_counts == [19]
    channel.powers_mw(0, 100)
    assert computed_counts == [19, 18], "the link to station 2 is already computed"
    for station in range(20):
        channel.powers_mw(station, 100)
    assert sum(computed_counts) == 20 * 19 / 2
    assert computed_counts[-1] > 50, "the last links are computed together"


def test_a_station_of_802_11n_supports_the_modes_of_802_11g() -> None:
    antennas = {"old": Antenna("802.11g", 15.0, -85.0), "new": Antenna("802.11n", 15.0, -92.0)}
    for mode in ("g6", "g54"):
        channel = WorldChannel(1, antennas, RadioOptions(mode=mode))
        assert channel.rate_control(1, 0).choose(0, ("flow", 0), 1).name == mode


def test_an_unsupported_fixed_mode_is_rejected_at_the_start() -> None:
    antennas = {"old": Antenna("802.11g", 15.0, -85.0), "new": Antenna("802.11n", 15.0, -92.0)}
    with pytest.raises(ConfigurationError, match=r"radio\.mode n6 is not a mode of the radio of old") as error_info:
        WorldChannel(1, antennas, RadioOptions(mode="n6"))
    assert "g54" in error_info.value.remedy
