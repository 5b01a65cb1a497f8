"""In the field a person makes the faults and moves the robots: what is asked and in which order."""

import pytest

from fieldkit.backends.field import FieldTestbed
from fieldkit.backends.protocols import Robot
from fieldkit.core.errors import RobotError
from fieldkit.core.model import Fault, FaultKind, Leg, Move, Role
from fieldkit.core.prompts import DONE, Answer, Question
from tests.helpers.casts import CAST


class Person:
    """Does what is asked, and remembers it."""

    def __init__(self) -> None:
        self.asked: list[str] = []

    def ask(self, request: str, *, may_skip: bool = False) -> Answer:
        assert not may_skip, "a fault in the middle of a repeat cannot be left for later"
        self.asked.append(request)
        return DONE

    def enter(self, question: Question) -> str:
        raise AssertionError(question)


@pytest.mark.parametrize(
    ("fault", "asked", "lasted_s"),
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
def test_one_request(fault: Fault, asked: list[str], lasted_s: float | None) -> None:
    person = Person()
    assert FieldTestbed(CAST, {}, person).inject(fault) == lasted_s
    assert person.asked == asked


class Hours(Person):
    """Takes 2 s for each request, by a clock that nothing else moves but sleep."""

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


def test_a_link_is_off_between_the_answers_to_two_requests(monkeypatch: pytest.MonkeyPatch) -> None:
    person = Hours()
    monkeypatch.setattr("fieldkit.backends.field.time", person)
    assert FieldTestbed(CAST, {}, person).inject(Fault(FaultKind.LINK_DOWN, Role.SENDER, 10.0)) == 12.0
    assert person.asked == ["switch the Wi-Fi of turtlebot-1 off", "switch the Wi-Fi of turtlebot-1 on again"]


AWAY = Move(Role.SENDER, (Leg(away_m=10.0), Leg(left_m=2.0)), 0.2)
SET_OFF = "move turtlebot-1, as seen from {}: 10 m away, then 2 m left, at 0.2 m/s; answer when it starts to move"


def test_a_robot_is_driven_and_brought_back() -> None:
    person = Person()
    with FieldTestbed(CAST, {}, person).moving(AWAY):
        assert person.asked == [SET_OFF.format("duckiedrone-1")]
    assert person.asked[1:] == ["bring turtlebot-1 back to its place"]


@pytest.mark.parametrize("error", [RobotError("x", remedy="y"), KeyboardInterrupt()])
def test_an_attempt_that_failed_begins_again_from_the_place_and_ctrl_c_asks_nobody(error: BaseException) -> None:
    person = Person()
    direct: dict[Role, Robot] = {role: CAST[role] for role in (Role.SENDER, Role.RECEIVER)}
    with pytest.raises(type(error)), FieldTestbed(direct, {}, person).moving(AWAY):
        raise error
    back = ["bring turtlebot-1 back to its place"] if isinstance(error, Exception) else []
    assert person.asked == [SET_OFF.format("turtlebot-2"), *back]
