"""The step move: valid keys, the move passed to the testbed, and refusals before a robot moves."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import Any, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.backends.protocols import Cast, Testbed
from fieldkit.cli.dry_run import print_commands, shell_line
from fieldkit.config import schema
from fieldkit.config.profiles import load_profile
from fieldkit.core import geometry, model
from fieldkit.core.errors import ConfigurationError, RobotError
from fieldkit.core.model import FIXED_ROLES, Leg, Protocol, Role, Topology
from fieldkit.core.units import parse_distance
from fieldkit.motion import driven_paths
from fieldkit.motion.logs import drive_log
from fieldkit.motion.steps.move import MoveStep
from fieldkit.steps.legs import PathLeg
from fieldkit.steps.scene import Scene
from fieldkit.trial.procedure import Procedure, load_procedure
from fieldkit.trial.request import TrialRequest, make_plan
from tests.helpers.casts import CAST, los_plan

SCENE = Scene(Protocol.TCP, CAST, "f")
PING = "during: [{ping: {from: sender, to: receiver}}]"
MOVE_IN_FAULT = """\
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
    ("text", "message"),
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
        (
            f"robot: Laptop, path: [{{away: 1m}}], speed: 1m/s, {PING}",
            "name of a role consists of lower-case letters",
        ),
    ],
)
def test_invalid_keys_are_refused(text: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message) as error_info:
        move(text)
    assert error_info.value.where == "x.yaml:1"


def test_move_nested_in_a_fault_is_refused_with_its_line() -> None:
    with pytest.raises(ConfigurationError, match="put the fault into the move") as error_info:
        schema.validate(schema.parse(MOVE_IN_FAULT, source="x.yaml"), Procedure)
    assert error_info.value.where == "x.yaml:12"


def test_motion_is_in_metres_and_seconds() -> None:
    step = move(f"robot: receiver, path: [{{towards: 2km}}, {{away: 3m, right: 4m}}], speed: 3.6km/h, {PING}")
    assert step.motion == model.Move(Role.RECEIVER, (Leg(-2000.0), Leg(3.0, -4.0)), 1.0)
    assert driven_paths.length_m(step.motion) == pytest.approx(2005.0)
    assert geometry.describe_move(step.motion) == "2000 m towards, then 3 m away and 4 m right, at 1 m/s"
    assert step.roles() == {Role.SENDER, Role.RECEIVER}
    assert [shell_line(planned.job) for planned in step.jobs(SCENE)] == [
        shell_line(planned.job) for planned in step.during[0].step.jobs(SCENE)
    ]


def test_direction_of_path_depends_on_role() -> None:
    legs = (Leg(away_m=3.0), Leg(left_m=2.0))
    assert geometry.path_corners_m(model.Move(Role.SENDER, legs, 1.0)) == ((0.0, 0.0), (-3.0, 0.0), (-3.0, -2.0))
    assert geometry.path_corners_m(model.Move(Role.RECEIVER, legs, 1.0)) == ((0.0, 0.0), (3.0, 0.0), (3.0, 2.0))
    other_ends = {role: geometry.other_end(role, Topology.MASTER) for role in FIXED_ROLES}
    assert other_ends == {Role.SENDER: Role.RELAY, Role.RECEIVER: Role.RELAY, Role.RELAY: Role.SENDER}
    assert geometry.other_end(Role.SENDER, Topology.MASTERLESS) is Role.RECEIVER


def test_move_above_top_speed_is_refused() -> None:
    (refusal,) = move(f"robot: sender, path: [{{away: 1m}}], speed: 0.3m/s, {PING}").refusals(SCENE)
    assert refusal.role is Role.SENDER
    assert refusal.what == "its top speed is 0.22 m/s, but the move needs 0.3 m/s"
    assert not list(move(f"robot: relay, path: [{{away: 1m}}], speed: 3m/s, {PING}").refusals(SCENE))


