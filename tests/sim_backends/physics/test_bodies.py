"""The federate of bodies: time, commands, and that it does not matter how time is cut into calls."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldkit.core.errors import ConfigurationError
from sim_backends.physics.bodies import Bodies
from sim_backends.physics.body import Twist
from sim_backends.physics.differential_drive import HUSKY_A200, DifferentialDrive
from sim_backends.world.motion import State
from sim_backends.world.world import World
from tests.helpers.worlds import world

MS = 1_000_000
YARD = world(
    {"name": "wall", "kind": "wall", "from_m": (3, -4), "to_m": (3, 4), "thickness": "0.1m"},
    {"name": "oak", "kind": "tree", "at_m": (0, 3), "trunk_radius": "0.3m"},
    {"name": "box", "kind": "box", "centre_m": (-3, 0), "size_m": (1, 1, 1), "yaw_deg": 30},
    {"name": "knoll", "kind": "raised", "centre_m": (0, -4), "size_m": (4, 3, 0.5), "yaw_deg": 10},
    {"name": "ramp", "kind": "ramp", "centre_m": (-0.4, -1.8), "size_m": (1.5, 3, 0.5), "yaw_deg": -80},
)


def two(world: World | None = YARD) -> Bodies:
    return Bodies(
        {"a": DifferentialDrive(HUSKY_A200, (-1.0, 0.0)), "b": DifferentialDrive(HUSKY_A200, (1.0, 0.5), math.pi)},
        world,
    )


TWISTS = st.builds(Twist, st.floats(-1, 1), st.floats(-2, 2))
COMMANDS = st.lists(
    st.tuples(st.integers(0, 4000 * MS), st.sampled_from("ab"), TWISTS), max_size=8, unique_by=lambda one: one[0]
)


def told(commands: list[tuple[int, str, Twist]], cuts: list[int]) -> tuple[dict[str, State], Bodies]:
    """Return the states after 4 s, commands given at their times, time cut there and at `cuts`."""
    bodies = two()
    by_time = {at_ns: (name, twist) for at_ns, name, twist in commands}
    given: dict[str, Twist] = {}
    for at_ns in sorted({*by_time, *cuts, 4000 * MS}):
        bodies.advance(at_ns, given)
        given = dict([by_time[at_ns]] if at_ns in by_time else [])
    return dict(bodies.advance(4500 * MS, given)), bodies


@settings(max_examples=25)
@given(COMMANDS, st.lists(st.integers(0, 4000 * MS), max_size=30))
def test_the_result_does_not_depend_on_how_time_is_cut(
    commands: list[tuple[int, str, Twist]], cuts: list[int]
) -> None:
    whole, once = told(commands, [])
    cut, often = told(commands, cuts)
    assert cut == whole
    assert often.collisions == once.collisions


def test_states_are_those_of_the_last_own_step_and_commands_take_effect_at_the_next() -> None:
    bodies = two(None)
    bodies.advance(1_500_000, {})
    assert bodies.advance(1_999_999, {"a": Twist(1.0)})["a"].velocity_m_s[0] == 0
    # Told at 1.5 ms, so from 2 ms on; at 3 m/s^2 it has 3 mm/s a step later.
    assert bodies.advance(2_999_999, {})["a"].velocity_m_s[0] == 0
    assert bodies.advance(3_000_000, {})["a"].velocity_m_s[0] == pytest.approx(0.003)
    assert bodies.advance(3_000_000, {"a": Twist()})["a"].velocity_m_s[0] == pytest.approx(0.003)
    assert bodies.advance(4_999_999, {})["a"].velocity_m_s[0] == 0


def test_a_snapshot_stays_as_it_was() -> None:
    bodies = two(None)
    bodies.advance(0, {"a": Twist(-1.0)})
    early = bodies.advance(1000 * MS, {})
    late = bodies.advance(2000 * MS, {"a": Twist()})
    # To 1 m/s over 1/6 m, in steps; as far again to stop.
    assert early["a"].position_m[0] == pytest.approx(-1 - 5 / 6, abs=1e-6)
    assert late["a"].position_m[0] == pytest.approx(-2, abs=2e-6)


@pytest.mark.parametrize(
    ("places", "match"),
    [
        ({"a": (2.6, 0.0)}, "a begins within wall, at 2.6, 0, 0 m"),
        ({"a": (0.0, 0.0), "b": (0.7, 0.0)}, "b begins within a"),
        ({"a": (math.nan, 0.0)}, "a begins at"),
    ],
)
def test_who_begins_within_something_is_refused(places: dict[str, tuple[float, float]], match: str) -> None:
    bodies = {name: DifferentialDrive(HUSKY_A200, place) for name, place in places.items()}
    with pytest.raises(ConfigurationError, match=match):
        Bodies(bodies, YARD)


def test_bad_input_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="no positive time"):
        Bodies({}, step_ns=0)
    with pytest.raises(ConfigurationError, match="a command is for c, which is no body"):
        two().advance(5 * MS, {"c": Twist()})
