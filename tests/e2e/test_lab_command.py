"""`fieldkit lab` on the command line: robots run until `lab down`, and the ordinary ssh and scp reach them."""

import contextlib
import json
import math
import os
import pty
import socket
import stat
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import Any, Final

import pytest
from rosbags.rosbag1 import Reader

from fieldkit.cli import lab_shells, main
from fieldkit.core.deadline import Deadline
from fieldkit.lab import folder, requests
from fieldkit.remote import evidence, jobs
from fieldkit.remote.jobs import Job
from fieldkit.ros.interfaces.types import standard_types
from tests.helpers.host import NamespaceComparison, descendants, wait_for_end
from tests.helpers.nightly import mark_nightly
from tests.helpers.runs import fieldkit, run_here, start

pytestmark = pytest.mark.emulated

TIMEOUT_S: Final = 60.0
SITE: Final = """\
backend: field
robots:
  ground-1: {profile: turtlebot3_burger, host: 192.0.2.1}
  air-1: {profile: duckiedrone, host: 192.0.2.2}
roles:
  masterless: {sender: ground-1, receiver: air-1}
emulated: {ros: builtin, world: open, radio: {fading: false}}
"""


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder of a running lab, with a name that needs quoting."""
    lab_folder = tmp_path_factory.mktemp("a 100% lab")
    (lab_folder / "fieldkit.yaml").write_text(SITE, encoding="utf-8")
    started = fieldkit(lab_folder, "lab", "up")
    assert started.code == 0, started.err
    (lab_folder / "ssh.conf").write_text(run_here(lab_folder, "lab", "ssh-config").out, encoding="utf-8")
    try:
        yield lab_folder
    finally:
        assert run_here(lab_folder, "lab", "down").code == 0


def run_plain(lab_folder: Path, *argv: str) -> str:
    """Run a program without the environment variables of fieldkit."""
    completed = subprocess.run(
        argv,
        cwd=lab_folder,
        env={"PATH": os.environ["PATH"]},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )
    assert completed.returncode == 0, completed.stderr
    return completed.stdout


def process_of(lab_folder: Path) -> int:
    return requests.state(folder.of_directory(lab_folder)).pid


def test_ps_shows_robots_roles_addresses_positions_and_programs(lab: Path) -> None:
    assert run_here(lab, "lab", "move", "air-1", "--to", "202.5m", "197.5m").code == 0
    lines = run_here(lab, "lab", "ps").out.splitlines()
    ground, air = (" ".join(next(line for line in lines if name in line).split()) for name in ("ground-1", "air-1"))
    assert ground == "ground-1 turtlebot3_burger sender (masterless) 10.42.0.1 197.5, 197.5, 0.2 sshd, sensors"
    assert air == "air-1 duckiedrone receiver (masterless) 10.42.0.2 202.5, 197.5, 0.2 sshd, sensors, autopilot"
    assert lines[-1].startswith("up for ")
    lab_state = json.loads(run_here(lab, "lab", "ps", "--json").out)
    assert lab_state["pid"] == process_of(lab)
    assert lab_state["up_s"] > 0
    ground_1, air_1 = lab_state["robots"]
    assert ground_1 == {
        "name": "ground-1",
        "profile": "turtlebot3_burger",
        "roles": ["sender (masterless)"],
        "address": "10.42.0.1",
        "place_m": pytest.approx([197.5, 197.5, 0.2]),
        "programs": ["sshd", "sensors"],
    }
    assert (air_1["name"], air_1["place_m"]) == ("air-1", pytest.approx([202.5, 197.5, 0.2]))


def test_plain_ssh_scp_and_sftp_reach_the_robots(lab: Path) -> None:
    assert run_plain(lab, "ssh", "-F", "ssh.conf", "ground-1", "hostname") == "ground-1\n"
    assert run_plain(lab, "ssh", "-F", "ssh.conf", "air-1", "hostname") == "air-1\n"
    (lab / "there").write_bytes(os.urandom(300_000))
    run_plain(lab, "scp", "-F", "ssh.conf", "there", "ground-1:")
    (lab / "batch").write_text("get there back\n", encoding="utf-8")
    run_plain(lab, "sftp", "-F", "ssh.conf", "-b", "batch", "ground-1")
    assert (lab / "back").read_bytes() == (lab / "there").read_bytes()


DRIVE_SCRIPT: Final = "trap 'touch .jobs/drive/stationary; exit' INT; echo up; while :; do sleep 0.05; done"


def driving_job(attempt: str, script: str) -> Job:
    argv = ("sh", "-c", script, "python3", "../../agent-0123456789ab.pyz", "drive", '{"over": "ros1"}')
    return Job(attempt, "drive", argv, TIMEOUT_S, "drive.log", ready="log:up")


def test_stop_reaches_the_robots_of_a_lab(lab: Path) -> None:
    """The programs have the command line of the driver, by which `fieldkit stop` recognizes them."""
    attempt = jobs.work_folder("trial-a", "tcp-01-1")
    driver = driving_job(attempt, DRIVE_SCRIPT)
    with lab_shells.open_shells(folder.of_directory(lab)) as shells:
        jobs.install(shells["ground-1"], Deadline.after(TIMEOUT_S))
        evidence.begin(shells["ground-1"], attempt, "sender", "lo")
        jobs.start(shells["ground-1"], driver)
        stopped = run_here(lab, "stop", "--all", "--backend", "emulated")
        assert (stopped.code, sorted(stopped.out.splitlines())) == (
            0,
            ["air-1: no program of fieldkit moves it; nothing was sent to it", "ground-1: stopped (stationary)"],
        )
        assert not jobs.list_running(shells["ground-1"], Deadline.after(TIMEOUT_S))
        next_attempt = jobs.work_folder("trial-a", "tcp-01-2")
        evidence.begin(shells["ground-1"], next_attempt, "sender", "lo")
        jobs.start(shells["ground-1"], driving_job(next_attempt, "trap 'exit 1' INT; echo up; sleep 60 & wait"))
        crashed = run_here(lab, "stop", "ground-1", "--backend", "emulated")
        assert (crashed.code, crashed.out) == (
            3,
            "ground-1: NOT CONFIRMED: stop it by hand; its program has exited and has not confirmed the stop\n",
        )
    second_run = run_here(lab, "stop", "ground-1", "--backend", "emulated")
    assert (second_run.code, second_run.out) == (
        0,
        "ground-1: no program of fieldkit moves it; nothing was sent to it\n",
    )
    unknown_robot_run = run_here(lab, "stop", "ground-2", "--backend", "emulated")
    assert (unknown_robot_run.code, "did you mean 'ground-1'?" in unknown_robot_run.err) == (2, True)


def test_rsync_reaches_the_robots(lab: Path) -> None:
    (lab / "folder").mkdir(exist_ok=True)
    (lab / "folder" / "data").write_bytes(os.urandom(300_000))
    run_plain(lab, "rsync", "-a", "-e", "ssh -F ssh.conf", "folder", "air-1:")
    run_plain(lab, "rsync", "-a", "-e", "ssh -F ssh.conf", "air-1:folder/data", "fetched")
    assert (lab / "fetched").read_bytes() == (lab / "folder" / "data").read_bytes()


def test_ssh_rejects_a_robot_with_another_host_key(lab: Path) -> None:
    """The robots' connections are swapped, which the pinned host key must reveal."""
    text = (lab / "ssh.conf").read_text(encoding="utf-8")
    (lab / "swapped.conf").write_text(text.replace("%n", "air-1"), encoding="utf-8")
    completed = subprocess.run(
        ("ssh", "-F", "swapped.conf", "ground-1", "true"), cwd=lab, capture_output=True, text=True, check=False
    )
    assert completed.returncode == 255
    assert "Host key verification failed" in completed.stderr