def test_nested_steps_run_during_the_motion_and_their_error_ends_it() -> None:
    events: list[object] = []

    class Robots:
        @contextmanager
        def moving(self, motion: model.Move) -> Iterator[None]:
            events.append(motion)
            try:
                yield
            finally:
                events.append("back")

        @property
        def shells(self) -> Any:  # noqa: ANN401 (there are no shells)
            events.append("inside")
            raise RobotError("it broke", remedy="repair it")

    step = move(f"robot: sender, path: [{{away: 1m}}], speed: 0.1m/s, {PING}")
    with pytest.raises(RobotError, match="it broke"):
        step.run(SCENE, cast("Testbed", Robots()), lambda name, expected_s: events.append(name))
    assert events == ["move turtlebot-1", step.motion, "ping", "inside", "back"]


def test_dry_run_shows_moves_and_faults(capsys: pytest.CaptureFixture[str]) -> None:
    procedure = load_procedure("driveaway")
    print_commands(los_plan().model_copy(update={"procedure": procedure.resolved(CAST)}))
    output = capsys.readouterr().out.splitlines()
    assert "# while steps run: turtlebot-2 moves 29.5 m away, at 0.22 m/s, for up to 134.1 s" in output
    assert not any("refused" in line for line in output)
    healing_plan = los_plan().model_copy(update={"procedure": load_procedure("selfheal")})
    print_commands(healing_plan)
    output = capsys.readouterr().out.splitlines()
    assert "# while steps run: link-down of turtlebot-1 for 2 s, after 1 s" in output


def resolved_move(text: str, cast: Cast = CAST) -> MoveStep:
    return move(text).resolved(cast)


def test_move_within_limits_is_reduced_to_speed_and_fence() -> None:
    path = "path: [{away: 60m}], speed: 2m/s"
    ground_move = resolved_move(f"robot: receiver, {path}, within_limits: true, {PING}")
    assert ground_move.motion == model.Move(Role.RECEIVER, (Leg(29.5),), 0.22)
    assert ground_move.straight_s == pytest.approx(29.5 / 0.22, abs=1e-3)
    assert not list(ground_move.refusals(SCENE))
    drone = resolved_move(f"robot: relay, {path}, within_limits: true, {PING}")
    assert drone.motion == model.Move(Role.RELAY, (Leg(60.0),), 2.0), "within the limits of the drone"
    assert not ground_move.within_limits, "the plan has the actual motion"
    unreduced_move = resolved_move(f"robot: receiver, {path}, {PING}")
    assert unreduced_move.motion.speed_m_s == 2.0
    assert [refusal.what for refusal in unreduced_move.refusals(SCENE)] == [
        "its top speed is 0.22 m/s, but the move needs 2 m/s"
    ]


@pytest.mark.parametrize(
    ("profile", "note", "pings"),
    [
        (
            "turtlebot3_burger",
            "turtlebot-2 moves 29.5 m away, at 0.22 m/s, for up to 134.4 s, and back, automatically",
            672,
        ),
        ("husky", "turtlebot-2 moves 60 m away, at 1 m/s, for up to 62.6 s, and back, automatically", 313),
        ("duckiedrone", "turtlebot-2 moves 60 m away, at 2 m/s, for up to 30 s", 150),
    ],
)
def test_shipped_procedure_with_shipped_profiles(
    profile: str, note: str, pings: int, capsys: pytest.CaptureFixture[str]
) -> None:
    loaded_profile = load_profile(profile)
    update = {"profile": loaded_profile, "abilities": frozenset(loaded_profile.sections) & {"drive"}}
    cast = {role: robot.model_copy(update=update) for role, robot in CAST.items()}
    request = TrialRequest(load_procedure("driveaway"), parse_distance("5m"))
    plan = make_plan(request, backend="field", cast=cast, now=datetime(2026, 11, 20, tzinfo=UTC))
    print_commands(plan)
    out = capsys.readouterr().out
    assert note in out
    assert f"-c {pings} -i 0.2" in out
    assert "refused" not in out
    measured = {column.name for column in plan.columns or ()} & {column.name for column in drive_log.COLUMNS}
    assert bool(measured) == ("drive" in loaded_profile.sections), "only a driving robot has columns of a drive"


