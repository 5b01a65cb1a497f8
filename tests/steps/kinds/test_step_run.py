"""The step `run`: command lines, invalid keys, and values from the output."""

import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fieldkit.cli.dry_run import shell_line
from fieldkit.config import schema
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import ConfigurationError, RobotError
from fieldkit.core.model import Distance, Placement, Protocol, Role, Scenario, Topology
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.evidence import program_output
from fieldkit.remote import jobs
from fieldkit.remote.shell import Completed
from fieldkit.steps.kinds.run import RunStep
from fieldkit.steps.scene import Scene
from fieldkit.steps.view import View
from tests.helpers.casts import CAST
from tests.helpers.idle_testbed import IdleTestbed
from tests.helpers.paths import ROOT
from tests.helpers.userlands import USERLANDS, LocalShell, userland_path

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


def test_command_is_split_into_words_with_addresses() -> None:
    (planned,) = run_step(BATTERY).jobs(SCENE)
    assert planned.role == Role.RECEIVER
    assert planned.program == "vendorctl"
    assert planned.job.argv == ("vendorctl", "of the", "10.42.0.1", "--json")
    assert (planned.job.stdout, planned.job.log, planned.job.limit_s) == ("battery.json", "receiver-run.log", 5.0)
    assert shell_line(planned.job) == (
        "vendorctl 'of the' 10.42.0.1 --json > battery.json 2> receiver-run.log  # at most 1048576 bytes of each"
    )
    assert run_step(BATTERY).roles() == {Role.RECEIVER, Role.SENDER}


def test_words_are_not_interpreted_by_a_shell() -> None:
    (planned,) = run_step("{robot: sender, argv: [echo, '$HOME; rm *', '{print}', '|']}").jobs(SCENE)
    assert planned.job.argv[-4:] == ("echo", "$HOME; rm *", "{print}", "|")


def test_variables_are_replaced_by_their_values(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "probe").write_text("x", encoding="utf-8")
    (tmp_path / "probe").chmod(0o755)
    monkeypatch.chdir(tmp_path)
    step = run_step(
        "{robot: sender, put: probe, name: a, command: '{put} --at={distance} {repeat} {address.sender}'}"
    )
    placement = Placement(Scenario.LOS, Topology.MASTERLESS, Distance(9.144, "30ft"))
    (planned,) = step.jobs(replace(SCENE, placement=placement, repeat=7))
    assert planned.job.argv == (".put/a.run/probe", "--at=30ft", "7", "10.42.0.1")
    assert planned.program == "sh", "a preflight check cannot find a program that is not copied yet"
    assert planned.put is not None
    assert (planned.put.role, planned.put.at, planned.put.program) == (Role.SENDER, ".put/a.run/probe", step.put)
    assert step.files() == ("a.run.txt", "a.sender-run.log"), "the copy is not fetched"


