"""The step fly: valid keys, refusal of flights beyond the limits of a profile, and preflight checks."""

import json
import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.config import schema
from fieldkit.config.profiles import load_profile
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Protocol, Role, Verdict
from fieldkit.motion.abort_actions import ON_ABORT, AbortActions, OnAbort
from fieldkit.motion.profile_sections import mavlink_of
from fieldkit.motion.steps import arming_need
from fieldkit.motion.steps.fly import FlyStep
from fieldkit.steps.scene import CommandResult, Scene
from fieldkit.trial.procedure import Procedure
from tests.helpers.casts import CAST, los_plan

NESTED_STEPS = "during: [{wait: {duration: 1s}}]"
DRONE = next(role for role, robot in CAST.items() if mavlink_of(robot.profile) is not None)
PERMITTED = {role: robot.model_copy(update={"abilities": frozenset({"mavlink"})}) for role, robot in CAST.items()}
SCENE = Scene(Protocol.TCP, PERMITTED, "f")
LOW_BATTERY = '{"what": "its battery has 10%", "remedy": "charge it", "grave": true}'
WRONG_MODE = '{"what": "PX4 refuses to arm", "remedy": "remove the cause", "grave": false}'
LIMITS = CAST[DRONE].profile.limits


def step(text: str) -> FlyStep:
    return schema.validate(schema.parse(f"{{{text}, {NESTED_STEPS}}}", source="x.yaml"), FlyStep)


