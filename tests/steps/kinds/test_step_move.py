"""The step move: what a procedure may say, what the lab is asked, and what is refused before a robot moves."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import Any, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.backends.protocols import Cast, Testbed
from fieldkit.cli.dry_run import in_shell, print_commands
from fieldkit.config import schema
from fieldkit.config.profiles import load_profile
from fieldkit.core import geometry, model
from fieldkit.core.errors import ConfigurationError, RobotError
from fieldkit.core.model import FIXED_ROLES, Leg, Protocol, Role, Topology
from fieldkit.core.units import parse_distance
from fieldkit.steps.kinds.move import MoveStep, PathLeg
from fieldkit.steps.scene import Scene
from fieldkit.trial.procedure import Procedure, load_procedure
from fieldkit.trial.request import TrialRequest, make_plan
from tests.helpers.casts import CAST, los_plan

SCENE = Scene(Protocol.TCP, CAST, "f")
PING = "during: [{ping: {from: sender, to: receiver}}]"
INSIDE = """\
name: inside
summary: a move inside a fault
scenario: los
topology: masterless
protocols: [udp]
repeats: 1
steps:
  - fault:
      robot: sender
      kind: reboot
      during:
        - move:
            robot: sender
            path: [{away: 1m}]
            speed: 1m/s
            during: [{ping: {from: sender, to: receiver}}]
