"""In the field the operator causes faults and moves robots: the requests and their order."""

import pytest

from fieldkit.backends.field import FieldTestbed
from fieldkit.backends.protocols import Robot
from fieldkit.core.errors import ConfigurationError, RobotError
from fieldkit.core.model import Fault, FaultKind, Leg, Move, Role
from fieldkit.core.prompts import DONE, Answer, Question
from tests.helpers.casts import CAST


class RecordingOperator:
    """An operator that fulfils and records each request."""

    def __init__(self) -> None:
        self.prompts: list[str] = []

    def ask(self, request: str, *, may_skip: bool = False) -> Answer:
        assert not may_skip, "a fault during a repeat cannot be postponed"
        self.prompts.append(request)
        return DONE

    def enter(self, question: Question) -> str:
        raise AssertionError(question)


@pytest.mark.parametrize(
    ("fault", "requests", "duration_s"),
    [
        (Fault(FaultKind.REBOOT, Role.RECEIVER), ["reboot turtlebot-2"], 0.0),
        (Fault(FaultKind.KILL, Role.SENDER, process="nc"), ["kill nc on turtlebot-1"], 0.0),
        (
            Fault(FaultKind.OUT_OF_RANGE, Role.SENDER, 10.0),
            ["carry turtlebot-1 out of range, wait 10 s, and carry it back"],
            None,
        ),
    ],
)
def test_request_and_duration_of_each_fault(fault: Fault, requests: list[str], duration_s: float | None) -> None:
    operator = RecordingOperator()
    assert FieldTestbed(CAST, {}, operator).inject(fault) == duration_s
    assert operator.prompts == requests


class SlowOperator(RecordingOperator):
    """An operator that needs 2 s for each request, and a simulated clock."""

    def __init__(self) -> None:
        super().__init__()
        self.now_s = 1000.0

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, duration_s: float) -> None:
        self.now_s += duration_s

    def ask(self, request: str, *, may_skip: bool = False) -> Answer:
        self.sleep(2.0)
        return super().ask(request, may_skip=may_skip)


def test_link_down_lasts_from_first_to_second_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    operator = SlowOperator()
    monkeypatch.setattr("fieldkit.backends.field.time", operator)
    assert FieldTestbed(CAST, {}, operator).inject(Fault(FaultKind.LINK_DOWN, Role.SENDER, 10.0)) == 12.0
    assert operator.prompts == ["switch the Wi-Fi of turtlebot-1 off", "switch the Wi-Fi of turtlebot-1 on again"]


MOVE = Move(Role.SENDER, (Leg(away_m=10.0), Leg(left_m=2.0)), 0.2)
START_REQUEST = (
    "move turtlebot-1, as seen from {}: 10 m away, then 2 m left, at 0.2 m/s; answer when it starts to move"
)


def test_operator_moves_robot_and_brings_it_back() -> None:
    operator = RecordingOperator()
    with FieldTestbed(CAST, {}, operator).moving(MOVE):
        assert operator.prompts == [START_REQUEST.format("duckiedrone-1")]
    assert operator.prompts[1:] == ["bring turtlebot-1 back to its place"]


@pytest.mark.parametrize("error", [RobotError("x", remedy="y"), KeyboardInterrupt()])
def test_robot_is_brought_back_after_error_but_not_after_ctrl_c(error: BaseException) -> None:
    operator = RecordingOperator()
    robots_without_relay: dict[Role, Robot] = {role: CAST[role] for role in (Role.SENDER, Role.RECEIVER)}
    with pytest.raises(type(error)), FieldTestbed(robots_without_relay, {}, operator).moving(MOVE):
        raise error
    last_requests = ["bring turtlebot-1 back to its place"] if isinstance(error, Exception) else []
    assert operator.prompts == [START_REQUEST.format("turtlebot-2"), *last_requests]


def test_a_failed_move_is_reported_even_if_the_operator_does_not_bring_the_robot_back() -> None:
    class Leaving(RecordingOperator):
        def ask(self, request: str, *, may_skip: bool = False) -> Answer:
            if request.startswith("bring"):
                raise ConfigurationError(f"there is no further answer for: {request}")
            return super().ask(request, may_skip=may_skip)

    with pytest.raises(ConfigurationError) as error_info, FieldTestbed(CAST, {}, Leaving()).moving(MOVE):
        raise RobotError("its wheel is blocked", remedy="y")
    assert error_info.value.what.startswith(
        "there is no further answer for: bring turtlebot-1 back to its place; before that, the move failed"
    )
    assert "its wheel is blocked" in error_info.value.what
