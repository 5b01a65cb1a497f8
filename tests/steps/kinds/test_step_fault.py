"""The step `fault`: valid keys, roles, and expected command lines."""

from dataclasses import replace
from typing import cast

import pytest

from fieldkit.backends.protocols import Robot, Testbed
from fieldkit.cli.dry_run import shell_line
from fieldkit.config import schema
from fieldkit.core import model
from fieldkit.core.errors import ConfigurationError, LinkError
from fieldkit.core.model import FIXED_ROLES, Fault, FaultKind, Protocol, Role
from fieldkit.remote import jobs
from fieldkit.ros.steps.record import RecordStep
from fieldkit.steps.base import Step, StepEntry
from fieldkit.steps.kinds import fault as kinds_fault
from fieldkit.steps.kinds.fault import FaultStep
from fieldkit.steps.kinds.ping import PingStep
from fieldkit.steps.scene import Announce, Scene
from fieldkit.steps.variants import PingTool, expected
from fieldkit.trial.procedure import Procedure, load_procedure
from tests.helpers.casts import CAST, TURTLEBOT
from tests.helpers.plans import steps_of

SCENE = Scene(Protocol.TCP, CAST, "f")
NESTED = """\
name: nested
summary: a recording inside a fault inside a capture
scenario: los
topology: masterless
protocols: [udp]
repeats: 1
steps:
  - capture:
      robots: [receiver]
      during:
        - fault:
            robot: relay
            kind: out-of-range
            for: 2s
            during:
              - record: {robot: sender, topics: [/scan], duration: 15s}
  - ping: {from: sender, to: receiver}
"""


def fault(text: str) -> FaultStep:
    return schema.validate(schema.parse(f"{{{text}}}", source="x.yaml"), FaultStep)


def lines(step: FaultStep, scene: Scene = SCENE) -> list[tuple[Role, str]]:
    return [(planned.role, shell_line(planned.job)) for planned in step.jobs(scene)]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("robot: sender, kind: link-down", "a fault of the kind link-down needs the key for:"),
        ("robot: sender, kind: out-of-range", "kind out-of-range needs the key for:"),
        ("robot: sender, kind: reboot, for: 3s", "kind reboot does not allow the key for:"),
        ("robot: sender, kind: kill, process: nc, for: 3s", "kind kill does not allow the key for:"),
        ("robot: sender, kind: kill", "kind kill needs the key process:"),
        ("robot: sender, kind: reboot, process: nc", "kind reboot does not allow the key process:"),
        ("robot: sender, kind: link-down, for: 3", "has no unit"),
        ("robot: sender, kind: link-down, for: 0s", "greater than 0"),
        ("robot: sender, kind: linkdown, for: 3s", "'link-down'"),
        ("robot: Laptop, kind: reboot", "the name of a role consists of lower-case letters"),
        ('robot: sender, kind: kill, process: "nc; reboot"', "is not the name of a process"),
        ("robot: sender, kind: kill, process: longer-than-a-comm", "is not the name of a process, as ps"),
        ("robot: sender, kind: reboot, during: [{ping: {from: sender}}]", "'to' is missing"),
    ],
)
def test_invalid_keys_are_rejected(text: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message) as caught:
        fault(text)
    assert caught.value.where == "x.yaml:1"


def test_link_is_observed_from_the_other_end() -> None:
    step = fault("robot: sender, kind: link-down, for: 3s, after: 1s, during: [{ping: {from: sender, to: receiver}}]")
    first, inside, last = lines(step)
    assert first == (
        Role.RECEIVER,
        "env LC_ALL=C ping -n -D -i 0.1 10.42.0.1 2> fault-link-down-ping.txt",
    )
    assert inside[1].startswith("env LC_ALL=C ping -n -D -c 10 ")
    role, command = last
    assert role is Role.RECEIVER
    assert command.startswith('sh -c \'echo "lasted_s $1"; ')
    assert command.endswith(
        "sh SECONDS 0.1 fault-link-down-ping.txt 'bytes from' 10 > fault-link-down.txt 2> fault-link-down.log"
    )
    assert step.cause == model.Fault(FaultKind.LINK_DOWN, Role.SENDER, 3.0)
    assert step.roles() == {Role.SENDER, Role.RECEIVER}


