"""The physics federate of bodies: time, commands, and independence of the division of time into calls."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldkit.core.errors import ConfigurationError
from sim_backends.physics.bodies import Bodies
from sim_backends.physics.body import Twist
from sim_backends.physics.differential_drive import DifferentialDrive
from sim_backends.physics.robot_limits import HUSKY_A200
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


def two_bodies(world: World | None = YARD) -> Bodies:
    return Bodies(
        {"a": DifferentialDrive(HUSKY_A200, (-1.0, 0.0)), "b": DifferentialDrive(HUSKY_A200, (1.0, 0.5), math.pi)},
        world,
    )


TWISTS = st.builds(Twist, st.floats(-1, 1), st.floats(-2, 2))
COMMANDS = st.lists(
    st.tuples(st.integers(0, 4000 * MS), st.sampled_from("ab"), TWISTS),
    max_size=8,
    unique_by=lambda command: command[0],
)


def run_commands(commands: list[tuple[int, str, Twist]], divisions_ns: list[int]) -> tuple[dict[str, State], Bodies]:
    """Return the states after 4.5 s; time is divided at the times of the commands and at `divisions_ns`."""
    bodies = two_bodies()
    commands_by_time = {at_ns: (name, twist) for at_ns, name, twist in commands}
    twists: dict[str, Twist] = {}
    for at_ns in sorted({*commands_by_time, *divisions_ns, 4000 * MS}):
        bodies.advance(at_ns, twists)
        twists = dict([commands_by_time[at_ns]] if at_ns in commands_by_time else [])
    return dict(bodies.advance(4500 * MS, twists)), bodies


@settings(max_examples=25)
@given(COMMANDS, st.lists(st.integers(0, 4000 * MS), max_size=30))
def test_the_result_does_not_depend_on_the_division_of_time(
    commands: list[tuple[int, str, Twist]], divisions_ns: list[int]
) -> None:
    expected, bodies_once = run_commands(commands, [])
    actual, bodies_often = run_commands(commands, divisions_ns)
    assert actual == expected
    assert bodies_often.collisions == bodies_once.collisions


def test_states_are_those_of_the_last_step_and_commands_take_effect_at_the_next() -> None:
    bodies = two_bodies(None)
    bodies.advance(1_500_000, {})
    assert bodies.advance(1_999_999, {"a": Twist(1.0)})["a"].velocity_m_s[0] == 0
    # The command of 1.5 ms takes effect at 2 ms; at 3 m/s^2, the speed is 3 mm/s one step later.
    assert bodies.advance(2_999_999, {})["a"].velocity_m_s[0] == 0
    assert bodies.advance(3_000_000, {})["a"].velocity_m_s[0] == pytest.approx(0.003)
    assert bodies.advance(3_000_000, {"a": Twist()})["a"].velocity_m_s[0] == pytest.approx(0.003)
    assert bodies.advance(4_999_999, {})["a"].velocity_m_s[0] == 0


def test_a_snapshot_does_not_change() -> None:
    bodies = two_bodies(None)
    bodies.advance(0, {"a": Twist(-1.0)})
    states_at_1_s = bodies.advance(1000 * MS, {})
    states_at_2_s = bodies.advance(2000 * MS, {"a": Twist()})
    # The robot reaches 1 m/s after 1/6 m, in steps, and stops after the same distance.
    assert states_at_1_s["a"].position_m[0] == pytest.approx(-1 - 5 / 6, abs=1e-6)
    assert states_at_2_s["a"].position_m[0] == pytest.approx(-2, abs=2e-6)


@pytest.mark.parametrize(
    ("positions", "match"),
    [
        ({"a": (2.6, 0.0)}, "a starts within wall, at 2.6, 0, 0 m"),
        ({"a": (0.0, 0.0), "b": (0.7, 0.0)}, "b starts within a"),
        ({"a": (math.nan, 0.0)}, "a starts at"),
    ],
)
def test_a_body_that_starts_within_an_obstacle_is_rejected(
    positions: dict[str, tuple[float, float]], match: str
) -> None:
    bodies = {name: DifferentialDrive(HUSKY_A200, place) for name, place in positions.items()}
    with pytest.raises(ConfigurationError, match=match):
        Bodies(bodies, YARD)


def test_invalid_input_is_rejected() -> None:
    with pytest.raises(ConfigurationError, match="is not positive"):
        Bodies({}, step_ns=0)
    with pytest.raises(ConfigurationError, match="a command is for c, which is not a body"):
        two_bodies().advance(5 * MS, {"c": Twist()})
