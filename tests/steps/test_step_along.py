"""Steps that take as long as the move around them (`along: true`): ping, wait, topics and iperf3."""

import math
from typing import Any

import pytest

from fieldkit.config import schema
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Role
from fieldkit.ros.steps.topics import TopicsStep
from fieldkit.steps.kinds.iperf3 import Iperf3Step
from fieldkit.steps.kinds.ping import PingStep
from fieldkit.steps.kinds.wait import WaitStep
from fieldkit.trial.procedure import Procedure
from tests.helpers.casts import CAST
from tests.helpers.movers import driving_cast

ENDS = "from: sender, to: receiver"
TEXT = """\
name: along
summary: As long as the path
scenario: los
topology: masterless
protocols: [udp]
repeats: 1
steps:
  - move:
      robot: receiver
      path: [{away: AWAY}]
      speed: 0.2m/s
      during:
        - capture: {robots: [sender], during: [{KIND: {KEYS}}]}
"""


def procedure(kind: str, keys: str, distance: str = "2m") -> Procedure:
    text = TEXT.replace("KIND", kind).replace("KEYS", keys).replace("AWAY", distance)
    return schema.validate(schema.parse(text, source="x.yaml"), Procedure)


def resolved_step(kind: str, keys: str, distance: str = "2m") -> Any:  # noqa: ANN401 (a step of the kind)
    return list(procedure(kind, keys, distance).resolved(CAST).walk())[-1].step


@pytest.mark.motion
def test_each_kind_takes_as_long_as_the_path() -> None:
    ping = resolved_step("ping", f"{ENDS}, along: true, interval: 300ms")
    assert isinstance(ping, PingStep)
    assert (ping.count, ping.along) == (34, False), "10 s are more than 33 intervals"
    assert resolved_step("ping", f"{ENDS}, along: true", distance="1cm").count == 1
    wait = resolved_step("wait", "along: true")
    assert isinstance(wait, WaitStep)
    assert wait.duration == 10.0
    topics = resolved_step("topics", f"{ENDS}, along: true")
    assert isinstance(topics, TopicsStep)
    assert topics.duration == 10.0
    iperf3 = resolved_step("iperf3", f"{ENDS}, along: true, limit: 30s", distance="2.1m")
    assert isinstance(iperf3, Iperf3Step)
    assert (iperf3.duration, iperf3.limit) == (11.0, 41.0), "whole seconds"
    assert resolved_step("ping", f"{ENDS}, count: 7").count == 7


@pytest.mark.motion
def test_driving_robot_needs_time_for_turns() -> None:
    text = TEXT.replace("AWAY", "1m}, {left: 1m").replace("KIND: {KEYS}", "wait: {along: true}")
    turning_procedure = schema.validate(schema.parse(text, source="x.yaml"), Procedure)
    moved_wait, driven_wait = (
        list(turning_procedure.resolved(cast).walk())[-1].step for cast in (CAST, driving_cast(CAST))
    )
    assert isinstance(moved_wait, WaitStep)
    assert isinstance(driven_wait, WaitStep)
    assert moved_wait.duration == 10.0
    # The robot turns by 90 degrees at up to 1 rad/s and brakes twice.
    assert driven_wait.duration == pytest.approx(10.0 + math.pi / 2 + 2.0, abs=1.0)


@pytest.mark.motion
def test_resolved_procedure_is_read_again() -> None:
    for kind, keys in (("ping", ENDS), ("wait", ""), ("topics", ENDS), ("iperf3", ENDS)):
        resolved = procedure(kind, f"{keys}{', ' if keys else ''}along: true", "1.23m").resolved(CAST)
        assert schema.validate(schema.parse(schema.dump(resolved), source="trial.yaml"), Procedure) == resolved


@pytest.mark.parametrize(
    ("kind", "keys", "message"),
    [
        ("ping", f"{ENDS}, along: true, count: 3", "along and count exclude each other"),
        ("topics", f"{ENDS}, along: true, duration: 3s", "along and duration exclude each other"),
        ("iperf3", f"{ENDS}, along: true, duration: 3s", "along and duration exclude each other"),
        ("iperf3", f"{ENDS}, along: true, size: 3MB", "a test has along: true or a size, not both"),
        ("wait", "along: true, until: open the door", "until and along: true"),
        ("wait", "along: true, duration: 3s", "leave one out"),
    ],
)
def test_a_second_duration_is_rejected(kind: str, keys: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message) as caught:
        procedure(kind, keys)
    assert caught.value.where == "x.yaml:13"


def test_along_without_move_is_rejected() -> None:
    text = TEXT[: TEXT.index("  - move")] + f"  - ping: {{{ENDS}, along: true}}\n"
    with pytest.raises(ConfigurationError, match="is allowed only inside a move") as caught:
        schema.validate(schema.parse(text, source="x.yaml"), Procedure)
    assert caught.value.where == "x.yaml:8"


@pytest.mark.motion
def test_innermost_move_determines_the_duration() -> None:
    text = TEXT.replace("capture: {robots: [sender], during: [{KIND: {KEYS}}]}", "move: INNER")
    ping = f"ping: {{{ENDS}, along: true}}"
    inner = f"{{name: inner, robot: sender, path: [{{away: 1m}}], speed: 0.1m/s, during: [{{{ping}}}]}}"
    text = text.replace("INNER", inner).replace("AWAY", "1m")
    steps = list(schema.validate(schema.parse(text, source="x.yaml"), Procedure).resolved(CAST).walk())
    assert {placed.step.robot for placed in steps[:2]} == {Role.SENDER, Role.RECEIVER}  # type: ignore[attr-defined]
    assert steps[-1].step.count == 50  # type: ignore[attr-defined]
