"""A capture on robots that this machine plays."""

from pathlib import Path

import pytest

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import RobotError
from fieldkit.core.model import Protocol, RepeatId, Role
from fieldkit.remote import jobs
from fieldkit.steps.capture import CaptureStep
from tests.helpers.casts import los_plan
from tests.helpers.idle_testbed import IdleTestbed
from tests.helpers.userlands import LocalShell


@pytest.mark.emulated
def test_what_keeps_a_capture_from_its_start_is_not_hidden_by_its_end(tmp_path: Path) -> None:
    plan, shells = los_plan(), {role: LocalShell(tmp_path) for role in (Role.SENDER, Role.RECEIVER)}
    for shell in shells.values():
        jobs.install(shell, Deadline.after(60))
    scene = plan.scene(RepeatId(Protocol.TCP, 1), jobs.work_folder(plan.trial, "tcp-01-1"))
    (step,) = (entry.step for entry in plan.procedure.steps if isinstance(entry.step, CaptureStep))
    with pytest.raises(RobotError, match="no folder"):
        step.run(scene, IdleTestbed(shells), lambda *_: None)
