"""The order to stop all moving robots, with simulated shells."""

import threading
from typing import cast

import pytest

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import LinkError
from fieldkit.motion.steps.robot_mover import RobotMover
from fieldkit.remote.shell import Completed, Shell
from fieldkit.steps.motions import Motions
from tests.helpers.sshd import wait_until


class ScriptedShell:
    """A shell that returns the given answers in order and then repeats the last one; errors are raised."""

    robot = "rover"

    def __init__(self, *answers: str | LinkError) -> None:
        self.prompts: list[tuple[str, ...]] = []
        self._answers = list(answers)

    def run(self, argv: tuple[str, ...], **_: object) -> Completed:
        self.prompts.append(tuple(argv[2:]))
        answer = self._answers.pop(0) if len(self._answers) > 1 else self._answers[0]
        if isinstance(answer, LinkError):
            raise answer
        return Completed(tuple(argv), 0, answer.encode(), b"")


def mover(shell: ScriptedShell, name: str = "rover") -> RobotMover:
    return RobotMover(name, cast("Shell", shell), ".fieldkit/t/a", "it stops automatically within 2 s")


def test_no_order_is_given_without_a_motion() -> None:
    motions = Motions()
    assert not motions.order_stop(pytest.fail)
    with motions.moving(mover(ScriptedShell(""))):
        pass
    assert not motions.order_stop(pytest.fail)
    assert not motions.stop_ordered


def test_each_robot_is_stopped_once_and_the_context_waits_for_the_landing() -> None:
    name, reports = "t/a/.jobs/fly", list[str]()
    drive_shell = ScriptedShell("t/a/.jobs/drive stationary\n")
    fly_shell = ScriptedShell(f"{name} land\n", f"{name} land\n", f"{name} landed\n")
    motions = Motions()
    motions.stop_notes = ("rover stops", "drone lands")
    with (
        motions.moving(mover(drive_shell)),
        motions.moving(mover(fly_shell, "drone")),
        motions.moving(mover(fly_shell, "drone")),
    ):
        assert motions.order_stop(reports.append)
        assert motions.order_stop(reports.append)
    assert drive_shell.prompts == [("halt_motion", "the-operator", ".fieldkit/t/a")]
    assert fly_shell.prompts == [drive_shell.prompts[0], *[("motion_states", name)] * 2]
    assert {"stopping: rover stops", "stopping: drone lands"} < set(reports)
    assert [line.partition(",")[0] for line in reports if line.startswith("drone")] == [
        "drone: coming down (land)",
        "drone: stopped (on the ground)",
    ]
    assert any(line.startswith("rover: stopped (stationary)") for line in reports)


def test_no_robot_starts_to_move_after_the_order() -> None:
    motions, shell, reports = Motions(), ScriptedShell(""), list[str]()
    motions.stop_notes = ("rover stops",)
    assert motions.order_stop(reports.append)
    with pytest.raises(KeyboardInterrupt), motions.moving(mover(shell)):
        pytest.fail("the robot moves")
    assert not shell.prompts
    wait_until(lambda: bool(reports), Deadline.after(60))
    assert reports == ["stopping: no robot moves; stopping the programs on the robots"]


def test_unreachable_robot_is_reported_with_its_fallback() -> None:
    motions, reports = Motions(), list[str]()
    with motions.moving(mover(ScriptedShell(LinkError("the connection broke", where="rover", remedy="")))):
        motions.order_stop(reports.append)
    assert reports == ["no answer from rover: it stops automatically within 2 s (the connection broke)"]


def test_cancelled_wait_does_not_wait_for_the_landing() -> None:
    motions, shell = Motions(), ScriptedShell("t/a/.jobs/fly return\n")
    has_started_landing = threading.Event()
    with motions.moving(mover(shell)):
        motions.order_stop(lambda line: has_started_landing.set() if "coming down (return)" in line else None)
        assert has_started_landing.wait(60)
        motions.cancel_wait()