@pytest.mark.parametrize(
    ("text", "line", "reason"),
    [
        ("robot: sender\ncommand: a {distanse}", 2, "no variable {distanse}; did you mean '{distance}'"),
        ("robot: sender\nargv:\n- a\n- '{repeats}'", 4, "no variable {repeats}; did you mean '{repeat}'"),
        ("robot: sender\ncommand: 'a-{repeat} b'", 2, "the name of the program must not depend on a variable"),
        ("robot: sender\ncommand: 'sh {put}'", 2, "the step has no put:"),
        (
            "robot: sender\ncommand: sh\nput: LICENSE",
            3,
            "the command does not run LICENSE: write {put} in the command",
        ),
        ("robot: sender\ncommand: '{put}'\nput: LICENSE", 3, "LICENSE is not executable: chmod"),
        ("robot: sender\ncommand: '{put}'\nput: no-such", 3, "there is no file 'no-such'"),
        ("robot: sender", 1, "needs either command: or argv:"),
        ("robot: sender\ncommand: a\nargv: [a]", 1, "needs either command: or argv:"),
        ("robot: sender\ncommand: echo 'a", 2, "cannot be split into words"),
        ("robot: sender\nargv: ['', a]", 2, "the program, which is the first word, is empty"),
        ("robot: sender\ncommand: ls | wc", 2, "| is a shell operator, but no shell runs this command"),
        ("robot: sender\ncommand: a {address.Receiver}", 1, "lower-case letters"),
        ("robot: sender\ncommand: a\ncolumns:\n- {name: x, unit: V}", 4, "needs either json: or regex:"),
        ("robot: sender\ncommand: a\ncolumns:\n- {name: x, unit: V, json: 'a['}", 4, "is not a valid JMESPath"),
        ("robot: sender\ncommand: a\ncolumns:\n- name: x\n  unit: V\n  regex: 'a'", 6, "0 groups"),
        (
            "robot: sender\ncommand: a\ncolumns:\n- {name: x, unit: V, json: a}\n- {name: x, unit: V, json: b}",
            5,
            "there is already a column x",
        ),
        ("robot: sender\ncommand: a\nexpect:\n  values:\n    y: {min: 1}", 5, "there is no column y"),
        ("robot: sender\ncommand: a\nexpect: {code: []}", 3, "at least 1"),
    ],
)
def test_invalid_keys_are_rejected_with_their_line(
    text: str, line: int, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    with pytest.raises(ConfigurationError, match=reason) as caught:
        run_step(text)
    assert caught.value.where == f"run.yaml:{line}"


def test_the_procedure_declares_the_columns() -> None:
    volts, mode = run_step(BATTERY).output_columns()
    assert (volts.name, volts.unit, volts.meaning) == ("volts", "V", "Of the battery.")
    assert (mode.unit, mode.type) == ("text", str)
    assert RunStep.columns == (), "other trials do not have them"


def values_and_problems(folder: Path, output: str | None, *, after: str = "") -> tuple[dict[str, Any], list[str]]:
    if output is not None:
        (folder / "battery.json").write_text(output, encoding="utf-8")
    (folder / "receiver-after.txt").write_text(after, encoding="utf-8")
    view, step = View(SCENE, AttemptEvidence(folder)), run_step(BATTERY)
    return dict(step.measure(view).values), list(step.check(view))


def test_values_of_the_output_are_measured_and_summarized(tmp_path: Path) -> None:
    values, problems = values_and_problems(tmp_path, '{"cells": [{"V": 3.75}], "mode": "auto"}')
    assert (values, problems) == ({"volts": 3.75, "mode": "auto"}, [])
    assert list(run_step(BATTERY).summary(values)) == ["battery 3.75 V", "mode auto"]


def test_summary_of_bool_is_as_in_the_table() -> None:
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
        (" " * program_output.MAX_OUTPUT_BYTES, "battery.json: the program printed more than 1 MiB"),
    ],
)
def test_missing_or_out_of_bounds_value_makes_repeat_void(tmp_path: Path, output: str | None, problem: str) -> None:
    (reason,) = values_and_problems(tmp_path, output)[1]
    assert reason.startswith(problem)


def test_optional_value_may_be_missing(tmp_path: Path) -> None:
    values, problems = values_and_problems(tmp_path, '{"cells": [{"V": 3.75}]}')
    assert (values, problems) == ({"volts": 3.75}, [])


@pytest.mark.parametrize(("code", "is_valid"), [(0, True), (3, True), (1, False)])
def test_recorded_exit_code_is_checked(tmp_path: Path, code: int, is_valid: bool) -> None:
    after = f"==> jobs <==\nrun itself {code} 100 2.00\n"
    problems = values_and_problems(tmp_path, '{"cells": [{"V": 3.75}]}', after=after)[1]
    assert problems == ([] if is_valid else [f"turtlebot-2: vendorctl ended with exit code {code}"])


def test_unexpected_exit_code_fails_the_attempt(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    testbed = IdleTestbed({Role.RECEIVER: LocalShell(tmp_path)})
    monkeypatch.setattr(jobs, "run", lambda shell, job: 1)
    with pytest.raises(RobotError, match="turtlebot-2: vendorctl ended with exit code 1"):
        run_step(BATTERY).run(SCENE, testbed, lambda name, expected_s: None)
    monkeypatch.setattr(jobs, "run", lambda shell, job: 3)
    run_step(BATTERY).run(SCENE, testbed, lambda name, expected_s: None)


def run_script(home: Path, userland: str, script: str) -> Completed:
    (planned,) = RunStep.model_validate({"robot": "sender", "argv": ["sh", "-c", script]}).jobs(SCENE)
    robot = LocalShell(home, userland_path(userland, home / "bin"))
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
def test_output_and_exit_code_are_those_of_the_program(
    tmp_path: Path, userland: str, script: str, code: int, *, out: bytes, err: bytes
) -> None:
    result = run_script(tmp_path, userland, script)
    assert (result.exit_code, result.stdout, result.stderr) == (code, out, err)


@pytest.mark.parametrize("userland", USERLANDS)
def test_program_with_endless_output_is_stopped(tmp_path: Path, userland: str) -> None:
    result = run_script(tmp_path, userland, "yes")
    assert (result.exit_code, len(result.stdout)) == (128 + signal.SIGPIPE, program_output.MAX_OUTPUT_BYTES)
    result = run_script(tmp_path / "bin", userland, "yes >&2")
    assert (result.exit_code, len(result.stderr)) == (128 + signal.SIGPIPE, program_output.MAX_OUTPUT_BYTES)


@pytest.mark.parametrize("userland", USERLANDS)
def test_the_exit_code_of_a_killed_program_contains_its_signal(tmp_path: Path, userland: str) -> None:
    assert run_script(tmp_path, userland, "kill -KILL $$").exit_code == 128 + signal.SIGKILL