def test_killed_process_is_observed_on_the_robot_itself() -> None:
    step = fault("robot: receiver, kind: kill, process: nc.traditional")
    (role, watch), (_, recovery) = lines(step)
    assert role is Role.RECEIVER
    assert watch.startswith('sh -c \'echo "watching $1"; while :; do ')
    assert watch.endswith(" sh nc.traditional 0.1 2> fault-kill-watch.txt")
    assert "sh SECONDS 0.1 fault-kill-watch.txt ' up ' 10 > fault-kill.txt" in recovery
    assert step.roles() == {Role.RECEIVER}


def test_commands_of_a_fault_have_one_line() -> None:
    for kind in ("kill, process: nc", "reboot"):
        assert not [line for _, line in lines(fault(f"robot: sender, kind: {kind}")) if "\n" in line]


@pytest.mark.parametrize(
    ("tool", "root", "options"),
    [
        (PingTool.IPUTILS_OLD, False, "-n -D -i 0.2"),
        (PingTool.IPUTILS_OLD, True, "-n -D -i 0.1"),
        (PingTool.BUSYBOX, False, "-i 0.1"),
    ],
)
def test_interval_depends_on_variant_of_ping(tool: PingTool, root: bool, options: str) -> None:
    tools = replace(expected(TURTLEBOT), ping=tool, root=root)
    scene = replace(SCENE, variants={Role.SENDER: tools})
    (role, watch), (_, recovery) = lines(fault("robot: relay, kind: reboot"), scene)
    assert role is Role.SENDER
    assert watch == f"env LC_ALL=C ping {options} 10.42.0.3 2> fault-reboot-ping.txt"
    answers = 5 if "0.2" in options else 10
    assert f"'bytes from' {answers} >" in recovery


def test_steps_inside_a_fault_are_included() -> None:
    procedure = schema.validate(schema.parse(NESTED, source="x"), Procedure)
    assert procedure.roles() == {Role.SENDER, Role.RECEIVER, Role.RELAY}
    (record,) = steps_of(procedure.with_record(2.0), RecordStep)
    assert record.duration == 2.0
    assert procedure.with_record(15.0) == procedure
    assert procedure.expected_s(Protocol.UDP) > 15.0


def test_steps_inside_a_fault_can_be_excluded() -> None:
    procedure = schema.validate(schema.parse(NESTED, source="x"), Procedure)
    assert list(steps_of(procedure, RecordStep, undisturbed=True)) == []
    assert len(list(steps_of(procedure, FaultStep, undisturbed=True))) == 1
    assert len(list(steps_of(procedure, PingStep, undisturbed=True))) == 1


def test_two_faults_of_one_kind_are_rejected() -> None:
    nested_twice = NESTED + "  - fault: {robot: sender, kind: out-of-range, for: 1s}\n"
    with pytest.raises(ConfigurationError, match="a fault out-of-range is defined twice"):
        schema.validate(schema.parse(nested_twice, source="x"), Procedure)


def test_written_procedure_with_faults_is_read_unchanged() -> None:
    procedure = load_procedure("selfheal")
    text = schema.dump(procedure)
    assert schema.validate(schema.parse(text, source="x"), Procedure) == procedure


class RaisingStep(Step):
    """A step that raises an unexpected exception after the fault has failed."""

    def roles(self) -> frozenset[Role]:
        return frozenset({Role.SENDER})

    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        assert scene.halt.wait(60.0)
        raise KeyError("hops")


def test_an_exception_of_an_inner_step_is_not_hidden_by_the_error_of_the_fault(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class UnreachableTestbed:
        shells = dict.fromkeys(FIXED_ROLES)

        def inject(self, fault: Fault) -> float:
            raise LinkError("it cannot be rebooted")

    monkeypatch.setattr(jobs, "start", lambda *_: None)
    monkeypatch.setattr(kinds_fault, "end_inside", lambda *_: None)
    entry = StepEntry("mistaken", RaisingStep())
    step = fault("robot: sender, kind: reboot, after: 0s").model_copy(update={"during": (entry,)})
    with pytest.raises(KeyError, match="hops") as caught:
        step.run(SCENE, cast("Testbed", UnreachableTestbed()), lambda *_: None)
    assert isinstance(caught.value.__cause__, LinkError)


def test_observer_uses_address_of_the_cast() -> None:
    robots = {
        role: Robot(name=f"r-{role}", address=f"10.0.0.{n}", profile=TURTLEBOT) for n, role in enumerate(FIXED_ROLES)
    }
    step = fault("robot: receiver, kind: reboot")
    assert "10.0.0.1 2>" in lines(step, Scene(Protocol.UDP, robots, "f"))[0][1]