def test_top_speed_is_the_default() -> None:
    step = move(f"robot: receiver, path: [{{away: 1m}}], {PING}")
    assert step.resolved(CAST).motion.speed_m_s == 0.22
    with pytest.raises(ValueError, match="has no speed"):
        _ = step.motion


def test_adjustments_describe_the_reduction() -> None:
    text = f"robot: receiver, path: [{{away: 40m}}], within_limits: true, {PING}"
    assert list(move(text).adjustments(CAST)) == [
        "turtlebot-2 moves 29.5 m away, at 0.22 m/s; 40 m away, at 0.22 m/s is beyond its limits"
    ]
    assert not list(move(text.replace("40m", "30m")).adjustments(CAST))
    assert not list(move(text.replace("within_limits: true, ", "")).adjustments(CAST))


def test_procedure_of_a_plan_is_written_and_read() -> None:
    plan = los_plan().model_copy(update={"procedure": load_procedure("driveaway").resolved(CAST)})
    parsed = schema.validate(schema.parse(schema.dump(plan.procedure), source="trial.yaml"), Procedure)
    assert parsed == plan.procedure
    assert "within_limits" not in schema.dump(parsed)
    assert "along" not in schema.dump(parsed)


lengths = st.floats(-30, 30).map(lambda metres: round(metres, 2))
legs = st.lists(st.builds(Leg, lengths, lengths).filter(lambda leg: leg != Leg()), min_size=1, max_size=5)


@given(legs, st.floats(0.5, 40))
def test_path_is_shortened_at_the_fence(path: list[Leg], fence_m: float) -> None:
    shortened = driven_paths.clip_path(path, fence_m)
    assert driven_paths.farthest_m(shortened) <= fence_m + 1e-6
    if driven_paths.farthest_m(path) <= fence_m:
        assert list(shortened) == path
        return
    n_complete = len(shortened) - 1
    assert list(shortened[:n_complete]) == path[:n_complete]
    end = math.hypot(sum(leg.away_m for leg in shortened), sum(leg.left_m for leg in shortened))
    assert end == pytest.approx(fence_m, abs=1e-6)
    last_leg, leg = shortened[n_complete], path[n_complete]
    assert last_leg.away_m * leg.left_m == pytest.approx(last_leg.left_m * leg.away_m, abs=1e-6), (
        "the last leg has the direction of the planned leg"
    )
    assert math.hypot(last_leg.away_m, last_leg.left_m) <= math.hypot(leg.away_m, leg.left_m) + 1e-6


@given(legs, st.floats(0.5, 40))
def test_shortened_path_is_valid_in_a_procedure(path: list[Leg], fence_m: float) -> None:
    segments = [PathLeg.of(leg) for leg in driven_paths.clip_path(path, fence_m)]
    for segment, leg in zip(segments, path, strict=False):
        if segment is not None:
            parsed = schema.validate(schema.parse(schema.dump(segment), source="x.yaml"), PathLeg)
            assert parsed == segment
            assert abs(parsed.leg.away_m) <= abs(leg.away_m) + 1e-9
            assert parsed.leg.away_m * leg.away_m >= 0
            assert parsed.leg.left_m * leg.left_m >= 0


def test_driving_robot_has_columns_and_time_for_the_return() -> None:
    text = f"robot: receiver, path: [{{away: 2m}}], speed: 0.2m/s, {PING}"
    driving_robots = {
        role: robot.model_copy(update={"abilities": frozenset({"drive"})}) for role, robot in CAST.items()
    }
    driving_step, moved_by_person = resolved_move(text, driving_robots), resolved_move(text)
    assert {column.name for column in driving_step.output_columns()} >= {
        "drive_out_m",
        "drive_back_off_m",
        "drive_ended",
    }
    assert not moved_by_person.output_columns()
    assert driving_step.expected_s(Protocol.UDP) == moved_by_person.expected_s(Protocol.UDP) + 10.0
