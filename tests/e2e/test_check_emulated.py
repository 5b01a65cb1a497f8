"""`fieldkit check` end to end, in a lab that is ready and in labs with a fault."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from fieldkit.core.deadline import Deadline
from fieldkit.core.model import Protocol, Role
from fieldkit.remote import evidence, jobs
from fieldkit.remote.jobs import Job
from fieldkit.trial.running import locks
from fieldkit.trial.running.locks import Holder
from sim_backends.emulated.backend import DEFAULT_SITE
from tests.helpers.field_robots import FieldRobots, start_field_robots
from tests.helpers.labs import built_in_ros, copy_shipped
from tests.helpers.runs import LIMIT_S, Run, run_here

pytestmark = pytest.mark.emulated

CHECK = ("check", "los", "--topology", "masterless", "--json")


def findings_by_check(run: Run) -> dict[tuple[str, str], dict[str, str]]:
    return {(finding["robot"], finding["check"]): finding for finding in run.events("finding")}


def failed(run: Run) -> set[tuple[str, str]]:
    return {check for check, finding in findings_by_check(run).items() if finding["status"] == "fail"}


@pytest.fixture(scope="module")
def field_robots(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FieldRobots]:
    """Robots with Debian's ROS, because its programs are checked."""
    with start_field_robots(tmp_path_factory.mktemp("lab"), site=DEFAULT_SITE) as robots:
        yield robots


@pytest.fixture
def lab(field_robots: FieldRobots, tmp_path: Path) -> Path:
    """Return a separate folder with the site file of the robots."""
    (tmp_path / "fieldkit.yaml").write_bytes((field_robots.folder / "fieldkit.yaml").read_bytes())
    return tmp_path


def test_all_checks_of_a_lab_that_is_ready_are_ok(tmp_path: Path) -> None:
    run = run_here(tmp_path, "check")
    assert run.code == 0, run.out + run.err
    assert list(tmp_path.iterdir()) == []
    lines = run.out.splitlines()
    assert {"turtlebot-1", "turtlebot-2", "duckiedrone-1", "laptop"} <= set(lines)
    assert not [line for line in lines if line.split()[:1] in (["warn"], ["FAIL"])]
    for check in (
        "connection",
        "clock",
        "disk",
        "port 1234",
        "right to capture",
        "interface wlan0",
        "topic /scan",
        "battery",
    ):
        assert [line for line in lines if line.split()[0] == "ok" and check in line], check
    assert "\x1b" not in run.out, "the output has no terminal codes if it is not a terminal"


def test_checks_of_the_field_backend_are_ok_and_leave_no_files_on_the_robots(
    field_robots: FieldRobots, lab: Path
) -> None:
    run = run_here(lab, *CHECK)
    assert run.code == 0, run.out + run.err
    scan = findings_by_check(run)["turtlebot-1", "topic /scan"]
    assert scan["status"] == "ok"
    for shell in field_robots.testbed.shells.values():
        file_names = shell.run(("ls", jobs.HOME), deadline=Deadline.after(30)).stdout.decode().split()
        assert [name for name in file_names if not name.startswith("job-")] == []


def test_each_fault_is_reported_with_its_remedy_and_all_else_is_checked(field_robots: FieldRobots, lab: Path) -> None:
    copy_shipped(lab, "robots", "turtlebot3_burger", "netcat: nc.traditional", "netcat: nc.imaginary")
    copy_shipped(lab, "robots", "duckiedrone", "capture_right: direct", "capture_right: sudo")
    receiver = field_robots.testbed.shells[Role.RECEIVER]
    folder = jobs.work_folder("20260101T000000.000000Z_los_5m_masterless", "udp-01-1")
    jobs.install(receiver, Deadline.after(30))
    receiver.run(("mkdir", "-p", f"{folder}/.jobs"), deadline=Deadline.after(30))
    listen = ("nc.traditional", "-l", "-p", "1234")
    leftover = Job(folder, "listen", listen, limit_s=60, log="log", ready=jobs.ready_when_bound(Protocol.TCP, 1234))
    jobs.start(receiver, leftover)
    try:
        run = run_here(lab, *CHECK)
    finally:
        jobs.stop(receiver, leftover)
        receiver.run(("rm", "-r", folder), deadline=Deadline.after(30))
    assert run.code == 3
    findings = findings_by_check(run)
    assert failed(run) == {
        ("turtlebot-1", "nc.imaginary"),
        ("duckiedrone-1", "port 1234"),
        ("duckiedrone-1", "right to capture"),
        ("duckiedrone-1", "jobs"),
    }
    assert all(findings[check]["remedy"] for check in failed(run))
    assert "nc.traditional -l -p 1234" in findings["duckiedrone-1", "jobs"]["detail"]
    assert findings["turtlebot-1", "topic /scan"]["status"] == "ok"


def test_a_silent_topic_is_detected_before_the_trial(lab: Path) -> None:
    copy_shipped(lab, "procedures", "los", "[/scan]", "[/scan, /nothing]")
    run = run_here(lab, *CHECK)
    assert run.code == 3
    assert failed(run) == {("turtlebot-1", "topic /nothing")}
    assert findings_by_check(run)["turtlebot-1", "topic /scan"]["status"] == "ok"


