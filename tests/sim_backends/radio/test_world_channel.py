"""Moves in the air: only the links of who moved are looked at again, and fading goes on without a jump."""

from collections.abc import Callable
from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Vector
from sim_backends.radio.options import RadioOptions
from sim_backends.radio.world_channel import Antenna, WorldChannel
from sim_backends.world.world import World, load_world

NAMES = ("a", "b", "c", "d")
ANTENNAS = {name: Antenna("802.11n", 17.0, -82.0) for name in NAMES}
STEADY = RadioOptions(fading=False, shadowing_db=4.0)
FADING = RadioOptions(fading=True, shadowing_db=0.0, stir_m_s=0.1)
BAYLANDS = load_world("baylands")
METRES = st.integers(0, 400).map(lambda decimetres: decimetres / 10)
PLACES = st.dictionaries(st.sampled_from(NAMES), st.tuples(METRES, METRES, st.just(0.2)))


def heard(channel: WorldChannel) -> list[tuple[list[float], list[int], list[bool]]]:
    stations = range(len(channel.names))
    return [
        (
            channel.powers_mw(one, 10**12),
            [channel.delay_ns(one, other) for other in stations if channel.linked(one, other)],
            [channel.linked(one, other) for other in stations],
        )
        for one in stations
    ]


@given(st.lists(PLACES, min_size=1, max_size=5))
def test_what_was_before_a_move_changes_nothing_after_it(moves: list[dict[str, Vector]]) -> None:
    moved, fresh = WorldChannel(1, ANTENNAS, STEADY, BAYLANDS), WorldChannel(1, ANTENNAS, STEADY, BAYLANDS)
    for now_ns, places in enumerate(moves):
        moved.move(now_ns, places)
    fresh.move(0, moves[-1])
    assert heard(moved) == heard(fresh)


