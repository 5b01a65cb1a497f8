"""A step `run`: what the robot is told, what of it is refused, what its output is worth."""

import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fieldkit.cli.dry_run import in_shell
from fieldkit.config import schema
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import ConfigurationError, RobotError
from fieldkit.core.model import Distance, Placement, Protocol, Role, Scenario, Topology
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.evidence import printed
from fieldkit.remote import jobs
from fieldkit.remote.shell import Completed
from fieldkit.steps.kinds.run import RunStep
from fieldkit.steps.scene import Scene
from fieldkit.steps.view import View
from tests.helpers.casts import CAST
from tests.helpers.idle_testbed import IdleTestbed
from tests.helpers.paths import ROOT
from tests.helpers.userlands import USERLANDS, LocalShell, path_of

SCENE = Scene(Protocol.TCP, CAST, "folder")
BATTERY = """
robot: receiver
command: vendorctl 'of the' {address.sender} --json
limit: 5s
output: battery.json
columns:
  - {name: volts, unit: V, meaning: Of the battery., json: "cells[0].V", label: battery}
  - {name: mode, unit: text, regex: '"mode": "([a-z]+)"', optional: true}
expect:
  code: [0, 3]
  values: {volts: {min: 3, max: 4.2}}
"""


def run_step(text: str) -> RunStep:
    return schema.validate(schema.parse(text, source="run.yaml"), RunStep)


def test_words_are_those_of_a_shell_and_addresses_are_filled_in() -> None:
    (planned,) = run_step(BATTERY).jobs(SCENE)
    assert planned.role == Role.RECEIVER
    assert planned.program == "vendorctl"
    assert planned.job.argv == ("vendorctl", "of the", "10.42.0.1", "--json")
    assert (planned.job.stdout, planned.job.log, planned.job.limit_s) == ("battery.json", "receiver-run.log", 5.0)
    assert in_shell(planned.job) == (
        "vendorctl 'of the' 10.42.0.1 --json > battery.json 2> receiver-run.log  # at most 1048576 bytes of each"
    )
    assert run_step(BATTERY).roles() == {Role.RECEIVER, Role.SENDER}


def test_a_shell_has_no_say_in_words() -> None:
    (planned,) = run_step("{robot: sender, argv: [echo, '$HOME; rm *', '{print}', '|']}").jobs(SCENE)
    assert planned.job.argv[-4:] == ("echo", "$HOME; rm *", "{print}", "|")


def test_distance_repeat_and_the_copied_program_are_filled_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "probe").write_text("x", encoding="utf-8")
    (tmp_path / "probe").chmod(0o755)
    monkeypatch.chdir(tmp_path)
    step = run_step(
        "{robot: sender, put: probe, name: a, command: '{put} --at={distance} {repeat} {address.sender}'}"
    )
    placement = Placement(Scenario.LOS, Topology.MASTERLESS, Distance(9.144, "30ft"))
    (planned,) = step.jobs(replace(SCENE, placement=placement, repeat=7))
    assert planned.job.argv == (".put/a.run/probe", "--at=30ft", "7", "10.42.0.1")
    assert planned.program == "sh", "preflight cannot find what is not copied yet"
    assert planned.put is not None
    assert (planned.put.role, planned.put.at, planned.put.program) == (Role.SENDER, ".put/a.run/probe", step.put)
    assert step.files() == ("a.run.txt", "a.sender-run.log"), "the copy is not fetched"