def test_robots_reach_each_other_over_their_radio(lab: Path) -> None:
    output = fieldkit(lab, "lab", "shell", "ground-1", "ping", "-c", "2", "-w", "30", "-i", "0.2", "air-1").out
    assert " packets transmitted, 2 received" in output


def test_a_robot_out_of_range_is_unreachable_until_it_returns(lab: Path) -> None:
    """With exponent 3 and 17 dBm, the weakest detectable frame of -82 dBm comes from 91 m."""
    lab_folder = folder.of_directory(lab)
    assert run_here(lab, "lab", "move", "air-1", "--to", "202.5m", "197.5m").code == 0
    moved = run_here(lab, "lab", "move", "air-1", "--by", "-100m", "-0.1km", "100m")
    assert moved.out == "air-1 is at 102.5, 97.5, 100.2 (m east, north, up)\n"
    assert fieldkit(lab, "lab", "shell", "ground-1", "ping", "-c", "3", "-i", "0.2", "-W", "1", "air-1").code == 1
    overview = requests.overview(lab_folder)
    assert overview.robots == {"ground-1": (197.5, 197.5), "air-1": (102.5, 97.5)}
    assert not overview.links[0].linked
    assert run_here(lab, "lab", "plot").out == "lab.svg\n"
    assert f">{overview.links[0].snr_db:.0f} dB<" in (lab / "lab.svg").read_text(encoding="utf-8")
    assert run_here(lab, "lab", "move", "air-1", "--to", "207.5m", "197.5m").code == 0
    assert requests.state(lab_folder).robots[1].place_m == (207.5, 197.5, 0.2)
    assert fieldkit(lab, "lab", "shell", "ground-1", "ping", "-c", "1", "-w", "30", "-i", "0.2", "air-1").code == 0


