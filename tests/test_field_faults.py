"""In the field a person makes the faults: what is asked, in which order, and what is known of how long it lasted."""

import time

import pytest

from fieldkit.field import FieldLab
from fieldkit.model import Fault, FaultKind, Role
from fieldkit.prompts import DONE, Answer
from tests.casts import CAST


class Person:
    """Does what is asked, and remembers when."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self.at_s: list[float] = []

    def ask(self, request: str, *, may_skip: bool = False) -> Answer:
        assert not may_skip, "a fault in the middle of a repeat cannot be left for later"
        self.asked.append(request)
        self.at_s.append(time.monotonic())
        return DONE


@pytest.mark.parametrize(
    ("fault", "asked", "lasted_s"),
    [
        (Fault(FaultKind.REBOOT, Role.RECEIVER), ["reboot turtlebot-2"], 0.0),
        (Fault(FaultKind.KILL, Role.SENDER, process="nc"), ["kill nc on turtlebot-1"], 0.0),
        (
            Fault(FaultKind.OUT_OF_RANGE, Role.SENDER, 10.0),
            ["carry turtlebot-1 out of range, wait 10 s, and back"],
            None,
        ),
    ],
)
def test_one_request(fault: Fault, asked: list[str], lasted_s: float | None) -> None:
    person = Person()
    assert FieldLab(CAST, {}, person).inject(fault) == lasted_s
    assert person.asked == asked


def test_a_link_is_off_between_two_requests() -> None:
    person = Person()
    lasted_s = FieldLab(CAST, {}, person).inject(Fault(FaultKind.LINK_DOWN, Role.SENDER, 0.05))
    assert person.asked == ["switch the Wi-Fi of turtlebot-1 off", "switch the Wi-Fi of turtlebot-1 on again"]
    off_s, on_s = person.at_s
    assert lasted_s is not None
    assert 0.05 <= on_s - off_s <= lasted_s