def refusal_texts(text: str) -> list[str]:
    return [refusal.what for refusal in step(text).refusals(Scene(Protocol.TCP, PERMITTED, "f"))]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("robot: receiver", "'height' is missing"),
        ("robot: receiver, height: 0m", "greater than 0"),
        ("robot: receiver, height: 2", "has no unit"),
        ("robot: receiver, height: 2m, path: [{up: 1m, down: 1m}]", "up or down, not both; make two segments"),
        ("robot: receiver, height: 2m, path: [{}]", "towards, left, right, up or down"),
        ("robot: receiver, height: 2m, path: [{down: 2m}]", "leads to the ground"),
        ("robot: receiver, height: 2m, then: hover", "land.*return"),
        ("robot: receiver, height: 2m, lease: 1s", "greater than or equal to 3"),
        ("robot: receiver, height: 2m, speed: 0m/s", "greater than 0"),
    ],
)
def test_invalid_keys_are_refused(text: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        step(text)


metres = st.floats(0.1, 80).map(lambda value: round(value, 1))
paths = st.lists(st.tuples(metres, metres, metres), max_size=4)


@given(metres, paths, st.floats(0.1, 6).map(lambda value: round(value, 1)))
def test_flight_is_refused_if_and_only_if_it_exceeds_a_limit(
    height_m: float, path: list[tuple[float, float, float]], speed_m_s: float
) -> None:
    legs = ", ".join(f"{{away: {away}m, left: {left}m, up: {up}m}}" for away, left, up in path)
    reasons = refusal_texts(f"robot: {DRONE}, height: {height_m}m, speed: {speed_m_s}m/s, path: [{legs}]")
    highest_m = height_m + sum(up for _, _, up in path)
    farthest_m = math.hypot(sum(away for away, _, _ in path), sum(left for _, left, _ in path))
    assert LIMITS.max_height_m is not None
    assert LIMITS.fence_m is not None
    values_and_limits = (
        (highest_m, LIMITS.max_height_m),
        (farthest_m, LIMITS.fence_m),
        (speed_m_s, LIMITS.max_speed_m_s),
    )
    if all(abs(value - limit) > 1e-6 for value, limit in values_and_limits):
        assert len(reasons) == sum(value > limit for value, limit in values_and_limits), reasons


def test_robot_without_autopilot_is_refused() -> None:
    ground_robot = next(role for role, robot in CAST.items() if mavlink_of(robot.profile) is None)
    reasons = refusal_texts(f"robot: {ground_robot}, height: 1m")
    assert reasons[0] == "it cannot fly: its profile has no mavlink"
    assert "its profile has no limit for the height" in reasons


def test_size_of_log_grows_with_flight_and_is_on_drone_only() -> None:
    short_flight, long_flight = (
        step(f"robot: {DRONE}, height: 2m, path: [{{away: {distance_m}m}}]") for distance_m in (10, 910)
    )
    assert [role for role in CAST if long_flight.stored_bytes(SCENE, role)] == [DRONE]
    # The flight takes 900 s longer, and the log has ten lines of 100 to 250 bytes per second.
    increase_bytes = long_flight.stored_bytes(SCENE, DRONE) - short_flight.stored_bytes(SCENE, DRONE)
    assert 100 * 9000 < increase_bytes < 250 * 9000


def test_real_drone_needs_permission() -> None:
    (refusal,) = step(f"robot: {DRONE}, height: 1m").refusals(Scene(Protocol.TCP, CAST, "f"))
    assert refusal.what == "it is a real drone, and flights are not allowed"
    assert "--allow-motion" in refusal.remedy


def test_shipped_drone_profiles_have_limits() -> None:
    for name in ("duckiedrone", "iris"):
        limits = load_profile(name).limits
        assert limits.max_height_m is not None
        assert limits.fence_m is not None


@pytest.mark.parametrize(
    ("text", "code", "verdict"),
    [
        ('{"autopilot": "PX4", "charge": 0.97}\n', 0, Verdict.OK),
        ('{"autopilot": "PX4", "charge": null}\n', 0, Verdict.OK),
        (f'{LOW_BATTERY}\n{{"autopilot": "PX4", "charge": 0.1}}\n', 0, Verdict.FAIL),
        (f'{WRONG_MODE}\n{{"autopilot": "PX4", "charge": 1}}\n', 0, Verdict.WARN),
        (f'{WRONG_MODE}\n{LOW_BATTERY}\n{{"autopilot": "PX4", "charge": 0.1}}\n', 0, Verdict.FAIL),
        ("error: no heartbeat from an autopilot at udpout:127.0.0.1:14550 in 5 s\n", 1, Verdict.FAIL),
        ("", 1, Verdict.FAIL),
        ('["PX4"]', 0, Verdict.FAIL),
        ('{"autopilot": 4, "charge": 1}', 0, Verdict.FAIL),
        ('{"autopilot": "PX4", "charge": "full"}', 0, Verdict.FAIL),
        (f'{{"autopilot": "PX4", "charge": {10**400}}}', 0, Verdict.FAIL),
        ('{"what": [1], "remedy": "", "grave": true}\n{"autopilot": "PX4", "charge": 1}', 0, Verdict.FAIL),
        ("[" * 100_000, 0, Verdict.FAIL),
    ],
)
def test_verdict_of_arming_check(text: str, code: int, verdict: Verdict) -> None:
    actual, detail, remedy = arming_need._judge(CommandResult(text, code))
    assert actual is verdict
    assert detail
    assert bool(remedy) == (verdict is not Verdict.OK)
    assert not detail.startswith("error")


@given(st.text(max_size=200))
def test_any_output_has_a_verdict(text: str) -> None:
    assert arming_need._judge(CommandResult(text, 0))[0] in Verdict


def test_arming_check_has_limits_of_the_flight() -> None:
    link, need = step(f"robot: {DRONE}, height: 2m, path: [{{away: 3m, left: 4m, up: 1m}}]").needs(SCENE)
    assert link.name == "MAVLink"
    assert json.loads(link.argv[-1])["connection"] == json.loads(need.argv[-1])["connection"]
    argument = json.loads(need.argv[-1])
    assert need.agent
    assert argument["needs"] == {
        "highest_m": 3.0,
        "farthest_m": 5.0,
        "ceiling_m": LIMITS.max_height_m,
        "least_charge": 0.2,
        "returns": False,
    }


def test_on_abort_needs_a_role_of_the_procedure_and_a_drone() -> None:
    text = """\
name: up
summary: up
scenario: los
topology: masterless
protocols: [udp]
repeats: 1
on_abort: {ROLE: land}
steps: [{ping: {from: sender, to: receiver}}]
"""
    with pytest.raises(ConfigurationError, match="no step has the role relay") as error_info:
        schema.validate(schema.parse(text.replace("ROLE", "relay"), source="x.yaml"), Procedure)
    assert error_info.value.where == "x.yaml:7"
    procedure = schema.validate(schema.parse(text.replace("ROLE", "sender"), source="x.yaml"), Procedure)
    plan = los_plan().model_copy(update={"procedure": procedure})
    assert mavlink_of(plan.cast[Role.SENDER].profile) is None
    (refusal,) = plan.refusals({})
    assert re.search("no mavlink", refusal.what)


def test_abort_notes_describe_the_action() -> None:
    flight = step(f"robot: {DRONE}, height: 2m")
    assert list(flight.abort_notes(SCENE)) == [
        f"{CAST[DRONE].name} lands if it is in the air; this takes up to about 37 s, and continues if fieldkit exits"
    ]
    scene_with_return = Scene(
        Protocol.TCP, PERMITTED, "f", sections={ON_ABORT: AbortActions({DRONE: OnAbort.RETURN})}
    )
    (note,) = flight.abort_notes(scene_with_return)
    assert "returns automatically" in note
