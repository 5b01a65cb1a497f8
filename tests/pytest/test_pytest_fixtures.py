"""The fixtures `lab`, `robots` and `trial` in realistic tests, on emulated robots, also on the co-simulation."""

import re
import signal
import subprocess
from pathlib import Path

import pytest

from fieldkit.core.deadline import Deadline
from tests.helpers import suites
from tests.helpers.host import descendants, wait_for_end
from tests.helpers.sshd import wait_until
from tests.helpers.suites import SuiteRun

pytestmark = pytest.mark.emulated

COSIMULATED = suites.SITE.replace("ros: builtin", "ros: builtin, physics: kinematic, sync: sliding_window")
SUITE = """
import pytest


def ping(robots, count=3):
    return robots.sender.run(["ping", "-c", str(count), "-i", "0.1", "-W", "1", robots.receiver.address], check=False)


def test_robots_have_names_roles_and_addresses(robots):
    assert [(one.name, one.role, one.profile) for one in robots] == [
        ("rover", "sender", "turtlebot3_burger"), ("base", "receiver", "turtlebot3_burger"),
    ]
    assert robots["base"].address == robots.receiver.address == "10.42.0.2"
    assert robots["base"].run(["hostname"]).stdout == "base\\n"
    assert len(robots) == 2


def test_robots_are_at_their_places(lab, robots):
    assert "3 received" in ping(robots).stdout
    lab.place("350m")
    assert ping(robots).exit_code == 1
    lab.place("5m")
    assert "3 received" in ping(robots).stdout


def test_a_link_is_down_temporarily(lab, robots):
    with robots.sender.running(["ping", "-i", "0.1", robots.receiver.address]) as program:
        lab.fault("link-down", "base", lasts="1s")
        ping(robots)
    assert 0 < int(program.output.stdout.partition(" packets transmitted, ")[2].split()[0])
    assert ", 0% packet loss" not in program.output.stdout


def test_a_process_is_killed(lab, robots):
    with robots.sender.running(["sleep", "987"]) as program:
        assert any(robots.sender.run(["pgrep", "-x", "sleep"], check=False).stdout for _ in range(500))
        lab.fault("kill", "sender", process="sleep")
    assert program.output.exit_code != 0


def test_a_robot_moves_and_comes_back(lab, robots):
    with lab.moving("sender", away="350m", speed="300m/s"):
        assert any(ping(robots, 1).exit_code for _ in range(500))
    assert ping(robots).exit_code == 0


def test_files_are_copied_in_both_directions(robots, tmp_path):
    (tmp_path / "tool").write_bytes(bytes(range(256)) * 1000)
    (tmp_path / "tool").chmod(0o755)
    robots.sender.put(tmp_path / "tool", "new/folder/tool")
    assert robots.sender.run(["test", "-x", "new/folder/tool"]).exit_code == 0
    assert robots.sender.get("new/folder/tool", tmp_path / "back").read_bytes() == (tmp_path / "tool").read_bytes()
    assert robots.sender.run(["cat"], stdin="quoted; $HOME").stdout == "quoted; $HOME"


def test_the_state_of_a_link_is_read(robots):
    ping(robots)
    (station,) = robots.sender.link().stations
    assert station.station == "base"
    assert -100 < station.signal_dbm < 0
    assert station.tx_packets > 0


def test_ros_is_available(robots):
    assert robots.sender.run(["rosbag", "record", "--help"], ros=True).exit_code == 0


@pytest.fixture(scope="module")
def short(trial):
    return trial("short", "10m", protocol="tcp", repeats=1)


def test_a_trial_has_its_figures(short):
    assert short.cell().n_valid == 1
    assert short.cell(protocol="tcp").file_loss.value == 0
    assert short.repeats["sent_bytes"].to_pylist() == [20_000]


def test_two_tests_share_a_trial(short):
    assert not any(short.packets("tcp-01")["lost"].to_pylist())


def test_fails_because_of_a_figure(short):
    assert short.cell().file_loss.high < 0.5


def test_fails_because_of_a_program(robots):
    robots.sender.run(["sh", "-c", "echo broken >&2; exit 3"])


def test_fails_because_of_a_timeout(robots):
    robots.sender.run(["sleep", "60"], timeout=0.5)


def test_fails_because_of_an_expectation(trial):
    trial("slow", "10m", repeats=2)


def test_uses_an_unknown_robot(robots):
    robots.sendr.run(["true"])


def test_uses_robots_missing_in_the_site(trial):
    trial("los", "10m", repeats=1)


def test_passes_a_string_as_arguments(robots):
    robots.sender.run("ping -c 1 base")


@pytest.mark.parametrize(("kind", "more"), [("link-down", {}), ("reboot", {"lasts": "1s"}), ("ufo", {})])
def test_uses_an_unknown_fault(lab, kind, more):
    lab.fault(kind, "sender", **more)
"""
SHORT = """\
name: short
summary: Bytes that the sender makes up, and nothing else
scenario: los
topology: masterless
protocols: [tcp, udp]
repeats: 2
steps:
  - capture:
      robots: [sender, receiver]
      port: 1234
      during:
        - send: {from: sender, to: receiver, size: 20kB}
"""
SLOW = """\
name: slow
summary: An echo that must be faster than light
scenario: los
topology: masterless
protocols: [tcp]
repeats: 2
steps:
  - ping: {from: sender, to: receiver, count: 2, interval: 200ms}
expect:
  - rtt_median_s < 1 us
"""
FAIL = {
    "test_fails_because_of_a_figure",
    "test_fails_because_of_a_program",
    "test_fails_because_of_a_timeout",
    "test_fails_because_of_an_expectation",
}
LONG = """
def test_long(robots):
    open("up", "w").close()
    robots.sender.run(["sleep", "600"], timeout=600)
"""
PASSES = """
import pytest


def test_one(robots):
    robots.sender.run(["true"])


def test_{name}(lab):
    lab.place("7m")
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("a lab's tests")


@pytest.fixture(scope="module")
def suite_run(folder: Path) -> SuiteRun:
    suites.write(folder, site=COSIMULATED, test_robots=SUITE)
    (folder / "procedures").mkdir()
    for name, text in (("short", SHORT), ("slow", SLOW)):
        (folder / "procedures" / f"{name}.yaml").write_text(text, encoding="utf-8")
    return suites.run(folder)


def part(output_text: str, title: str) -> str:
    """Return the output of pytest for one test that did not pass."""
    match = re.search(rf"^_+ {title} _+$(.*?)(?=^_{{3,}} \S|^={{3,}} |\Z)", output_text, re.MULTILINE | re.DOTALL)
    assert match, output_text
    return match[1]


def test_tests_pass_fail_and_have_errors_of_the_lab(suite_run: SuiteRun) -> None:
    assert suite_run.code == 1
    failed = {name for name, outcome in suite_run.results.items() if outcome == "failure"}
    errors = {name.partition("[")[0] for name, outcome in suite_run.results.items() if outcome == "error"}
    assert failed == FAIL, suite_run.output
    rejected = ("test_uses_an_unknown", "test_uses_robots_missing", "test_passes_a_string")
    assert errors == {name.partition("[")[0] for name in suite_run.results if name.startswith(rejected)}
    assert (
        len(suite_run.results)
        == len(FAIL) + len([outcome for outcome in suite_run.results.values() if outcome == "error"]) + 10
    ), suite_run.output


def test_a_failure_is_reported_with_the_line_of_the_test(suite_run: SuiteRun) -> None:
    output_text = part(suite_run.output, "test_fails_because_of_a_program")
    assert '>       robots.sender.run(["sh", "-c", "echo broken >&2; exit 3"])' in output_text
    assert "rover: `sh -c 'echo broken >&2; exit 3'` exited with code 3: broken" in output_text
    assert "/fieldkit/" not in output_text, "no internals of fieldkit are shown"
    assert "rover: `sleep 60` did not end in time" in part(suite_run.output, "test_fails_because_of_a_timeout")
    assert "where inf = CellFigure(name='file_loss', unit='share', n=1" in part(
        suite_run.output, "test_fails_because_of_a_figure"
    )
    assert "rtt_median_s < 1 us TCP" in part(suite_run.output, "test_fails_because_of_an_expectation")


def test_an_error_of_the_lab_is_reported_with_its_remedy(suite_run: SuiteRun) -> None:
    output_text = part(suite_run.output, "ERROR at setup of test_uses_an_unknown_robot")
    assert "there is no robot 'sendr' in this lab\n  remedy: did you mean 'sender'?" in output_text
    assert "requested at test_robots.py:" in output_text
    assert "the site file gives no roles for topology master" in part(
        suite_run.output, "ERROR at setup of test_uses_robots_missing_in_the_site"
    )
    assert "remedy: write ['ping', '-c', '1', 'base']" in suite_run.output


def test_only_evidence_of_failures_is_kept(suite_run: SuiteRun, folder: Path) -> None:
    (kept_folder,) = (folder / "fieldkit-results").iterdir()
    names = {path.name for path in (kept_folder / "test_robots.py").iterdir()}
    assert names - {"set-up"} >= FAIL - {"test_fails_because_of_a_figure"}, (
        "what that one is about was set up for several"
    )
    assert not any(name.startswith(("test_a", "test_r", "test_t")) for name in names if "asks" not in name)
    log = (kept_folder / "test_robots.py" / "test_fails_because_of_a_program" / "lab.log").read_text(encoding="utf-8")
    assert log.endswith("rover $ sh -c 'echo broken >&2; exit 3'\nbroken\nexit code 3\n")
    for name, trials in (("set-up", 1), ("test_fails_because_of_an_expectation", 1)):
        tables = list((kept_folder / "test_robots.py" / name / "trials").glob("*/trial.csv"))
        assert len(tables) == trials


def test_a_failed_test_names_its_evidence(suite_run: SuiteRun, folder: Path) -> None:
    (kept_folder,) = (folder / "fieldkit-results").iterdir()
    test_folder = kept_folder / "test_robots.py" / "test_fails_because_of_a_program"
    assert f"fieldkit evidence -------------------------------\n{test_folder}\n" in part(
        suite_run.output, "test_fails_because_of_a_program"
    )
    assert ("fieldkit_evidence", str(test_folder)) in suite_run.properties["test_fails_because_of_a_program"]
    assert not suite_run.properties["test_files_are_copied_in_both_directions"]


def test_each_worker_has_a_lab_and_all_share_one_folder(tmp_path: Path) -> None:
    files = {f"test_{name}": PASSES.format(name=name) for name in ("a", "b")}
    suites.write(tmp_path, **files)
    done = suites.run(tmp_path, "-n", "2", "--dist", "loadfile", "--fieldkit-keep", "all")
    assert (done.code, set(done.results.values())) == (0, {"passed"}), done.output
    (kept_folder,) = (tmp_path / "fieldkit-results").iterdir()
    logs = sorted(str(path.relative_to(kept_folder)) for path in kept_folder.rglob("lab.log"))
    assert logs == [
        f"test_{letter}.py/{test}/lab.log" for letter in "ab" for test in ("set-up", f"test_{letter}", "test_one")
    ]


def test_nothing_remains_after_ctrl_c(tmp_path: Path) -> None:
    """In the middle of a program on a robot."""
    test = (
        'def test_long(robots):\n    open("up", "w").close()\n    robots.sender.run(["sleep", "600"], timeout=600)\n'
    )
    suites.write(tmp_path, test_long=test)
    process = subprocess.Popen(
        suites.command(), cwd=tmp_path, env=suites.environment(), stdout=subprocess.PIPE, text=True
    )
    wait_until(lambda: (tmp_path / "up").exists() or process.poll() is not None, Deadline.after(120))
    started = descendants(process.pid)
    assert len(started) > 3, "two robots and the radio model"
    process.send_signal(signal.SIGINT)
    output_text, _ = process.communicate(timeout=120)
    assert (process.returncode, "KeyboardInterrupt" in output_text) == (2, True), output_text
    wait_for_end(started, within_s=60.0)
