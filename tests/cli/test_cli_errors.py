"""Invalid command lines: one error message, a remedy and the right exit code for each."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from fieldkit import __version__
from fieldkit.cli import main
from fieldkit.cli.operators import Terminal
from fieldkit.core.errors import ConfigurationError
from tests.helpers.runs import fieldkit

SITE = """\
robots:
  a: {profile: turtlebot3_burger}
  b: {profile: turtlebot3_burger}
roles:
  master: {sender: a, receiver: b}
"""


@pytest.fixture(autouse=True)
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("command_line", "message"),
    [
        ("trial los 30", "distance '30' has no unit"),
        ("trial los 30feet", "unknown unit 'feet'"),
        ("trial lso 30ft", "did you mean 'los'?"),
        ("trial los 30ft --record 2", "--record '2' has no unit"),
        ("trial los 30ft --record 0s", "records nothing"),
        ("trial los 30ft --backend emulatd", "no backend 'emulatd'"),
        ("trial los 30ft --backend field", "needs a site file"),
        ("trial los 30ft --site nope.yaml", "No such file"),
        ("trial los 30ft --out /proc/trials", "no trial can be stored there"),
        ("trial los 30ft --answers nope.txt", "the answers cannot be read"),
        ("robots show turtlebot3_burgr", "did you mean 'turtlebot3_burger'?"),
        ("procedures show loss", "did you mean 'los'?"),
        ("columns show iploss", "did you mean 'ip_loss'?"),
        ("columns ip_loss", "remedy: fieldkit columns show ip_loss"),
        ("rebuild .", "there is no trial.yaml"),
    ],
)
def test_an_invalid_argument_is_exit_2_with_a_remedy(
    command_line: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(command_line.split()) == 2
    output = capsys.readouterr()
    assert message in output.err
    assert "remedy:" in output.err
    assert "Traceback" not in output.err


@pytest.mark.parametrize(("content", "message"), [(None, "No such file"), (b"float64 \xff", "it is not UTF-8")])
def test_a_definition_that_cannot_be_read_is_exit_2(
    lab: Path, content: bytes | None, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    if content is not None:
        (lab / "Radio.msg").write_bytes(content)
    command_line = ("--from", "ros1", "--to", "dds", "/radio:lab_msgs/Radio", "--type", "lab_msgs/Radio=Radio.msg")
    assert main(["bridge", *command_line]) == 2
    assert capsys.readouterr().err.startswith(f"error: Radio.msg: cannot be read: {message}")


@pytest.mark.parametrize(
    "command_line",
    [
        "trail los 30ft",
        "trial los",
        "trial los 30ft --repeats 0",
        "trial los 30ft --repeats many",
        "trial los 30ft --seed -1",
        "trial los 30ft --protocol sctp",
        "trial los 30ft --topology mesh",
        "robots shwo x",
    ],
)
def test_an_invalid_command_line_is_exit_2_with_a_remedy(
    command_line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(command_line.split()) == 2
    assert re.fullmatch(r"error: .+\n  remedy: .+\n", capsys.readouterr().err)


def test_mistyped_command_suggests_the_right_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["trail", "los", "30ft"]) == 2
    message = capsys.readouterr().err
    assert message.startswith("error: COMMAND cannot be 'trail'; it is one of: init, enroll, ")
    assert message.endswith("\n  remedy: did you mean 'trial'?\n")
    assert main(["trial", "los"]) == 2
    assert capsys.readouterr().err.endswith("\n  remedy: fieldkit trial --help\n")


def test_messages_about_arguments_name_the_minimum_and_only_required_arguments(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["trial", "los", "30ft", "--repeats", "-2"]) == 2
    assert "'-2' is not a whole number of at least 1" in capsys.readouterr().err
    assert main(["compare", "a"]) == 2
    assert capsys.readouterr().err.startswith("error: compare needs two runs, A and B, and one is given\n")


def test_two_robots_with_one_address_are_an_error(lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    robots = "".join(
        f"  {name}: {{profile: turtlebot3_burger, host: {name}, address: 192.0.2.1, user: me, "
        "host_key: ssh-ed25519 AAAA}\n"
        for name in ("a", "b")
    )
    site = f"robots:\n{robots}roles:\n  masterless: {{sender: a, receiver: b}}\n"
    (lab / "fieldkit.yaml").write_text(site, encoding="utf-8")
    command_line = ["trial", "los", "30ft", "--dry-run", "--topology", "masterless", "--backend"]
    assert main([*command_line, "field"]) == 2
    message = "fieldkit.yaml:2: robots 'a' and 'b' have the same address on the radio, 192.0.2.1"
    assert message in capsys.readouterr().err
    assert main([*command_line, "emulated"]) == 0, "the emulated backend assigns other addresses"


def test_full_output_device_has_a_remedy() -> None:
    with Path("/dev/full").open("w", encoding="ascii") as full_device:
        completed = subprocess.run(
            (sys.executable, "-m", "fieldkit", "columns"),
            stdout=full_device,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    message = "remedy: free some space, then run the command again; finished repeats are saved"
    assert (completed.returncode, completed.stderr) == (
        2,
        f"error: its output: No space left on device\n  {message}\n",
    )


def test_verify_of_a_folder_without_a_trial_is_exit_4(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["verify", "."]) == 4
    assert "no readable manifest" in capsys.readouterr().err


def test_master_topology_without_a_relay_is_an_error(lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (lab / "fieldkit.yaml").write_text(f"backend: emulated\n{SITE}", encoding="utf-8")
    assert main(["trial", "los", "30ft", "--dry-run"]) == 2
    assert "no robot has the role relay in topology master" in capsys.readouterr().err


@pytest.mark.parametrize("backend", ["emulated", "field"])
def test_a_topology_without_roles_names_the_line_of_the_roles(
    lab: Path, capsys: pytest.CaptureFixture[str], backend: str
) -> None:
    robot = "{profile: turtlebot3_burger, host: 192.0.2.1, user: me, host_key: ssh-ed25519 AAAA}"
    (lab / "fieldkit.yaml").write_text(f"robots:\n  a: {robot}\nroles: {{}}\n", encoding="utf-8")
    assert main(["trial", "los", "30ft", "--dry-run", "--topology", "masterless", "--backend", backend]) == 2
    error_text = capsys.readouterr().err
    assert "fieldkit.yaml:3: the site file gives no roles for topology masterless" in error_text
    assert error_text.endswith("remedy: add roles.masterless\n")


def test_a_question_without_a_terminal_suggests_an_option() -> None:
    with pytest.raises(ConfigurationError, match="a person must put a and b 5m apart") as error_info:
        Terminal(lambda event: None).ask("put a and b 5m apart")
    assert "--yes" in error_info.value.remedy


def test_version_option_prints_the_version() -> None:
    completed = fieldkit(Path.cwd(), "--version")
    assert (completed.code, completed.out) == (0, f"fieldkit {__version__}\n")


def test_error_in_a_site_file_has_its_line(lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    site = f"backend: emulated\n{SITE}emulated: {{radio: {{los: 10%}}}}\n"
    (lab / "fieldkit.yaml").write_text(site, encoding="utf-8")
    assert main(["trial", "los", "30ft", "--dry-run"]) == 2
    error_text = capsys.readouterr().err
    assert "fieldkit.yaml:7" in error_text
    assert "in emulated.radio: unknown key los; did you mean 'loss'?" in error_text


def test_unknown_backend_of_a_site_file_has_its_line(lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (lab / "fieldkit.yaml").write_text(f"# a lab\nbackend: emulatd\n{SITE}", encoding="utf-8")
    assert main(["trial", "los", "30ft", "--dry-run"]) == 2
    assert "fieldkit.yaml:2: there is no backend 'emulatd'" in capsys.readouterr().err


def test_junit_file_in_a_missing_folder_is_rejected_before_the_trial(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["trial", "los", "5m", "--junit", "no-such-folder/results.xml"]) == 2
    assert "there is no folder 'no-such-folder'" in capsys.readouterr().err
