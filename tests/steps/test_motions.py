"""The order to stop all robots that move, without any robot."""

import threading
from typing import cast

import pytest

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import LinkError
from fieldkit.remote.shell import Completed, Shell
from fieldkit.steps.motions import Motions, Mover
from tests.helpers.sshd import wait_until


class ToldShell:
    """A robot that answers with what it was given, one after the other; an error is raised."""

    robot = "rover"

    def __init__(self, *answers: str | LinkError) -> None:
        self.asked: list[tuple[str, ...]] = []
        self._answers = list(answers)

    def run(self, argv: tuple[str, ...], **_: object) -> Completed:
        self.asked.append(tuple(argv[2:]))
        answer = self._answers.pop(0) if len(self._answers) > 1 else self._answers[0]
        if isinstance(answer, LinkError):
            raise answer
        return Completed(tuple(argv), 0, answer.encode(), b"")


def mover(shell: ToldShell, name: str = "rover") -> Mover:
    return Mover(name, cast("Shell", shell), ".fieldkit/t/a", "it stops automatically within 2 s")


def test_without_motion_nothing_is_ordered() -> None:
    motions = Motions()
    assert not motions.order(pytest.fail)
    with motions.moving(mover(ToldShell(""))):
        pass
    assert not motions.order(pytest.fail)
    assert not motions.called


def test_each_robot_is_told_once_and_leaving_waits_for_the_ground() -> None:
    name, told = "t/a/.jobs/fly", list[str]()
    drives = ToldShell("t/a/.jobs/drive stationary\n")
    flies = ToldShell(f"{name} land\n", f"{name} land\n", f"{name} landed\n")
    motions = Motions()
    motions.ahead = ("rover stops", "drone lands")
    with motions.moving(mover(drives)), motions.moving(mover(flies, "drone")), motions.moving(mover(flies, "drone")):
        assert motions.order(told.append)
        assert motions.order(told.append)
    assert drives.asked == [("halt_motion", "the-operator", ".fieldkit/t/a")]
    assert flies.asked == [drives.asked[0], *[("motion_states", name)] * 2]
    assert {"stopping: rover stops", "stopping: drone lands"} < set(told)
    assert [line.partition(",")[0] for line in told if line.startswith("drone")] == [
        "drone: coming down (land)",
        "drone: stopped (on the ground)",
    ]
    assert any(line.startswith("rover: stopped (standing)") for line in told)


def test_after_the_order_no_robot_begins_to_move() -> None:
    motions, shell, told = Motions(), ToldShell(""), list[str]()
    motions.ahead = ("rover stops",)
    assert motions.order(told.append)
    with pytest.raises(KeyboardInterrupt), motions.moving(mover(shell)):
        pytest.fail("it moves")
    assert not shell.asked
    wait_until(lambda: bool(told), Deadline.after(60))
    assert told == ["stopping: no robot moves; stopping the programs on the robots"]


def test_a_robot_out_of_reach_is_reported_with_what_it_does_by_itself() -> None:
    motions, told = Motions(), list[str]()
    with motions.moving(mover(ToldShell(LinkError("the connection broke", where="rover", remedy="")))):
        motions.order(told.append)
    assert told == ["no answer from rover: it stops automatically within 2 s (the connection broke)"]


def test_who_abandons_the_wait_does_not_wait_for_a_landing() -> None:
    motions, shell = Motions(), ToldShell("t/a/.jobs/fly return\n")
    coming = threading.Event()
    with motions.moving(mover(shell)):
        motions.order(lambda line: coming.set() if "coming down (return)" in line else None)
        assert coming.wait(60)
        motions.abandon()
