"""Loads of iperf3: command lines, refusals, and measurements from the reports."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from fieldkit.cli.dry_run import shell_line
from fieldkit.config import schema
from fieldkit.core.errors import ConfigurationError, RobotError
from fieldkit.core.model import FIXED_ROLES, Protocol, Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.remote import jobs
from fieldkit.remote.jobs import Job
from fieldkit.remote.shell import Shell
from fieldkit.steps.base import Step
from fieldkit.steps.capabilities import SendsTraffic, Summarizes
from fieldkit.steps.scene import Scene
from fieldkit.steps.view import View
from fieldkit.trial.procedure import Procedure
from tests.helpers.casts import CAST
from tests.helpers.idle_testbed import IdleTestbed
from tests.helpers.paths import DATA
from tests.helpers.userlands import LocalShell

HEAD = "name: x\nsummary: X\nscenario: los\ntopology: masterless\nprotocols: [udp]\nrepeats: 1\nsteps:\n"


def step_of(text: str) -> Step:
    return procedure(text).steps[0].step


def procedure(text: str) -> Procedure:
    return schema.validate(schema.parse(f"{HEAD}- {text}\n", source="x.yaml"), Procedure)


def lines(step: Step, protocol: Protocol) -> list[tuple[Role, str]]:
    return [(planned.role, shell_line(planned.job)) for planned in step.jobs(Scene(protocol, CAST, "f"))]


SERVER = "iperf3 -s -1 -p 5201 -i 1 --json > receiver-iperf3.json 2> receiver-iperf3.log"
IPERF3_OUTPUT = "-i 1 --json > sender-iperf3.json 2> sender-iperf3.log"


@pytest.mark.parametrize(
    ("keys", "protocol", "options"),
    [
        ("", Protocol.TCP, "-t 10"),
        ("", Protocol.UDP, "-u -l 1400 -b 1000000 -t 10"),
        (", rate: 5Mbit/s, duration: 3s", Protocol.UDP, "-u -l 1400 -b 5000000 -t 3"),
        (", rate: 5Mbit/s, streams: 4", Protocol.TCP, "-l 8192 -b 5000000 -P 4 -t 10"),
        (", protocol: tcp, size: 2MB", Protocol.UDP, "-n 2000000"),
        (", protocol: udp, payload_bytes: 200, reverse: true", Protocol.TCP, "-u -l 200 -b 1000000 -t 10 -R"),
    ],
)
def test_command_lines_of_both_ends(keys: str, protocol: Protocol, options: str) -> None:
    step = step_of(f"iperf3: {{from: sender, to: receiver{keys}}}")
    client = f"iperf3 -c 10.42.0.2 -p 5201 {options} {IPERF3_OUTPUT}"
    assert lines(step, protocol) == [(Role.RECEIVER, SERVER), (Role.SENDER, client)]
    server, _ = step.jobs(Scene(protocol, CAST, "f"))
    assert server.job.ready == "tcp:1451", "its control connection uses TCP"


def test_soak_runs_before_and_after_its_inner_steps() -> None:
    inner_step = "ping: {from: sender, to: receiver}"
    step = step_of(f"soak: {{from: receiver, to: sender, rate: 3Mbit/s, during: [{inner_step}]}}")
    server, client, ping = lines(step, Protocol.UDP)
    assert server == (Role.SENDER, "iperf3 -s -1 -p 5202 2> sender-soak.log")
    assert client[1].endswith(
        "sh wlan0 iperf3 -c 10.42.0.1 -p 5202 -u -l 1400 -b 3000000 -t 86400 2> receiver-soak.log"
    )
    assert "ping" in ping[1]
    all_jobs = [planned.job for planned in step.jobs(Scene(Protocol.UDP, CAST, "f"))]
    assert all_jobs[0].limit_s == all_jobs[1].limit_s > all_jobs[2].limit_s


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("iperf3: {from: sender, to: sender}", "sender cannot send to itself"),
        ("iperf3: {from: sender, to: receiver, size: 1MB, duration: 3s}", "leave one out"),
        ("iperf3: {from: sender, to: receiver, size: 0MB}", "greater than 0"),
        ("iperf3: {from: sender, to: receiver, size: 10}", "write for example 10B"),
        ("iperf3: {from: sender, to: receiver, duration: 1500ms}", "whole seconds, not 1.5 s"),
        ("iperf3: {from: sender, to: receiver, duration: 130s}", "so its limit must be longer"),
        ("iperf3: {from: sender, to: receiver, rate: 5}", "write for example 5bit/s"),
        ("iperf3: {from: sender, to: receiver, protocol: sctp}", "tcp"),
        (
            "soak: {from: sender, to: receiver, port: 5201, during: [{iperf3: {from: relay, to: receiver}}]}",
            "port 5201 is used twice",
        ),
    ],
)
def test_error_of_invalid_keys_names_the_line(text: str, reason: str) -> None:
    with pytest.raises(ConfigurationError, match=reason) as caught:
        procedure(text)
    assert caught.value.where == "x.yaml:8"


def test_an_iperf3_inside_a_soak_has_another_port() -> None:
    assert procedure("soak: {from: sender, to: receiver, during: [{iperf3: {from: sender, to: receiver}}]}")


@pytest.mark.parametrize(
    ("keys", "frames"),
    [
        ("protocol: udp, rate: 4Mbit/s, duration: 5s, streams: 2", 2 * 4e6 * 5 / 8 / 1400),
        ("protocol: udp, rate: 1Mbit/s, duration: 8s, payload_bytes: 100", 1e6 / 100),
        ("protocol: udp, rate: 1Mbit/s, duration: 8s, payload_bytes: 2000", 2 * 1e6 / 2000),
        ("protocol: tcp, size: 1448kB", 2 * 1000),
    ],
)
def test_number_of_frames_of_a_flow(keys: str, frames: float) -> None:
    step = step_of(f"iperf3: {{from: sender, to: receiver, {keys}}}")
    assert isinstance(step, SendsTraffic)
    (flow,) = step.flows(Scene(Protocol.UDP, CAST, "f"))
    assert flow.port == 5201
    assert flow.frames == pytest.approx(frames)


def test_capture_around_iperf3_uses_its_port() -> None:
    step = step_of("capture: {during: [{iperf3: {from: sender, to: receiver, port: 7000}}]}")
    first = next(step.jobs(Scene(Protocol.UDP, CAST, "f")))
    assert "port 7000" in first.job.argv[-1]


def evidence(folder: Path, version: str, test: str) -> AttemptEvidence:
    for role, end in (("sender", "client"), ("receiver", "server")):
        shutil.copy(DATA / "iperf3" / version / f"{test}-{end}.json", folder / f"{role}-iperf3.json")
    return AttemptEvidence(folder)


def test_values_are_from_reports_of_sending_and_receiving_end(tmp_path: Path) -> None:
    scene = Scene(Protocol.UDP, CAST, "f")
    step = step_of("iperf3: {from: sender, to: receiver, protocol: udp, reverse: true, duration: 3s}")
    view = View(scene, evidence(tmp_path, "3.12", "udp-reverse"))
    measured = step.measure(view)
    assert not list(step.check(view))
    assert (measured.values["iperf3_sent_bytes"], measured.values["iperf3_received_bytes"]) == (751800, 704200)
    assert "captures" in measured.missing["iperf3_captured_bit_s"]
    assert isinstance(step, Summarizes)
    assert list(step.summary(measured.values)) == ["iperf3 loss 6.2 %", "iperf3 1.87 Mbit/s"]
    declared_columns = {column.name for column in step.output_columns()}
    assert measured.values.keys() | measured.missing.keys() == declared_columns


@pytest.mark.parametrize(
    ("damage", "problem"),
    [
        (lambda path: path.unlink(), "receiver-iperf3.json: cannot be read"),
        (
            lambda path: path.write_text(path.read_text()[:-60]),
            "receiver-iperf3.json: is not JSON of iperf3, or was truncated",
        ),
        (
            lambda path: shutil.copy(DATA / "iperf3" / "3.7" / "refused-client.json", path),
            "receiver-iperf3.json: iperf3 reports: error - unable to connect to server: Connection refused",
        ),
        (
            lambda path: path.write_text('{"start": {}, "intervals": []}'),
            "receiver-iperf3.json: iperf3 measured nothing",
        ),
    ],
)
def test_incomplete_or_failed_report_makes_repeat_void(
    tmp_path: Path, damage: Callable[[Path], object], problem: str
) -> None:
    files = evidence(tmp_path, "3.12", "udp")
    damage(tmp_path / "receiver-iperf3.json")
    view = View(Scene(Protocol.UDP, CAST, "f"), files)
    step = step_of("iperf3: {from: sender, to: receiver}")
    (reason,) = step.check(view)
    assert reason.startswith(problem)
    measured = step.measure(view)
    assert set(measured.values) == {"iperf3_sent_bytes"}


Calls = tuple[list[str], dict[str, int]]


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Calls:
    """Replace the functions of `jobs`; return the list of their calls, and the exit codes to return by call."""
    made_calls: list[str] = []
    codes: dict[str, int] = {}

    def named(verb: str) -> Callable[..., int]:
        def act(shell: Shell, job: Job, *_: object, **__: object) -> int:
            made_calls.append(f"{verb} {job.name} {job.log.partition('-')[0]}")
            return codes.get(f"{verb} {job.name}", 0)

        return act

    class Wait:
        def __init__(self, shell: Shell, job: Job, seconds: float) -> None:
            self.job = job

        def end(self, within_s: float) -> int:
            made_calls.append(f"wait {self.job.name} {self.job.log.partition('-')[0]}")
            return codes.get(f"wait {self.job.name}", 0)

    for verb in ("start", "run", "stop"):
        monkeypatch.setattr(jobs, verb, named(verb))
    monkeypatch.setattr(jobs, "begin_wait", Wait)
    return made_calls, codes


def run_step(step: Step, tmp_path: Path) -> None:
    testbed = IdleTestbed({role: LocalShell(tmp_path) for role in FIXED_ROLES})
    step.run(Scene(Protocol.UDP, CAST, "f"), testbed, lambda name, expected_s: None)


def test_server_that_does_not_exit_is_stopped(calls: Calls, tmp_path: Path) -> None:
    made_calls, codes = calls
    step = step_of("iperf3: {from: sender, to: receiver}")
    expected = ["start iperf3-server receiver", "run iperf3-client sender", "wait iperf3-server receiver"]
    run_step(step, tmp_path)
    assert made_calls == expected
    made_calls.clear()
    codes["wait iperf3-server"] = jobs.STILL_RUNNING
    with pytest.raises(RobotError, match="turtlebot-2: iperf3-server did not exit"):
        run_step(step, tmp_path)
    assert made_calls == [*expected, "stop iperf3-server receiver"]


def test_failure_of_client_is_the_reason(calls: Calls, tmp_path: Path) -> None:
    _, codes = calls
    codes["run iperf3-client"] = jobs.KILLED
    with pytest.raises(RobotError, match="turtlebot-1: iperf3-client ended with exit code 137"):
        run_step(step_of("iperf3: {from: sender, to: receiver}"), tmp_path)


def test_soak_stops_its_load_also_after_an_error_inside(calls: Calls, tmp_path: Path) -> None:
    made_calls, codes = calls
    step = step_of("soak: {from: sender, to: receiver, during: [{ping: {from: sender, to: receiver}}]}")
    run_step(step, tmp_path)
    load = ["start soak receiver", "start soak sender", "run ping sender", "stop soak sender", "stop soak receiver"]
    assert made_calls == load
    made_calls.clear()
    codes["run ping"] = 2
    with pytest.raises(RobotError, match="ping ended with exit code 2"):
        run_step(step, tmp_path)
    assert made_calls == load