def ahead_m(lab: Path) -> float:
    """Return the median range of the beam ahead of ground-1, over 2 s of its laser."""
    record = "source /opt/ros/noetic/setup.bash && rosbag record --duration=2 -O scan /scan"
    run_plain(lab, "ssh", "-F", "ssh.conf", "ground-1", record)
    run_plain(lab, "scp", "-F", "ssh.conf", "ground-1:scan.bag", ".")
    with Reader(lab / "scan.bag") as bag:
        scans: list[Any] = [
            standard_types().ros1.deserialize_ros1(data, "sensor_msgs/msg/LaserScan") for *_, data in bag.messages()
        ]
    return median(float(scan.ranges[0]) for scan in scans)


def test_the_laser_measures_the_range_to_another_robot(lab: Path) -> None:
    """The cylinder of a Duckiedrone has a radius of 0.2 m; beam 0 points east, like the robot."""
    for east_m in (199.5, 200.5):
        assert run_here(lab, "lab", "move", "air-1", "--to", f"{east_m}m", "197.5m").code == 0
        # The tolerance is far above the standard error of the median of 8 or more scans with noise of 0.015 m.
        assert ahead_m(lab) == pytest.approx(east_m - 197.5 - 0.2, abs=0.05)
    assert run_here(lab, "lab", "move", "air-1", "--to", "207.5m", "197.5m").code == 0
    assert ahead_m(lab) == math.inf


