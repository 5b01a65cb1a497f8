"""Steps that last as long as the way of the move around them: ping, wait, topics, iperf3."""

import math
from typing import Any

import pytest

from fieldkit.config import schema
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Role
from fieldkit.steps.kinds.iperf3 import Iperf3Step
from fieldkit.steps.kinds.ping import PingStep
from fieldkit.steps.kinds.topics import TopicsStep
from fieldkit.steps.kinds.wait import WaitStep
from fieldkit.trial.procedure import Procedure
from tests.helpers.casts import CAST

ENDS = "from: sender, to: receiver"
TEXT = """\
name: along
summary: As long as the way
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
        - capture: {robots: [sender], during: [{KIND: {WORDS}}]}
"""


def procedure(kind: str, words: str, away: str = "2m") -> Procedure:
    text = TEXT.replace("KIND", kind).replace("WORDS", words).replace("AWAY", away)
    return schema.validate(schema.parse(text, source="x.yaml"), Procedure)


def fitted(kind: str, words: str, away: str = "2m") -> Any:  # noqa: ANN401 (a step of the kind)
    return list(procedure(kind, words, away).resolved(CAST).walk())[-1].step


def test_each_lasts_as_long_as_the_way() -> None:
    ping = fitted("ping", f"{ENDS}, along: true, interval: 300ms")
    assert isinstance(ping, PingStep)
    assert (ping.count, ping.along) == (34, False), "10 s are 33 intervals and a bit"
    assert fitted("ping", f"{ENDS}, along: true", away="1cm").count == 1
    wait = fitted("wait", "along: true")
    assert isinstance(wait, WaitStep)
    assert wait.duration == 10.0
    topics = fitted("topics", f"{ENDS}, along: true")
    assert isinstance(topics, TopicsStep)
    assert topics.duration == 10.0
    iperf3 = fitted("iperf3", f"{ENDS}, along: true, limit: 30s", away="2.1m")
    assert isinstance(iperf3, Iperf3Step)
    assert (iperf3.duration, iperf3.limit) == (11.0, 41.0), "whole seconds"
    assert fitted("ping", f"{ENDS}, count: 7").count == 7


def test_a_robot_that_drives_by_itself_needs_time_for_its_turns() -> None:
    text = TEXT.replace("AWAY", "1m}, {left: 1m").replace("KIND: {WORDS}", "wait: {along: true}")
    own = schema.validate(schema.parse(text, source="x.yaml"), Procedure)
    drives = {role: one.model_copy(update={"drives": one.profile.drive is not None}) for role, one in CAST.items()}
    moved, driven = (list(own.resolved(cast).walk())[-1].step for cast in (CAST, drives))
    assert isinstance(moved, WaitStep)
    assert isinstance(driven, WaitStep)
    assert moved.duration == 10.0
    # A quarter of a turn at 1 rad/s at most, and it brakes twice.
    assert driven.duration == pytest.approx(10.0 + math.pi / 2 + 2.0, abs=1.0)


def test_what_is_fitted_reads_back() -> None:
    for kind, words in (("ping", ENDS), ("wait", ""), ("topics", ENDS), ("iperf3", ENDS)):
        one = procedure(kind, f"{words}{', ' if words else ''}along: true", "1.23m").resolved(CAST)
        assert schema.validate(schema.parse(schema.dump(one), source="trial.yaml"), Procedure) == one


@pytest.mark.parametrize(
    ("kind", "words", "complaint"),
    [
        ("ping", f"{ENDS}, along: true, count: 3", "along and count exclude each other"),
        ("topics", f"{ENDS}, along: true, duration: 3s", "along and duration exclude each other"),
        ("iperf3", f"{ENDS}, along: true, duration: 3s", "along and duration exclude each other"),
        ("iperf3", f"{ENDS}, along: true, size: 3MB", "a test has along: true or a size, not both"),
        ("wait", "along: true, until: open the door", "or along: true"),
        ("wait", "along: true, duration: 3s", "leave one out"),
    ],
)
def test_a_step_lasts_one_time(kind: str, words: str, complaint: str) -> None:
    with pytest.raises(ConfigurationError, match=complaint) as caught:
        procedure(kind, words)
    assert caught.value.where == "x.yaml:13"


def test_a_step_that_no_way_is_around_lasts_along_none() -> None:
    text = TEXT[: TEXT.index("  - move")] + f"  - ping: {{{ENDS}, along: true}}\n"
    with pytest.raises(ConfigurationError, match="nothing moves around it") as caught:
        schema.validate(schema.parse(text, source="x.yaml"), Procedure)
    assert caught.value.where == "x.yaml:8"


def test_of_two_ways_the_inner_one_counts() -> None:
    text = TEXT.replace("capture: {robots: [sender], during: [{KIND: {WORDS}}]}", "move: INNER")
    ping = f"ping: {{{ENDS}, along: true}}"
    inner = f"{{name: inner, robot: sender, path: [{{away: 1m}}], speed: 0.1m/s, during: [{{{ping}}}]}}"
    text = text.replace("INNER", inner).replace("AWAY", "1m")
    steps = list(schema.validate(schema.parse(text, source="x.yaml"), Procedure).resolved(CAST).walk())
    assert {placed.step.robot for placed in steps[:2]} == {Role.SENDER, Role.RECEIVER}  # type: ignore[attr-defined]
    assert steps[-1].step.count == 50  # type: ignore[attr-defined]