"""


def move(text: str) -> MoveStep:
    return schema.validate(schema.parse(f"{{{text}}}", source="x.yaml"), MoveStep)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (f"robot: sender, speed: 1m/s, {PING}", "'path' is missing"),
        (f"robot: sender, path: [], speed: 1m/s, {PING}", "at least 1 item"),
        (f"robot: sender, path: [{{}}], speed: 1m/s, {PING}", "away, towards, left or right"),
        (f"robot: sender, path: [{{away: 1m, towards: 1m}}], speed: 1m/s, {PING}", "away or towards"),
        (f"robot: sender, path: [{{left: 1m, right: 1m}}], speed: 1m/s, {PING}", "left or right"),
        (f"robot: sender, path: [{{away: 1}}], speed: 1m/s, {PING}", "has no unit"),
        (f"robot: sender, path: [{{away: 0m}}], speed: 1m/s, {PING}", "greater than 0"),
        (f"robot: sender, path: [{{up: 1m}}], speed: 1m/s, {PING}", "unknown key up"),
        (f"robot: sender, path: [{{away: 1m}}], speed: 1, {PING}", "has no unit"),
        (f"robot: sender, path: [{{away: 1m}}], speed: 1m, {PING}", "unknown unit 'm'.*m/s, km/h"),
        (f"robot: sender, path: [{{away: 1m}}], speed: 0m/s, {PING}", "greater than 0"),
        ("robot: sender, path: [{away: 1m}], speed: 1m/s", "'during' is missing"),
        ("robot: sender, path: [{away: 1m}], speed: 1m/s, during: []", "at least 1 item"),
        (f"robot: Laptop, path: [{{away: 1m}}], speed: 1m/s, {PING}", "a role is named by small letters"),
    ],
)
def test_what_does_not_fit_is_refused_with_a_sentence(text: str, complaint: str) -> None:
    with pytest.raises(ConfigurationError, match=complaint) as caught:
        move(text)
    assert caught.value.where == "x.yaml:1"


def test_a_move_inside_a_fault_is_refused_with_its_line() -> None:
    with pytest.raises(ConfigurationError, match="put the fault into the move") as caught:
        schema.validate(schema.parse(INSIDE, source="x.yaml"), Procedure)
    assert caught.value.where == "x.yaml:12"


def test_the_lab_is_asked_for_metres_and_seconds() -> None:
    step = move(f"robot: receiver, path: [{{towards: 2km}}, {{away: 3m, right: 4m}}], speed: 3.6km/h, {PING}")
    assert step.motion == model.Move(Role.RECEIVER, (Leg(-2000.0), Leg(3.0, -4.0)), 1.0)
    assert geometry.length_m(step.motion) == pytest.approx(2005.0)
    assert geometry.in_words(step.motion) == "2000 m towards, then 3 m away and 4 m right, at 1 m/s"
    assert step.roles() == {Role.SENDER, Role.RECEIVER}
    assert [in_shell(one.job) for one in step.jobs(SCENE)] == [
        in_shell(one.job) for one in step.during[0].step.jobs(SCENE)
    ]


def test_ways_lead_from_the_place_of_each_role() -> None:
    legs = (Leg(away_m=3.0), Leg(left_m=2.0))
    assert geometry.way_m(model.Move(Role.SENDER, legs, 1.0)) == ((0.0, 0.0), (-3.0, 0.0), (-3.0, -2.0))
    assert geometry.way_m(model.Move(Role.RECEIVER, legs, 1.0)) == ((0.0, 0.0), (3.0, 0.0), (3.0, 2.0))
    ends = {role: geometry.other_end(role, Topology.MASTER) for role in FIXED_ROLES}
    assert ends == {Role.SENDER: Role.RELAY, Role.RECEIVER: Role.RELAY, Role.RELAY: Role.SENDER}
    assert geometry.other_end(Role.SENDER, Topology.MASTERLESS) is Role.RECEIVER


def test_a_robot_is_not_asked_for_more_than_its_top_speed() -> None:
    (refusal,) = move(f"robot: sender, path: [{{away: 1m}}], speed: 0.3m/s, {PING}").refusals(SCENE)
    assert refusal.role is Role.SENDER
    assert refusal.what == "its top speed is 0.22 m/s, but the move needs 0.3 m/s"
    assert not list(move(f"robot: relay, path: [{{away: 1m}}], speed: 3m/s, {PING}").refusals(SCENE))


def test_steps_run_while_the_robot_moves_and_their_error_ends_it() -> None:
    happened: list[object] = []

    class Robots:
        @contextmanager
        def moving(self, wanted: model.Move) -> Iterator[None]:
            happened.append(wanted)
            try:
                yield
            finally:
                happened.append("back")

        @property
        def shells(self) -> Any:  # noqa: ANN401 (none is there)
            happened.append("inside")
            raise RobotError("it broke", remedy="mend it")

    step = move(f"robot: sender, path: [{{away: 1m}}], speed: 0.1m/s, {PING}")
    with pytest.raises(RobotError, match="it broke"):
        step.run(SCENE, cast("Testbed", Robots()), lambda name, expected_s: happened.append(name))
    assert happened == ["move turtlebot-1", step.motion, "ping", "inside", "back"]


def test_the_dry_run_shows_what_no_command_does(capsys: pytest.CaptureFixture[str]) -> None:
    shipped = load_procedure("driveaway")
    print_commands(los_plan().model_copy(update={"procedure": shipped.resolved(CAST)}))
    said = capsys.readouterr().out.splitlines()
    assert "# while steps run: turtlebot-2 moves 29.5 m away, at 0.22 m/s, for up to 134.1 s" in said
    assert not any("refused" in line for line in said)
    healing = los_plan().model_copy(update={"procedure": load_procedure("selfheal")})
    print_commands(healing)
    said = capsys.readouterr().out.splitlines()
    assert "# while steps run: link-down of turtlebot-1 for 2 s, after 1 s" in said


def fitted(text: str, cast: Cast = CAST) -> MoveStep:
    return move(text).resolved(cast)


def test_a_robot_within_its_limits_goes_as_fast_and_as_far_as_it_may() -> None:
    path = "path: [{away: 60m}], speed: 2m/s"
    slow = fitted(f"robot: receiver, {path}, within_limits: true, {PING}")
    assert slow.motion == model.Move(Role.RECEIVER, (Leg(29.5),), 0.22)
    assert slow.straight_s == pytest.approx(29.5 / 0.22, abs=1e-3)
    assert not list(slow.refusals(SCENE))
    drone = fitted(f"robot: relay, {path}, within_limits: true, {PING}")
    assert drone.motion == model.Move(Role.RELAY, (Leg(60.0),), 2.0), "it may"
    assert not slow.within_limits, "what is planned says what is driven"
    refused = fitted(f"robot: receiver, {path}, {PING}")
    assert refused.motion.speed_m_s == 2.0
    assert [one.what for one in refused.refusals(SCENE)] == ["its top speed is 0.22 m/s, but the move needs 2 m/s"]


@pytest.mark.parametrize(
    ("profile", "said", "pings"),
    [
        (
            "turtlebot3_burger",
            "turtlebot-2 moves 29.5 m away, at 0.22 m/s, for up to 134.4 s, and back, by itself",
            672,
        ),
        ("husky", "turtlebot-2 moves 60 m away, at 1 m/s, for up to 62.6 s, and back, by itself", 313),
        ("duckiedrone", "turtlebot-2 moves 60 m away, at 2 m/s, for up to 30 s", 150),
    ],
)
def test_the_one_that_ships_runs_with_what_a_lab_has(
    profile: str, said: str, pings: int, capsys: pytest.CaptureFixture[str]
) -> None:
    own = load_profile(profile)
    update = {"profile": own, "drives": own.drive is not None}
    cast = {role: robot.model_copy(update=update) for role, robot in CAST.items()}
    request = TrialRequest(load_procedure("driveaway"), parse_distance("5m"))
    plan = make_plan(request, backend="field", cast=cast, now=datetime(2026, 11, 20, tzinfo=UTC))
    print_commands(plan)
    out = capsys.readouterr().out
    assert said in out
    assert f"-c {pings} -i 0.2" in out
    assert "refused" not in out
    assert bool(plan.columns) == (own.drive is not None), "columns of driving"


def test_who_names_no_speed_goes_at_the_top_speed() -> None:
    step = move(f"robot: receiver, path: [{{away: 1m}}], {PING}")
    assert step.resolved(CAST).motion.speed_m_s == 0.22
    with pytest.raises(ValueError, match="not fitted"):
        _ = step.motion


def test_what_is_made_less_is_said() -> None:
    text = f"robot: receiver, path: [{{away: 40m}}], within_limits: true, {PING}"
    assert list(move(text).adjustments(CAST)) == [
        "turtlebot-2 moves 29.5 m away, at 0.22 m/s; 40 m away, at 0.22 m/s is beyond its limits"
    ]
    assert not list(move(text.replace("40m", "30m")).adjustments(CAST))
    assert not list(move(text.replace("within_limits: true, ", "")).adjustments(CAST))


def test_a_plan_reads_back_what_it_says() -> None:
    plan = los_plan().model_copy(update={"procedure": load_procedure("driveaway").resolved(CAST)})
    again = schema.validate(schema.parse(schema.dump(plan.procedure), source="trial.yaml"), Procedure)
    assert again == plan.procedure
    assert "within_limits" not in schema.dump(again)
    assert "along" not in schema.dump(again)


lengths = st.floats(-30, 30).map(lambda metres: round(metres, 2))
legs = st.lists(st.builds(Leg, lengths, lengths).filter(lambda leg: leg != Leg()), min_size=1, max_size=5)


@given(legs, st.floats(0.5, 40))
def test_a_way_ends_where_it_meets_its_fence(way: list[Leg], fence_m: float) -> None:
    kept = geometry.within(way, fence_m)
    assert geometry.farthest_m(kept) <= fence_m + 1e-6
    if geometry.farthest_m(way) <= fence_m:
        assert list(kept) == way
        return
    whole = len(kept) - 1
    assert list(kept[:whole]) == way[:whole]
    end = math.hypot(sum(leg.away_m for leg in kept), sum(leg.left_m for leg in kept))
    assert end == pytest.approx(fence_m, abs=1e-6)
    cut, leg = kept[whole], way[whole]
    assert cut.away_m * leg.left_m == pytest.approx(cut.left_m * leg.away_m, abs=1e-6), "the same direction"
    assert math.hypot(cut.away_m, cut.left_m) <= math.hypot(leg.away_m, leg.left_m) + 1e-6


@given(legs, st.floats(0.5, 40))
def test_a_way_that_was_cut_is_a_procedure_s_own(way: list[Leg], fence_m: float) -> None:
    pieces = [PathLeg.of(leg) for leg in geometry.within(way, fence_m)]
    for piece, leg in zip(pieces, way, strict=False):
        if piece is not None:
            again = schema.validate(schema.parse(schema.dump(piece), source="x.yaml"), PathLeg)
            assert again == piece
            assert abs(again.leg.away_m) <= abs(leg.away_m) + 1e-9
            assert again.leg.away_m * leg.away_m >= 0
            assert again.leg.left_m * leg.left_m >= 0


def test_a_robot_that_drives_has_columns_of_it_and_its_way_back_takes_time() -> None:
    text = f"robot: receiver, path: [{{away: 2m}}], speed: 0.2m/s, {PING}"
    drives = {role: robot.model_copy(update={"drives": True}) for role, robot in CAST.items()}
    by_itself, moved = fitted(text, drives), fitted(text)
    assert {column.name for column in by_itself.output_columns()} >= {
        "drive_out_m",
        "drive_back_off_m",
        "drive_ended",
    }
    assert not moved.output_columns()
    assert by_itself.expected_s(Protocol.UDP) == moved.expected_s(Protocol.UDP) + 10.0