@pytest.mark.parametrize(
    ("words", "output"),
    [
        ("ari-1 --to 1m 1m", "there is no robot 'ari-1' in this lab\n  remedy: did you mean 'air-1'?"),
        (
            "air-1 --to 401m 1m",
            "401 m east, 1 m north is outside of the world open, which is 400 m by 400 m\n  remedy",
        ),
        ("air-1 --by 0m -200m", "-2.5 m north is outside of the world open"),
        ("air-1 --to 1m 1m -1m", "-1 m up is not a valid height: the ground is at 0 m there"),
        ("air-1 --to 1m 1m 101km", "101000 m up is not a valid height"),
        ("air-1 --to 1 1", "length '1' has no unit\n  remedy"),
        ("air-1 --to here there", "'here' is not a length\n  remedy"),
        ("air-1 --by 1m", "--by takes EAST NORTH [UP], not '1m'\n  remedy"),
        ("air-1 --to 1m 1m --by 1m 1m", "--by: not allowed with argument --to"),
        ("air-1", "one of the arguments --to --by is required"),
    ],
)
def test_an_invalid_move_does_not_move_the_robot(
    lab: Path, words: str, output: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(lab)
    lab_folder = folder.of_directory(lab)
    before = requests.state(lab_folder).robots
    assert main(["lab", "move", *words.split()]) == 2
    assert output in capsys.readouterr().err
    assert [robot.place_m for robot in requests.state(lab_folder).robots] == [robot.place_m for robot in before]


def test_a_command_in_a_shell_keeps_its_exit_code(lab: Path) -> None:
    assert fieldkit(lab, "lab", "shell", "air-1", "exit 7").code == 7


def test_a_shell_has_a_terminal(lab: Path) -> None:
    controller, terminal = pty.openpty()
    shell = subprocess.Popen(
        (sys.executable, "-m", "fieldkit", "lab", "shell", "ground-1"),
        cwd=lab,
        stdin=terminal,
        stdout=terminal,
        stderr=terminal,
        start_new_session=True,
    )
    os.close(terminal)
    os.write(controller, b"tty; hostname; exit\n")
    output = b""
    with contextlib.suppress(OSError):  # EIO: the other end is closed
        while data := os.read(controller, 4096):
            output += data
    os.close(controller)
    assert shell.wait(TIMEOUT_S) == 0
    assert b"/dev/pts/" in output
    assert b"\nground-1" in output


def test_other_users_have_no_access_to_sockets_and_keys_of_the_robots(lab: Path) -> None:
    lab_folder = folder.of_directory(lab)
    assert stat.S_IMODE(lab_folder.path.stat().st_mode) == 0o700
    for path in (lab_folder.socket, lab_folder.key):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_a_second_lab_in_a_directory_is_rejected(lab: Path) -> None:
    second = fieldkit(lab, "lab", "up")
    assert second.code == 2
    assert "a lab is already running in this directory\n  remedy: fieldkit lab down" in second.err
    assert "air-1" in run_here(lab, "lab", "ps").out


def test_an_unknown_robot_is_rejected(lab: Path) -> None:
    shell = run_here(lab, "lab", "shell", "groud-1")
    assert shell.code == 2
    assert "there is no robot 'groud-1' in this lab\n  remedy: did you mean 'ground-1'?" in shell.err


@pytest.mark.parametrize("request_", ["move", "move air-1", "move air-1 {}", "move air-1 []", "what", ""])
def test_an_invalid_request_gets_no_response(lab: Path, request_: str) -> None:
    with socket.socket(socket.AF_UNIX) as client:
        client.connect(str(folder.of_directory(lab).socket))
        client.sendall(f"{request_}\n".encode())
        assert client.recv(1) == b""
    assert len(requests.state(folder.of_directory(lab)).robots) == 2


def test_a_silent_client_does_not_block_others_for_long(lab: Path) -> None:
    with socket.socket(socket.AF_UNIX) as silent_client:
        silent_client.connect(str(folder.of_directory(lab).socket))
        assert "air-1" in run_here(lab, "lab", "ps").out


def test_down_leaves_no_processes_files_or_interfaces(tmp_path: Path, untouched: NamespaceComparison) -> None:
    (tmp_path / "fieldkit.yaml").write_text("emulated: {ros: builtin}\nrobots: {}\nroles: {}\n", encoding="utf-8")
    started = fieldkit(tmp_path, "lab", "up", "--robots", "2", "--profile", "duckiedrone")
    assert started.code == 0, started.err
    process = process_of(tmp_path)
    process_ids = {process} | descendants(process)
    assert len(process_ids) > 2 * 3
    state = requests.state(folder.of_directory(tmp_path))
    assert [robot.name for robot in state.robots] == ["robot-1", "robot-2"]
    assert {robot.profile for robot in state.robots} == {"duckiedrone"}
    assert fieldkit(tmp_path, "lab", "down").out == "the robots are down\n"
    wait_for_end(process_ids, within_s=0.0)
    untouched()
    assert not folder.of_directory(tmp_path).path.exists()


def test_a_killed_lab_leaves_no_processes_and_can_be_started_again(
    tmp_path: Path, untouched: NamespaceComparison
) -> None:
    (tmp_path / "fieldkit.yaml").write_text(SITE, encoding="utf-8")
    assert fieldkit(tmp_path, "lab", "up").code == 0
    process = process_of(tmp_path)
    process_ids = descendants(process)
    os.kill(process, 9)
    wait_for_end(process_ids | {process}, within_s=TIMEOUT_S)
    untouched()
    listing = run_here(tmp_path, "lab", "ps")
    assert (listing.code, "remedy: fieldkit lab up" in listing.err) == (2, True)
    assert fieldkit(tmp_path, "lab", "up").code == 0
    assert run_here(tmp_path, "lab", "down").code == 0


def test_a_lab_in_the_foreground_ends_with_ctrl_c(tmp_path: Path) -> None:
    (tmp_path / "fieldkit.yaml").write_text(SITE, encoding="utf-8")
    started = start(tmp_path, "lab", "up", "--foreground")
    assert started.stdout is not None
    assert started.stdout.readline() == "2 robots up, until Ctrl-C\n"
    process_ids = descendants(started.pid)
    started.send_signal(2)
    assert started.wait(TIMEOUT_S) == 0
    wait_for_end(process_ids, within_s=0.0)


def test_a_site_file_without_robots_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "fieldkit.yaml").write_text("emulated: {}\nrobots: {}\nroles: {}\n", encoding="utf-8")
    outcome = fieldkit(tmp_path, "lab", "up")
    assert (outcome.code, outcome.out) == (2, "")
    assert outcome.err == (
        "error: fieldkit.yaml:2: a lab has at least one robot, and this site file has none\n"
        "  remedy: fieldkit lab up --robots 2\n"
    )


@pytest.mark.parametrize("robots", mark_nightly([("--robots", "1"), ()]))
def test_a_lab_rejects_control_over_the_radio(tmp_path: Path, robots: tuple[str, ...]) -> None:
    (tmp_path / "fieldkit.yaml").write_text(f"control: radio\n{SITE}", encoding="utf-8")
    started = fieldkit(tmp_path, "lab", "up", *robots)
    assert started.code == 0, started.err
    try:
        assert "note: control: radio applies to trials; in a lab SSH bypasses the radio" in started.err
        name = requests.state(folder.of_directory(tmp_path)).robots[0].name
        assert run_here(tmp_path, "lab", "move", name, "--to", "0m", "0m").code == 0
        assert fieldkit(tmp_path, "lab", "shell", name, "hostname").out == f"{name}\n"
    finally:
        assert run_here(tmp_path, "lab", "down").code == 0


def test_a_lab_that_cannot_start_reports_the_reason_in_the_terminal(tmp_path: Path) -> None:
    (tmp_path / "fieldkit.yaml").write_text(SITE.replace("duckiedrone", "nodrone"), encoding="utf-8")
    started = fieldkit(tmp_path, "lab", "up")
    assert started.code == 2
    assert "there is no robot profile 'nodrone'" in started.err
    assert run_here(tmp_path, "lab", "down").code == 2