def counted(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return how many links were worked out each time, from now on."""
    looked: list[int] = []
    whole: Callable[..., Any] = World.penetration_loss_db

    def count(world: World, start_m: Any, *others: Any) -> Any:  # noqa: ANN401 (as it is)
        looked.append(len(start_m))
        return whole(world, start_m, *others)

    monkeypatch.setattr(World, "penetration_loss_db", count)
    return looked


def test_only_the_links_of_who_moved_are_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    looked = counted(monkeypatch)
    channel = WorldChannel(1, ANTENNAS, FADING, load_world("lawn"))
    places: dict[str, Vector] = {name: (float(number), 0.0, 0.2) for number, name in enumerate(NAMES)}
    channel.move(0, places)
    heard(channel)
    assert sum(looked) == 6, "each once"
    channel.move(1, places)
    heard(channel)
    assert sum(looked) == 6
    channel.move(2, places | {"b": (9.0, 0.0, 0.2)})
    heard(channel)
    assert looked[-1] == 3
    assert sum(looked) == 6 + 3
    channel.move(3, places | {"b": (9.0, 0.0, 0.2)}, {"c": (1.0, 0.0, 0.0)})
    heard(channel)
    assert sum(looked) == 6 + 3 + 3


def test_a_frame_on_the_air_arrives_as_strong_as_it_was_sent() -> None:
    channel = WorldChannel(1, ANTENNAS, STEADY)
    channel.move(0, {"a": (0.0, 0.0, 0.2), "b": (5.0, 0.0, 0.2)})
    sent = channel.powers_mw(0, 0)
    before = list(sent)
    channel.move(1, {"a": (0.0, 0.0, 0.2), "b": (50.0, 0.0, 0.2)})
    assert sent == before
    assert channel.powers_mw(0, 1) != before


@given(
    times_ns=st.lists(st.integers(1, 10**8), min_size=1, max_size=20),
    velocity=st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.just(0.0)),
)
def test_fading_goes_on_across_the_steps_of_a_move(times_ns: list[int], velocity: Vector) -> None:
    """Told in any steps, a link has the gain that it has where both are told its place now, whoever asked before."""
    places: dict[str, Vector] = {"a": (0.0, 0.0, 0.2), "b": (20.0, 0.0, 0.2)}
    stepped, straight = WorldChannel(7, ANTENNAS, FADING), WorldChannel(7, ANTENNAS, FADING)
    now_ns = 0
    for channel in (stepped, straight):
        channel.move(0, places, {"b": velocity})
    for step_ns in times_ns:
        now_ns += step_ns
        there = 20.0 + velocity[0] * now_ns / 1e9, velocity[1] * now_ns / 1e9, 0.2
        # c has nothing to do with it.
        stepped.move(now_ns, places | {"b": there, "c": (1.0, now_ns / 1e9, 0.2)}, {"b": velocity})
        stepped.powers_mw(1, now_ns)
    gains = [
        channel.powers_mw(0, now_ns)[1] / 10 ** ((17.0 - channel.loss_db(*ends(places["a"], at))[0]) / 10)
        for channel, at in ((stepped, there), (straight, places["b"]))
    ]
    assert gains[0] == pytest.approx(gains[1], rel=1e-5)


def ends(one: Vector, other: Vector) -> tuple[Any, Any]:
    return np.array([one]), np.array([other])


@given(st.lists(st.integers(0, 10**9), min_size=2, max_size=20), st.randoms(use_true_random=False))
def test_whoever_asked_before_the_powers_are_the_same(times_ns: list[int], order: Random) -> None:
    places: dict[str, Vector] = {name: (3.0 * number, 1.0, 0.2) for number, name in enumerate(NAMES)}
    velocities: dict[str, Vector] = {"b": (1.0, 0.5, 0.0), "d": (-1.0, 0.0, 0.0)}
    seldom, often = WorldChannel(7, ANTENNAS, FADING, BAYLANDS), WorldChannel(7, ANTENNAS, FADING, BAYLANDS)
    for channel in (seldom, often):
        channel.move(0, places, velocities)
    asked = [(at_ns, order.randrange(len(NAMES))) for at_ns in sorted(times_ns)]
    heard_often = [often.powers_mw(station, at_ns) for at_ns, station in asked]
    at_ns, station = asked[-1]
    assert seldom.powers_mw(station, at_ns) == heard_often[-1]


def test_a_crowd_on_the_move_is_looked_at_only_where_somebody_sends(monkeypatch: pytest.MonkeyPatch) -> None:
    looked = counted(monkeypatch)
    crowd = {f"r{number}": Antenna("802.11n", 17.0, -82.0) for number in range(20)}
    channel = WorldChannel(1, crowd, FADING, load_world("lawn"))
    for step in range(1, 100):
        channel.move(step, {name: (step / 10 + number, 0.0, 0.2) for number, name in enumerate(crowd)})
    assert not looked
    channel.powers_mw(2, 100)
    assert looked == [19]
    channel.linked(2, 0)
    channel.delay_ns(2, 1)
    assert looked == [19]
    channel.powers_mw(0, 100)
    assert looked == [19, 18], "the link to station 2 is known"
    for station in range(20):
        channel.powers_mw(station, 100)
    assert sum(looked) == 20 * 19 / 2
    assert looked[-1] > 50, "the last ones at once"


def test_a_station_of_802_11n_sends_in_a_mode_of_802_11g_too() -> None:
    antennas = {"old": Antenna("802.11g", 15.0, -85.0), "new": Antenna("802.11n", 15.0, -92.0)}
    for mode in ("g6", "g54"):
        channel = WorldChannel(1, antennas, RadioOptions(mode=mode))
        assert channel.rate_control(1, 0).choose(0, ("flow", 0), 1).name == mode


def test_a_mode_that_a_station_does_not_have_is_refused_before_anything_is_sent() -> None:
    antennas = {"old": Antenna("802.11g", 15.0, -85.0), "new": Antenna("802.11n", 15.0, -92.0)}
    with pytest.raises(ConfigurationError, match=r"radio\.mode n6 is of 802\.11n, and old has 802\.11g") as caught:
        WorldChannel(1, antennas, RadioOptions(mode="n6"))
    assert "g54" in caught.value.remedy
