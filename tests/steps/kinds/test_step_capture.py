"""The step `capture`: captures start together with the first inner step, and are stopped if it cannot start."""

import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from fieldkit.config import schema
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import RobotError
from fieldkit.core.model import Protocol, RepeatId, Role, Verdict
from fieldkit.remote import jobs
from fieldkit.remote.jobs import Job
from fieldkit.remote.shell import Shell
from fieldkit.steps import base
from fieldkit.steps.kinds.capture import CaptureStep
from fieldkit.steps.scene import Announce, CommandResult, Scene
from tests.helpers.casts import CAST, los_plan
from tests.helpers.idle_testbed import IdleTestbed
from tests.helpers.userlands import LocalShell

TEXT = "{during: [{ping: {from: sender, to: receiver}}]}"
TIMEOUT_S = 60.0


def run(home: Path, patch: pytest.MonkeyPatch, prepare: Callable[[], None], barrier: threading.Barrier) -> list[str]:
    """Run a capture around a step with this `prepare` function; return the phases, the stops and the error in order.

    The barrier ensures that the starts of the captures and `prepare` run at the same time.
    """
    events: list[str] = []

    def start(_shell: Shell, _job: Job) -> None:
        barrier.wait(TIMEOUT_S)

    def stop(shell: Shell, _job: Job, **_: object) -> int:
        events.append(f"end on {shell.robot}")
        return 0

    def prepare_step(*_: object) -> Callable[[Announce], None]:
        barrier.wait(TIMEOUT_S)
        prepare()
        return lambda announce: announce("inside", None)

    patch.setattr(jobs, "start", start)
    patch.setattr(jobs, "stop", stop)
    patch.setattr(base, "prepare", prepare_step)
    step = schema.validate(schema.parse(TEXT, source="x.yaml"), CaptureStep)
    shells = {role: LocalShell(home, robot=role) for role in step.robots}
    try:
        step.run(Scene(Protocol.TCP, CAST, "f"), IdleTestbed(shells), lambda name, _: events.append(name))
    except RobotError as error:
        events.append(error.what)
    return events


def test_first_step_inside_is_prepared_while_captures_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    events = run(tmp_path, monkeypatch, lambda: None, threading.Barrier(3))
    assert events[:3] == ["start captures", "inside", "drain captures"]
    assert sorted(events[3:]) == [f"end on {role}" for role in sorted((Role.SENDER, Role.RECEIVER))]


def test_step_inside_waits_for_captures_with_sudo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """sudo may take longer than the time for which a UDP listener waits for its sender."""
    events: list[str] = []
    preparing = threading.Event()

    def start(shell: Shell, _job: Job) -> None:
        assert not preparing.wait(0.1)
        events.append(f"capture on {shell.robot}")

    def prepare_step(*_: object) -> Callable[[Announce], None]:
        preparing.set()
        return lambda _: events.append("inside")

    profile = CAST[Role.SENDER].profile
    tools = profile.tools.model_copy(update={"capture_right": "sudo"})
    robot_with_sudo = CAST[Role.SENDER].model_copy(update={"profile": profile.model_copy(update={"tools": tools})})
    monkeypatch.setattr(jobs, "start", start)
    monkeypatch.setattr(jobs, "stop", lambda *_, **__: 0)
    monkeypatch.setattr(base, "prepare", prepare_step)
    step = schema.validate(schema.parse(TEXT, source="x.yaml"), CaptureStep)
    shells = {role: LocalShell(tmp_path, robot=role) for role in step.robots}
    step.run(Scene(Protocol.TCP, CAST | {Role.SENDER: robot_with_sudo}, "f"), IdleTestbed(shells), lambda *_: None)
    assert sorted(events[:2]) == ["capture on receiver", "capture on sender"]
    assert events[2:] == ["inside"]


def test_captures_are_stopped_if_first_step_inside_cannot_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail() -> None:
        raise RobotError("its port is taken", remedy="use another")

    events = run(tmp_path, monkeypatch, fail, threading.Barrier(3))
    assert (events[0], events[-1]) == ("start captures", "its port is taken")
    assert sorted(events[1:-1]) == [f"end on {role}" for role in sorted((Role.SENDER, Role.RECEIVER))]


def capture_step(text: str) -> CaptureStep:
    return schema.validate(schema.parse(text, source="x.yaml"), CaptureStep)


def test_a_monitor_interface_is_captured_in_addition_to_the_radio_interface() -> None:
    step, scene = capture_step(TEXT.replace("{during", "{monitor: mon0, during")), Scene(Protocol.TCP, CAST, "f")
    plain = capture_step(TEXT)
    new_jobs = [planned for planned in step.jobs(scene) if planned.job.name == "monitor"]
    assert len(list(step.jobs(scene))) == len(list(plain.jobs(scene))) + 2
    for planned, role in zip(new_jobs, (Role.SENDER, Role.RECEIVER), strict=True):
        argv = list(planned.job.argv)
        assert (planned.role, argv[1:5]) == (role, ["-i", "mon0", "-y", "IEEE802_11_RADIO"])
        assert argv[-2:] == ["-w", f"{role}-monitor.pcap"]
        assert planned.job.log == f"{role}-monitor-capture.log"
    new_files = {"sender-monitor.pcap", "receiver-monitor.pcap"}
    new_files |= {name.replace(".pcap", "-capture.log") for name in new_files}
    assert set(step.files()) - set(plain.files()) == new_files
    assert step.captures() == plain.captures()
    assert {column.name for column in step.output_columns()} > {column.name for column in plain.output_columns()}
    assert step.stored_bytes(scene, Role.SENDER) == 2 * plain.stored_bytes(scene, Role.SENDER)


@pytest.mark.parametrize(
    ("code", "text", "verdict"),
    [
        (0, "Data link types for mon0\n  IEEE802_11_RADIO (802.11 plus radiotap header)", Verdict.OK),
        (0, "Data link types for wlan0\n  EN10MB (Ethernet)", Verdict.FAIL),
        (1, "tcpdump: mon0: No such device exists", Verdict.FAIL),
    ],
)
def test_the_monitor_interface_must_provide_radiotap_headers(code: int, text: str, verdict: Verdict) -> None:
    step = capture_step(TEXT.replace("{during", "{monitor: mon0, during"))
    needs = [need for need in step.needs(Scene(Protocol.TCP, CAST, "f")) if "mon0" in need.name]
    assert [need.role for need in needs] == [Role.SENDER, Role.RECEIVER]
    result, _, remedy = needs[0].judge(CommandResult(text, code))
    assert result == verdict
    assert ("type monitor" in remedy) == (verdict is Verdict.FAIL)


def test_a_monitor_interface_belongs_to_the_radio_under_test() -> None:
    with pytest.raises(schema.ValidationError, match="remove `over`"):
        CaptureStep.model_validate({"over": "cell", "monitor": "mon0", "during": [{"wait": {"duration": "1s"}}]})


@pytest.mark.emulated
def test_error_of_start_is_not_hidden_by_error_of_stop(tmp_path: Path) -> None:
    plan, shells = los_plan(), {role: LocalShell(tmp_path) for role in (Role.SENDER, Role.RECEIVER)}
    for shell in shells.values():
        jobs.install(shell, Deadline.after(60))
    scene = plan.scene(RepeatId(Protocol.TCP, 1), jobs.work_folder(plan.trial, "tcp-01-1"))
    (step,) = (entry.step for entry in plan.procedure.steps if isinstance(entry.step, CaptureStep))
    with pytest.raises(RobotError, match="no folder"):
        step.run(scene, IdleTestbed(shells), lambda *_: None)