def test_an_unreachable_robot_does_not_prevent_checks_of_the_others(field_robots: FieldRobots, lab: Path) -> None:
    site = (lab / "fieldkit.yaml").read_text(encoding="utf-8")
    # 192.0.2.0/24 is reserved for documentation (RFC 5737). The other robot's radio has a different address.
    address = field_robots.cast[Role.RECEIVER].address
    site = site.replace(f"port: {field_robots.links.port(Role.SENDER)}", "port: 1").replace(address, "192.0.2.1")
    (lab / "fieldkit.yaml").write_text(site, encoding="utf-8")
    run = run_here(lab, *CHECK)
    assert run.code == 3
    assert failed(run) == {("turtlebot-1", "connection"), ("duckiedrone-1", "interface wlan0")}
    assert [check for robot, check in findings_by_check(run) if robot == "turtlebot-1"] == ["connection"]


def test_a_robot_locked_by_another_user_is_reported_and_not_disturbed(field_robots: FieldRobots, lab: Path) -> None:
    sender = {Role.SENDER: field_robots.testbed.shells[Role.SENDER]}
    with locks.locked(sender, Holder("token", "anna@one", "trial-a"), sink=lambda _: None):
        job = Job(
            folder=jobs.work_folder("trial-a", "tcp-01-1"), name="work", argv=("sleep", "99"), limit_s=99, log="l"
        )
        evidence.begin(sender[Role.SENDER], job.folder, "sender", "wlan0")
        jobs.start(sender[Role.SENDER], job)
        run = run_here(lab, *CHECK, "--ros")
        evidence.end_jobs(sender[Role.SENDER], job.folder)
    assert run.code == 3
    assert failed(run) == {("turtlebot-1", "lock")}, "a process of anna is no leftover"
    lock = findings_by_check(run)["turtlebot-1", "lock"]
    assert "anna@one has locked the robot for trial-a" in lock["detail"]
    assert lock["remedy"].endswith(": fieldkit abort")
    assert ("turtlebot-1", "topic /scan") not in findings_by_check(run)
    assert findings_by_check(run)["laptop", "network"]["status"] == "warn"
    assert not [check for _, check in findings_by_check(run) if check.startswith("UDP")]


def test_a_changed_host_key_names_both_fingerprints(field_robots: FieldRobots, lab: Path) -> None:
    site = (lab / "fieldkit.yaml").read_text(encoding="utf-8")
    keys = [line.partition("host_key: ")[2].rstrip("}\n") for line in site.splitlines() if "host_key: " in line]
    assert len(keys) == 2
    (lab / "fieldkit.yaml").write_text(site.replace(keys[0], keys[1]), encoding="utf-8")
    run = run_here(lab, *CHECK)
    assert run.code == 3
    assert failed(run) == {("turtlebot-1", "connection")}
    assert findings_by_check(run)["turtlebot-1", "connection"]["detail"].count("SHA256:") == 2


def test_a_full_home_directory_fails(field_robots: FieldRobots, lab: Path) -> None:
    shell = field_robots.testbed.shells[Role.SENDER]
    resize = "mount -o remount,size=$1 /root && df -Pk /root"
    before = shell.run(("df", "-Pk", "/root"), deadline=Deadline.after(30)).stdout.split()[-5].decode()
    shell.run(("sh", "-c", resize, "sh", "50m"), deadline=Deadline.after(30))
    try:
        run = run_here(lab, *CHECK)
    finally:
        shell.run(("sh", "-c", resize, "sh", f"{before}k"), deadline=Deadline.after(30))
    assert run.code == 3
    assert ("turtlebot-1", "disk") in failed(run), "the check for the recorder of ROS fails too"
    assert {robot for robot, _ in failed(run)} == {"turtlebot-1"}


def test_a_trial_reports_warnings_and_stops_at_failures(lab: Path) -> None:
    copy_shipped(
        lab,
        "robots",
        "turtlebot3_burger",
        "distribution: noetic",
        "distribution: melodic",
        "ping: ping",
        "ping: pong",
    )
    run = run_here(lab, "trial", "los", "5m", "--topology", "masterless", "--yes")
    assert run.code == 3
    assert "warning: turtlebot-1: ROS: noetic" in run.out
    assert "turtlebot-1: pong: not found" in run.err
    assert "correct its name in profile turtlebot3_burger" in run.err


def test_a_machine_without_a_hosts_file_is_sufficient(tmp_path: Path) -> None:
    """A minimal Debian has no `/etc/hosts`; the changed `/etc` is in a separate mount namespace."""
    built_in_ros(tmp_path)
    script = 'cp -a /etc "$0" && rm -f "$0/hosts" && mount --bind "$0" /etc && test ! -e /etc/hosts && exec "$@"'
    argv = ("unshare", "--mount", "sh", "-c", script, str(tmp_path / "etc"), sys.executable, "-m", "fieldkit", *CHECK)
    completed = subprocess.run(argv, check=False, cwd=tmp_path, capture_output=True, text=True, timeout=LIMIT_S)
    assert completed.returncode == 0, completed.stderr + completed.stdout