@pytest.mark.parametrize(
    ("text", "line", "why"),
    [
        ("robot: sender\ncommand: a {distanse}", 2, "no variable {distanse}; did you mean '{distance}'"),
        ("robot: sender\nargv:\n- a\n- '{repeats}'", 4, "no variable {repeats}; did you mean '{repeat}'"),
        ("robot: sender\ncommand: 'a-{repeat} b'", 2, "the program cannot depend on a variable"),
        ("robot: sender\ncommand: 'sh {put}'", 2, "there is no put:"),
        ("robot: sender\ncommand: sh\nput: LICENSE", 3, "nothing runs LICENSE: write {put} in the command"),
        ("robot: sender\ncommand: '{put}'\nput: LICENSE", 3, "LICENSE is not executable: chmod"),
        ("robot: sender\ncommand: '{put}'\nput: no-such", 3, "there is no file 'no-such'"),
        ("robot: sender", 1, "one of them"),
        ("robot: sender\ncommand: a\nargv: [a]", 1, "one of them"),
        ("robot: sender\ncommand: echo 'a", 2, "cannot be split into words"),
        ("robot: sender\nargv: ['', a]", 2, "the program, is empty"),
        ("robot: sender\ncommand: ls | wc", 2, "no shell sees this command, and | is a shell's"),
        ("robot: sender\ncommand: a {address.Receiver}", 1, "lower-case letters"),
        ("robot: sender\ncommand: a\ncolumns:\n- {name: x, unit: V}", 4, "one of them"),
        ("robot: sender\ncommand: a\ncolumns:\n- {name: x, unit: V, json: 'a['}", 4, "no path into JSON"),
        ("robot: sender\ncommand: a\ncolumns:\n- name: x\n  unit: V\n  regex: 'a'", 6, "0 groups"),
        (
            "robot: sender\ncommand: a\ncolumns:\n- {name: x, unit: V, json: a}\n- {name: x, unit: V, json: b}",
            5,
            "a column x is there already",
        ),
        ("robot: sender\ncommand: a\nexpect:\n  values:\n    y: {min: 1}", 5, "there is no column y"),
        ("robot: sender\ncommand: a\nexpect: {code: []}", 3, "at least 1"),
    ],
)
def test_what_cannot_be_run_or_read_is_refused_at_its_line(
    text: str, line: int, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    with pytest.raises(ConfigurationError, match=why) as caught:
        run_step(text)
    assert caught.value.where == f"run.yaml:{line}"


def test_its_columns_are_those_that_the_procedure_declares() -> None:
    volts, mode = run_step(BATTERY).output_columns()
    assert (volts.name, volts.unit, volts.meaning) == ("volts", "V", "Of the battery.")
    assert (mode.unit, mode.type) == ("text", str)
    assert RunStep.columns == (), "no other trial has them"


def judged(folder: Path, output: str | None, *, after: str = "") -> tuple[dict[str, Any], list[str]]:
    if output is not None:
        (folder / "battery.json").write_text(output, encoding="utf-8")
    (folder / "receiver-after.txt").write_text(after, encoding="utf-8")
    view, step = View(SCENE, AttemptEvidence(folder)), run_step(BATTERY)
    return dict(step.measure(view).values), list(step.check(view))


def test_values_are_read_and_told(tmp_path: Path) -> None:
    values, problems = judged(tmp_path, '{"cells": [{"V": 3.75}], "mode": "auto"}')
    assert (values, problems) == ({"volts": 3.75, "mode": "auto"}, [])
    assert list(run_step(BATTERY).summary(values)) == ["battery 3.75 V", "mode auto"]


def test_what_is_true_or_false_is_said_as_it_stands_in_the_table() -> None:
    step = run_step("{robot: sender, command: a, columns: [{name: up, unit: bool, json: up}]}")
    assert list(step.summary({"up": False})) == ["up false"]


@pytest.mark.parametrize(
    ("output", "problem"),
    [
        ('{"cells": [{"V": 2.5}]}', "battery.json: volts is 2.5, less than 3"),
        ('{"cells": [{"V": 5}]}', "battery.json: volts is 5.0, more than 4.2"),
        ('{"cells": []}', "battery.json: no volts: the value is missing"),
        ('{"cells": [{"V": "high"}]}', "battery.json: no volts: it is 'high', not a number"),
        ('{"cells": [{"V"', "battery.json: no volts: is not JSON"),
        (None, "battery.json: cannot be read"),
        (" " * printed.MOST_BYTES, "battery.json: the program printed more than 1 MiB"),
    ],
)
def test_a_value_that_is_missing_or_out_of_bounds_voids_the_repeat(
    tmp_path: Path, output: str | None, problem: str
) -> None:
    (found,) = judged(tmp_path, output)[1]
    assert found.startswith(problem)


def test_what_is_optional_may_be_missing(tmp_path: Path) -> None:
    values, problems = judged(tmp_path, '{"cells": [{"V": 3.75}]}')
    assert (values, problems) == ({"volts": 3.75}, [])


@pytest.mark.parametrize(("code", "well"), [(0, True), (3, True), (1, False)])
def test_the_exit_code_is_judged_again_by_what_the_robot_noted(tmp_path: Path, code: int, well: bool) -> None:
    after = f"==> jobs <==\nrun itself {code} 100 2.00\n"
    problems = judged(tmp_path, '{"cells": [{"V": 3.75}]}', after=after)[1]
    assert problems == ([] if well else [f"turtlebot-2: vendorctl ended with exit code {code}"])


def test_an_exit_code_that_nobody_expects_fails_the_attempt(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    testbed = IdleTestbed({Role.RECEIVER: LocalShell(tmp_path)})
    monkeypatch.setattr(jobs, "run", lambda shell, job: 1)
    with pytest.raises(RobotError, match="turtlebot-2: vendorctl ended with exit code 1"):
        run_step(BATTERY).run(SCENE, testbed, lambda name, expected_s: None)
    monkeypatch.setattr(jobs, "run", lambda shell, job: 3)
    run_step(BATTERY).run(SCENE, testbed, lambda name, expected_s: None)


def ran(home: Path, userland: str, script: str) -> Completed:
    (planned,) = RunStep.model_validate({"robot": "sender", "argv": ["sh", "-c", script]}).jobs(SCENE)
    robot = LocalShell(home, path_of(userland, home / "bin"))
    return robot.run(jobs.limited_argv(planned.job), deadline=Deadline.after(60.0), check=False)


@pytest.mark.parametrize("userland", USERLANDS)
@pytest.mark.parametrize(
    ("script", "code", "out", "err"),
    [
        ("echo out; echo err >&2; exit 7", 7, b"out\n", b"err\n"),
        ("exit 0", 0, b"", b""),
        ("printf 'no line end'", 0, b"no line end", b""),
    ],
)
def test_outputs_and_exit_code_are_the_program_s(
    tmp_path: Path, userland: str, script: str, code: int, *, out: bytes, err: bytes
) -> None:
    done = ran(tmp_path, userland, script)
    assert (done.exit_code, done.stdout, done.stderr) == (code, out, err)


@pytest.mark.parametrize("userland", USERLANDS)
def test_a_program_that_prints_without_end_is_ended(tmp_path: Path, userland: str) -> None:
    done = ran(tmp_path, userland, "yes")
    assert (done.exit_code, len(done.stdout)) == (128 + signal.SIGPIPE, printed.MOST_BYTES)
    done = ran(tmp_path / "bin", userland, "yes >&2")
    assert (done.exit_code, len(done.stderr)) == (128 + signal.SIGPIPE, printed.MOST_BYTES)


@pytest.mark.parametrize("userland", USERLANDS)
def test_a_program_that_is_killed_says_so_by_its_code(tmp_path: Path, userland: str) -> None:
    assert ran(tmp_path, userland, "kill -KILL $$").exit_code == 128 + signal.SIGKILL
