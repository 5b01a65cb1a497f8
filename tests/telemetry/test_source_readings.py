"""The file that the sampler of a telemetry source writes, for real commands in each shell, and altered files."""

import subprocess
import time
from pathlib import Path

import pytest

from fieldkit.config import schema
from fieldkit.core.deadline import Deadline
from fieldkit.core.model import Role
from fieldkit.remote.script import SCRIPT
from fieldkit.telemetry import source_readings
from fieldkit.telemetry.source_readings import SourceReadings
from fieldkit.telemetry.telemetry_section import TelemetrySource
from tests.helpers.host import EXITED_STATES
from tests.helpers.sshd import wait_until

SHELLS = {"dash": ("dash",), "bash": ("bash", "--posix"), "busybox": ("busybox", "sh")}
COMMAND = schema.validate(
    schema.parse("command: [x]\nlimit: 1s\nvalues: {signal_dbm: {json: rsrp}}", source="source.yaml"), TelemetrySource
)


@pytest.fixture(params=SHELLS)
def script(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[str, ...]:
    path = tmp_path / "a robot" / "job.sh"
    path.parent.mkdir()
    path.write_bytes(SCRIPT)
    return (*SHELLS[request.param], str(path))


def run_once(script: tuple[str, ...], *argv: str, address: str = "-", tested: str = "-") -> SourceReadings:
    words = (*script, "poll", "/", "-", address, tested, "0", "1", *argv)
    completed = subprocess.run(words, cwd=Path(script[-1]).parent, capture_output=True, timeout=60, check=True)
    assert sorted(path.name for path in Path(script[-1]).parent.iterdir()) == ["job.sh"]
    return source_readings.parse(completed.stdout, COMMAND)


def has_exited(pid: int) -> bool:
    """Return True if a process has exited; it may remain as a zombie if its parent has exited earlier."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()[0] in EXITED_STATES
    except OSError:
        return True


def test_runs_without_a_value_have_a_reason(script: tuple[str, ...]) -> None:
    assert run_once(script, "echo", '{"rsrp": -90}').values == ({"signal_dbm": -90.0},)
    reasons = {
        "no answer in 1 s": ("sh", "-c", "trap '' TERM; sleep 300 & sleep 300"),
        "its output was longer than 64 KiB": ("cat", "/dev/zero"),
        "x is not installed": ("no-such-program",),
        "x failed with exit code 3: no modem": ("sh", "-c", "echo no modem >&2; exit 3"),
        "its output is not JSON: Expecting value: line 1 column 1 (char 0)": ("echo", "<html>"),
        "its output has none of the values": ("echo", "{}"),
    }
    for reason, argv in reasons.items():
        readings = run_once(script, *argv)
        assert (readings.values, readings.runs, readings.reason) == ((), 1, reason)


def test_an_output_cannot_imitate_another_run(script: tuple[str, ...]) -> None:
    forged_output = '==> 1.00 0 13 <==\n{"rsrp": -10}'
    readings = run_once(script, "printf", "%s\n", forged_output)
    assert (readings.values, readings.runs) == ((), 1)


def test_no_query_is_sent_over_the_interface_under_test(script: tuple[str, ...]) -> None:
    marker = Path(script[-1]).parent.parent / "queried"
    readings = run_once(script, "touch", str(marker), address="127.0.0.1", tested="lo")
    assert (readings.values, readings.runs) == ((), 1)
    assert "is reached over the interface under test" in readings.reason
    assert not marker.exists()
    run_once(script, "touch", str(marker), address="127.0.0.1", tested="wlan9")
    assert marker.exists()


def test_errors_of_a_query_with_an_address_are_not_stored(script: tuple[str, ...]) -> None:
    readings = run_once(script, "sh", "-c", "echo password >&2; exit 3", address="127.0.0.1")
    assert readings.reason == "x failed with exit code 3"


def test_the_sampler_and_its_command_stop_immediately(script: tuple[str, ...], tmp_path: Path) -> None:
    started_file = tmp_path / "started"
    words = (
        *script,
        "poll",
        "/",
        "-",
        "-",
        "-",
        "1",
        "60",
        "sh",
        "-c",
        f"echo $$ >'{started_file}'; trap '' TERM; sleep 300",
    )
    with (tmp_path / "output").open("wb") as output:
        process = subprocess.Popen(words, cwd=Path(script[-1]).parent, stdout=output)
    wait_until(
        lambda: started_file.exists() and started_file.read_text(encoding="ascii").strip() != "", Deadline.after(60)
    )
    pid = int(started_file.read_text(encoding="ascii"))
    before_s = time.monotonic()
    process.terminate()
    assert process.wait(60) == 0
    assert time.monotonic() - before_s < 30, "it does not wait for the command, which takes 300 s"
    wait_until(lambda: has_exited(pid), Deadline.after(60))


def test_incomplete_and_altered_files_have_no_values(tmp_path: Path) -> None:
    run = b'==> 1.00 0 14 <==\n{"rsrp": -80}\n\n'
    assert source_readings.parse(run * 2, COMMAND).runs == 2
    for length in range(len(run)):
        assert source_readings.parse(run[:length], COMMAND).runs == 0
    for altered_content in (
        b"",
        b"\0" * 99,
        b"==> 1.00 0 99999 <==\n",
        b"==> 1.00 -1 0 <==\n\n",
        b"==> 1 0 0 <==\n\n",
    ):
        assert source_readings.parse(altered_content, COMMAND).values == ()


def test_bytes_of_the_laptop_that_are_not_utf8_do_not_shift_later_runs(tmp_path: Path) -> None:
    text = "at: laptop\nhttp: {url: http://127.0.0.1/}\nvalues: {signal_dbm: {json: rsrp}}"
    laptop_source = schema.validate(schema.parse(text, source="source.yaml"), TelemetrySource)
    invalid = b'{"rsrp": -90, "name": "\xff\xfe"}\n'
    valid = b'{"rsrp": -91}\n'
    runs = [b"==> 1.00 0 %d <==\n%s\n" % (len(output), output) for output in (invalid, valid)]
    (tmp_path / source_readings.file(Role.SENDER, "router", laptop_source)).write_bytes(b"".join(runs))
    readings = source_readings.read(tmp_path, Role.SENDER, "router", laptop_source)
    assert readings.values == ({"signal_dbm": -90.0}, {"signal_dbm": -91.0})
