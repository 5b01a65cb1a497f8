"""Robots that drive in trials, over ROS 1, DDS and Zenoh, with the field backend on the laptop."""

import json
import math
import os
import pty
import shutil
import signal
import subprocess
import sys
import threading
import time
from bisect import bisect_left
from collections.abc import Iterator
from contextlib import chdir, closing, contextmanager, suppress
from pathlib import Path

import pytest

from fieldkit.config.site import load_site
from fieldkit.core.deadline import Deadline
from fieldkit.core.model import Placement, Role, Scenario, Topology, TrackPoint, Vector
from fieldkit.core.units import parse_distance
from fieldkit.lab.robots import Destination
from fieldkit.remote import jobs
from fieldkit.remote.command import with_environment
from fieldkit.remote.ssh import SshShell
from sim_backends.emulated.backend import EmulatedBackend
from sim_backends.emulated.ros.motion_record import RecordedMotion
from tests.helpers import texts
from tests.helpers.field_robots import FieldRobots, start_field_robots
from tests.helpers.host import descendants, wait_for_end
from tests.helpers.labs import replace_text
from tests.helpers.nightly import mark_nightly
from tests.helpers.paths import ROOT
from tests.helpers.rovers import rover_profile
from tests.helpers.runs import finish, only_trial, rows, run_here, start, wait_during, wait_for_line
from tests.helpers.sshd import wait_until

pytestmark = pytest.mark.emulated

SITE = """\
backend: emulated
robots:
  rover-1: {profile: rover}
  rover-2: {profile: rover_two}
  rover-3: {profile: rover_three}
roles:
  master: {sender: rover-2, receiver: rover-1, relay: rover-3}
emulated: {ros: auto}
"""
LAB = """\
backend: emulated
robots: {robot-1: {profile: rover}}
roles: {}
emulated: {ros: debian}
"""
ROSTOPIC_MESSAGES = {
    "geometry_msgs/Twist": "{linear: {x: 0.2}}",
    "geometry_msgs/TwistStamped": "{twist: {linear: {x: 0.2}}}",
}
PLACEMENT = Placement(Scenario.LOS, Topology.MASTER, parse_distance("5m"))
SPEED_M_S = 0.6
LEASE_S = 2.0
"""Lease of the tests in which it expires."""
LONG_LEASE_S = 30.0
"""Lease of the other tests, so that a busy machine does not stop a robot."""
ORDER_S = 6.0
"""Time limit for an order to stop a robot. An idle machine needs some tenths of a second (`benchmarks.stop`)."""
SETUP = ("/opt/ros/noetic/setup.bash",)
DRIVE = texts.procedure(
    "drive",
    """\
- move:
    robot: receiver
    path: [{away: 20m}]
    speed: 0.6m/s
    during:
      - ping: {from: sender, to: receiver, count: 150, interval: 200ms, payload_bytes: 500}
""",
    topology="master",
    protocols="udp",
)
BOTH = (
    DRIVE[: DRIVE.index("  - move:")]
    + """\
  - move:
      name: zenoh
      robot: relay
      path: [{left: 0.3m}]
      during:
        - move:
            name: outer
            robot: sender
            path: [{away: 0.3m, left: 0.3m}]
            during:
              - move:
                  robot: receiver
                  path: [{away: 0.4m}]
                  speed: 0.6m/s
                  during:
                    - ping: {from: sender, to: receiver, count: 13, interval: 200ms, payload_bytes: 500}
"""
)
SHORT = DRIVE.replace("away: 20m", "away: 1.5m").replace("count: 150", "count: 13")
RUN = ("trial", "drive", "5m", "--yes", "--allow-motion")


@pytest.fixture(scope="module")
def rovers(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FieldRobots]:
    """Robots that outlive fieldkit; they are fast, so that the tests take less time."""
    folder = tmp_path_factory.mktemp("rovers")
    profile = rover_profile(fence_m=30.0, lease_s=LONG_LEASE_S)
    for name in ("robots", "procedures"):
        (folder / name).mkdir()
    (folder / "robots" / "rover.yaml").write_text(profile, encoding="utf-8")
    ros2 = profile.replace("name: rover", "name: rover_two").replace("variant: ros1", "variant: ros2")
    (folder / "robots" / "rover_two.yaml").write_text(ros2, encoding="utf-8")
    zenoh = ros2.replace("name: rover_two", "name: rover_three").replace("distribution: foxy", "distribution: jazzy")
    zenoh = zenoh.replace("\nlimits:", "\n  environment: {RMW_IMPLEMENTATION: rmw_zenoh_cpp}\nlimits:")
    zenoh = replace_text(zenoh, "topic: /cmd_vel", "topic: /cmd_vel, type: geometry_msgs/TwistStamped, frame: base")
    (folder / "robots" / "rover_three.yaml").write_text(zenoh, encoding="utf-8")
    (folder / "lab.yaml").write_text(SITE, encoding="utf-8")
    with chdir(folder), start_field_robots(folder, site=folder / "lab.yaml", topology=Topology.MASTER) as robots:
        yield robots


@pytest.fixture
def field_robots(rovers: FieldRobots, monkeypatch: pytest.MonkeyPatch) -> FieldRobots:
    """The same robots at their initial positions, with intact links and without files and jobs of earlier trials."""
    monkeypatch.chdir(rovers.folder)
    for role, shell in rovers.testbed.shells.items():
        rovers.links.restore(role)
        jobs.abort(shell, "test", Deadline.after(60))  # jobs of a killed fieldkit run until their limits
        shell.run(("sh", "-c", "rm -rf ~/.fieldkit/*"), deadline=Deadline.after(30))
    shutil.rmtree(rovers.folder / "trials", ignore_errors=True)
    rovers.testbed.place(PLACEMENT)
    return rovers


def track_of(field_robots: FieldRobots, role: Role) -> list[TrackPoint]:
    return [point for point in field_robots.testbed.oracle.track(0) if point.role is role]


def place_at(track: list[TrackPoint], utc_ns: int) -> Vector:
    """Return the position of the robot at a time, interpolated linearly in its true track."""
    after = bisect_left(track, utc_ns, key=lambda point: point.utc_ns)
    before, now = track[max(after - 1, 0)], track[min(after, len(track) - 1)]
    assert before.position_m is not None
    assert now.position_m is not None
    share = (utc_ns - before.utc_ns) / max(now.utc_ns - before.utc_ns, 1)
    x_m, y_m, z_m = (
        start + min(share, 1.0) * (end - start) for start, end in zip(before.position_m, now.position_m, strict=True)
    )
    return x_m, y_m, z_m


def test_robots_drive_there_and_back_and_the_true_track_equals_their_odometry(field_robots: FieldRobots) -> None:
    (field_robots.folder / "procedures" / "drive.yaml").write_text(BOTH, encoding="utf-8")
    for _ in range(3):  # a busy machine may suspend a program of a robot for so long that the robot stops
        shutil.rmtree(field_robots.folder / "trials", ignore_errors=True)
        field_robots.testbed.place(PLACEMENT)
        field_robots.testbed.oracle.track(time.time_ns())  # the oracle drops earlier positions
        starts_m = {
            role: track_of(field_robots, role)[-1].position_m for role in (Role.SENDER, Role.RECEIVER, Role.RELAY)
        }
        run = run_here(field_robots.folder, *RUN)
        if "its program was suspended" not in run.out:
            break
    assert run.code == 0, run.err + run.out
    trial = only_trial(field_robots.folder)
    (repeat,) = (trial / "repeats").iterdir()
    (row,) = rows(trial)
    # The receiver uses ROS 1. The sender uses ROS 2 with DDS and faces in the opposite direction. The relay uses
    # Zenoh and stamped velocities.
    for role, name, sign, path_m in (
        (Role.RECEIVER, "", 1, (0.4, 0.0)),
        (Role.SENDER, "outer.", -1, (0.3, 0.3)),
        (Role.RELAY, "zenoh.", 1, (0.0, 0.3)),
    ):
        log = [json.loads(line) for line in (repeat / f"{name}drive.jsonl").read_text(encoding="ascii").splitlines()]
        assert (log[-1]["ended"], log[-1]["phase"]) == ("home", "home")
        assert max(entry["x_m"] for entry in log) == pytest.approx(path_m[0], abs=0.1)
        assert max(entry["y_m"] for entry in log) == pytest.approx(path_m[1], abs=0.1)
        start_m, track = starts_m[role], track_of(field_robots, role)
        assert start_m is not None
        for entry in log:
            east_m, north_m, _ = place_at(track, entry["utc_ns"])
            error_m = east_m - start_m[0] - sign * entry["x_m"], north_m - start_m[1] - sign * entry["y_m"]
            assert max(map(abs, error_m)) < 0.25, entry  # the distance in 0.4 s at 0.6 m/s, on a busy machine
        # The robot is stationary at the last entry.
        end_m = track[-1].position_m
        assert end_m is not None
        assert sign * (end_m[0] - start_m[0]) == pytest.approx(log[-1]["x_m"], abs=0.01)
        assert sign * (end_m[1] - start_m[1]) == pytest.approx(log[-1]["y_m"], abs=0.01)
        speeds = [math.hypot(*point.velocity_m_s) for point in track]
        assert max(speeds) <= (1.0 if name else SPEED_M_S) + 1e-6
        assert max(speeds) > SPEED_M_S / 2
        # Columns of the drive, compared with the true track.
        farthest_m = max(math.dist(point.position_m or start_m, start_m) for point in track)
        assert row[f"{name}drive_ended"] == "home"
        assert float(row[f"{name}drive_farthest_m"]) == pytest.approx(farthest_m, abs=0.02)
        assert float(row[f"{name}drive_out_m"]) == pytest.approx(math.hypot(*path_m), abs=0.1)
        assert float(row[f"{name}drive_back_off_m"]) == pytest.approx(math.dist(end_m, start_m), abs=0.01)
        assert 0 < float(row[f"{name}drive_speed_median_m_s"]) <= float(row[f"{name}drive_speed_max_m_s"])
        assert float(row[f"{name}drive_speed_max_m_s"]) == pytest.approx(max(speeds), abs=0.25)


@pytest.mark.parametrize("kind", mark_nightly(ROSTOPIC_MESSAGES))
def test_a_robot_of_an_interactive_lab_can_be_driven(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "robots").mkdir()
    profile = (ROOT / "robots/turtlebot3_burger.yaml").read_text(encoding="utf-8")
    profile = replace_text(profile, "name: turtlebot3_burger", "name: rover", "topic:", f"type: {kind}, topic:")
    (tmp_path / "robots/rover.yaml").write_text(profile, encoding="utf-8")
    (tmp_path / "fieldkit.yaml").write_text(LAB, encoding="utf-8")
    backend = EmulatedBackend(*load_site(tmp_path / "fieldkit.yaml"))
    with backend.open_lab(seed=1, sink=lambda _: None) as lab:
        place_m = lab.place_m("robot-1")
        shell = SshShell(
            "robot-1",
            connect=lambda timeout_s: lab.connect("robot-1", timeout_s),
            user=lab.login.user,
            host_key=lab.login.host_keys["robot-1"],
            private_key=lab.login.private_key,
        )
        with closing(shell):
            topic = ("rostopic", "pub", "-r", "10", "/cmd_vel", kind, ROSTOPIC_MESSAGES[kind])
            # The program publishes until its input is closed.
            driver = ("sh", "-c", '"$@" & cat >/dev/null; kill $!', "sh", *with_environment(topic, setup=SETUP))
            session = shell.begin(driver, deadline=Deadline.after(30))
            wait_until(lambda: lab.place_m("robot-1")[0] > place_m[0] + 0.1, Deadline.after(60))
            session.end(deadline=Deadline.after(60), check=False)
        assert lab.place_m("robot-1")[1:] == pytest.approx(place_m[1:], abs=1e-6), "it faces east"
        lab.move("robot-1", Destination(place_m[0], place_m[1], None, relative=False))
        assert lab.place_m("robot-1") == pytest.approx(place_m)


def receiver_motion(field_robots: FieldRobots) -> RecordedMotion | None:
    return field_robots.testbed.robots[Role.RECEIVER].recorded_motion()


@pytest.mark.usefixtures("_short_lease")
def test_killing_fieldkit_stops_the_robot(field_robots: FieldRobots) -> None:
    (field_robots.folder / "procedures" / "drive.yaml").write_text(DRIVE, encoding="utf-8")
    process = start(field_robots.folder, *RUN)
    try:
        wait_during(process, lambda: drives(field_robots))
    finally:
        process.kill()
        process.communicate(timeout=60)
    wait_for_end({process.pid}, within_s=60.0)
    wait_until(lambda: (now := receiver_motion(field_robots)) is not None and not now.is_moving, Deadline.after(60))
    shell = field_robots.testbed.shells[Role.RECEIVER]
    text = ("sh", "-c", "cat .fieldkit/*/*/drive.status")
    wait_until(
        lambda: json.loads(shell.run(text, deadline=Deadline.after(30)).stdout)["ended"] != "", Deadline.after(30)
    )
    status = json.loads(shell.run(text, deadline=Deadline.after(30)).stdout)
    assert status["ended"] == f"no order from the laptop for {LEASE_S:g} s"
    assert status["x_m"] < 19.0, "long before its end"


@pytest.fixture
def _short_lease(field_robots: FieldRobots) -> Iterator[None]:
    """Use a short lease for the receiver."""
    with changed_rover(field_robots, f"lease: {LONG_LEASE_S:g}s", f"lease: {LEASE_S:g}s"):
        yield


@contextmanager
def driving(field_robots: FieldRobots, procedure: str = DRIVE) -> "Iterator[subprocess.Popen[str]]":
    """Start a trial and wait until its robot drives; kill the trial after the body if it still runs."""
    (field_robots.folder / "procedures" / "drive.yaml").write_text(procedure, encoding="utf-8")
    process = start(field_robots.folder, *RUN)
    try:
        wait_during(process, lambda: drives(field_robots))
        yield process
    finally:
        if process.poll() is None:
            process.kill()
            process.communicate(timeout=60)
        wait_for_end({process.pid}, within_s=60.0)


def standstill_s(field_robots: FieldRobots, since_ns: int) -> float:
    """Return the time from `since_ns` until the receiver stopped, from its true track."""
    wait_until(lambda: (now := receiver_motion(field_robots)) is not None and not now.is_moving, Deadline.after(60))
    points = [point for point in track_of(field_robots, Role.RECEIVER) if point.utc_ns >= since_ns]
    moving = [point.utc_ns for point in points if math.hypot(*point.velocity_m_s) > 0]
    return (max(moving, default=since_ns) - since_ns) / 1e9


@pytest.mark.parametrize("number", mark_nightly([signal.SIGINT, signal.SIGTERM]))
def test_the_first_signal_stops_the_robot_immediately(field_robots: FieldRobots, number: signal.Signals) -> None:
    with driving(field_robots) as process:
        sent_ns = time.time_ns()
        process.send_signal(number)
        stopped_after_s = standstill_s(field_robots, sent_ns)
        run = finish(process)
    assert stopped_after_s < ORDER_S, "by the order, not by its lease"
    assert "stopping: rover-1 stops where it is" in run.err
    assert "rover-1: stopped (stationary)" in run.err
    assert run.code == 130
    assert run.err.index("stopping: rover-1") < run.err.index("rover-1: stopped")
    assert_held(field_robots, "stopped by the operator")


def assert_held(field_robots: FieldRobots, reason: str) -> None:
    """Assert that the robot may not move before a confirmation, and that its repeat is void for the same reason."""
    trial = only_trial(field_robots.folder)
    assert motions(trial) == ["origin", "begun", "held"]
    last_entry = json.loads((trial / "motion.jsonl").read_text(encoding="utf-8").splitlines()[-1])
    assert reason in last_entry["reason"]
    assert [(row["status"], row["reason"]) for row in rows(trial)] == [("void", reason)]
    stopped_m = place_m(field_robots)
    second_run = run_here(field_robots.folder, "resume", str(trial), *RESUME)
    assert second_run.code == 5, second_run.err
    assert f"rover-1: {last_entry['reason']}" in second_run.err
    assert place_m(field_robots) == pytest.approx(stopped_m, abs=0.01)


def test_ctrl_c_at_a_terminal_stops_the_robot_immediately(field_robots: FieldRobots) -> None:
    (field_robots.folder / "procedures" / "drive.yaml").write_text(DRIVE, encoding="utf-8")
    master, terminal = pty.openpty()
    words = ("setsid", "--ctty", sys.executable, "-m", "fieldkit", *RUN)
    process = subprocess.Popen(words, cwd=field_robots.folder, stdin=terminal, stdout=terminal, stderr=terminal)
    os.close(terminal)
    output_parts: list[bytes] = []

    def read() -> None:
        with suppress(OSError):  # the terminal was closed
            while data := os.read(master, 1 << 16):
                output_parts.append(data)

    reader = threading.Thread(target=read)
    reader.start()
    try:
        wait_until(lambda: drives(field_robots) or process.poll() is not None, Deadline.after(180))
        assert process.poll() is None, output_parts
        sent_ns = time.time_ns()
        os.write(master, b"\x03")
        stopped_after_s = standstill_s(field_robots, sent_ns)
        assert process.wait(timeout=180) == 130
    finally:
        process.kill()
        process.wait()
        reader.join()
        os.close(master)
    assert stopped_after_s < ORDER_S, "by the order, not by its lease"
    text = b"".join(output_parts).decode()
    assert text.index("stopping: rover-1") < text.index("rover-1: stopped (stationary)")


@pytest.mark.nightly  # CI stops a robot on its outward path
def test_ctrl_c_while_the_robot_drives_back_stops_it(field_robots: FieldRobots) -> None:
    (field_robots.folder / "procedures" / "drive.yaml").write_text(SHORT, encoding="utf-8")
    home_m = place_m(field_robots)
    process = start(field_robots.folder, *RUN)
    try:
        wait_during(process, lambda: drives(field_robots))
        wait_during(
            process, lambda: (now := receiver_motion(field_robots)) is not None and now.velocity_m_s[0] < -0.3
        )
        sent_ns = time.time_ns()
        process.send_signal(signal.SIGINT)
        stopped_after_s = standstill_s(field_robots, sent_ns)
        run = finish(process)
    finally:
        process.kill()
        wait_for_end({process.pid}, within_s=60.0)
    assert stopped_after_s < ORDER_S, "by the order, not by its lease"
    assert run.code == 130
    assert math.dist(place_m(field_robots), home_m) > 0.3, "it has not reached its home"
    assert_held(field_robots, "stopped by the operator")


@contextmanager
def changed_rover(field_robots: FieldRobots, old: str, new: str) -> Iterator[None]:
    """Change the profile of the receiver for the duration of the context."""
    profile = field_robots.folder / "robots" / "rover.yaml"
    text = profile.read_text(encoding="utf-8")
    profile.write_text(replace_text(text, old, new), encoding="utf-8")
    try:
        yield
    finally:
        profile.write_text(text, encoding="utf-8")


def test_a_robot_outside_its_fence_does_not_start(field_robots: FieldRobots) -> None:
    fence_m = 2.0
    with changed_rover(field_robots, "fence_m: 30", f"fence_m: {fence_m:g}"):
        with driving(field_robots, SHORT) as process:
            process.send_signal(signal.SIGINT)
            assert finish(process).code == 130
        home_m = place_m(field_robots)
        topic = ("rostopic", "pub", "-r", "10", "/cmd_vel", "geometry_msgs/Twist", "{linear: {x: 1.0}}")
        words = ("sh", "-c", '"$@" & cat >/dev/null; kill $!', "sh", *with_environment(topic, setup=SETUP))
        session = field_robots.testbed.shells[Role.RECEIVER].begin(words, deadline=Deadline.after(30))
        wait_until(lambda: math.dist(place_m(field_robots), home_m) > fence_m + 0.2, Deadline.after(60))
        session.end(deadline=Deadline.after(60), check=False)
        wait_until(lambda: stationary(field_robots), Deadline.after(60))
        moved_m = place_m(field_robots)
        trial = only_trial(field_robots.folder)
        run = run_here(field_robots.folder, "resume", str(trial), *RESUME, "--allow-motion-after-fault")
        assert run.code == 5, run.err
        assert f"outside its fence of {fence_m:g} m" in run.err
        assert place_m(field_robots) == pytest.approx(moved_m, abs=0.01)
        assert motions(trial) == ["origin", "begun", "held", "allowed", "held"]


def test_stop_from_another_terminal_works_while_fieldkit_is_suspended(field_robots: FieldRobots) -> None:
    with driving(field_robots) as process:
        process.send_signal(signal.SIGSTOP)
        sent_ns = time.time_ns()
        run = run_here(field_robots.folder, "stop", "--all")
        stopped_after_s = standstill_s(field_robots, sent_ns)
        assert run.code == 0, run.err + run.out
        assert sorted(run.out.splitlines()) == [
            "rover-1: stopped (stationary)",
            "rover-2: no program of fieldkit moves it; nothing was sent to it",
            "rover-3: no program of fieldkit moves it; nothing was sent to it",
        ]
        process.send_signal(signal.SIGCONT)
        trial_run = finish(process)
    assert trial_run.code == 3, trial_run.err
    assert "stopped the robots at" in trial_run.err
    assert standstill_s(field_robots, sent_ns + int(1e9 * stopped_after_s) + 1) == 0.0, "nothing moved again"
    second_run = run_here(field_robots.folder, "stop", "rover-1")
    assert (second_run.code, second_run.out) == (
        0,
        "rover-1: no program of fieldkit moves it; nothing was sent to it\n",
    )
    field_robots.links.cut(Role.SENDER)
    partial_run = run_here(field_robots.folder, "stop", "--all")
    assert partial_run.code == 3
    assert "rover-2: NOT REACHED: stop it by hand" in partial_run.out
    assert "rover-1: no program of fieldkit moves it" in partial_run.out


def test_ctrl_c_while_the_program_starts_prevents_motion(field_robots: FieldRobots) -> None:
    (field_robots.folder / "procedures" / "drive.yaml").write_text(DRIVE, encoding="utf-8")
    started_ns = time.time_ns()
    process = start(field_robots.folder, *RUN, "--json")
    wait_for_line(process, '"move rover-1"')
    process.send_signal(signal.SIGINT)
    run = finish(process)
    assert run.code == 130
    assert "stopping: " in run.err
    speeds = [
        math.hypot(*point.velocity_m_s)
        for point in track_of(field_robots, Role.RECEIVER)
        if point.utc_ns > started_ns
    ]
    assert max(speeds, default=0.0) == 0.0
    assert not [
        name for name in only_trial(field_robots.folder).rglob("drive.jsonl") if name.read_text(encoding="ascii")
    ]


@pytest.mark.usefixtures("_short_lease")
def test_ctrl_c_with_an_unreachable_robot_reports_that_its_lease_stops_it(field_robots: FieldRobots) -> None:
    with driving(field_robots) as process:
        field_robots.links.cut(Role.RECEIVER)
        process.send_signal(signal.SIGINT)
        wait_until(
            lambda: (now := receiver_motion(field_robots)) is not None and not now.is_moving, Deadline.after(60)
        )
        run = finish(process)
    assert run.code == 130
    assert f"no answer from rover-1: it stops automatically within {LEASE_S:g} s" in run.err


def test_stop_of_a_suspended_agent_prevents_further_velocities(field_robots: FieldRobots) -> None:
    with driving(field_robots) as process:
        (agent,) = [pid for pid in descendants(os.getpid()) if b"drive" in command_line(pid)]
        os.kill(agent, signal.SIGSTOP)
        wait_until(
            lambda: (now := receiver_motion(field_robots)) is not None and not now.is_moving, Deadline.after(60)
        )
        stationary_since_ns = time.time_ns()
        stopped = run_here(field_robots.folder, "stop", "rover-1")
        assert (stopped.code, stopped.out) == (0, "rover-1: stopped (stationary)\n")
        wait_for_end({agent}, within_s=60.0)
        assert standstill_s(field_robots, stationary_since_ns) == 0.0
        assert finish(process).code == 3
    assert standstill_s(field_robots, stationary_since_ns) == 0.0
    trial = only_trial(field_robots.folder)
    assert motions(trial) == ["origin", "begun", "held"]
    second_run = run_here(field_robots.folder, "resume", str(trial), *RESUME)
    assert second_run.code == 5, second_run.err
    assert "no robot moves until a person confirms: rover-1" in second_run.err
    assert standstill_s(field_robots, stationary_since_ns) == 0.0


def command_line(pid: int) -> list[bytes]:
    """Return the command line of a process; empty if it is not an agent or has exited."""
    with suppress(OSError):
        words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
        return words if b"python" in words[0] and any(b"/agent-" in word for word in words) else []
    return []


FAR_M = 3.0
AFTER = (
    DRIVE.replace("repeats: 1\nattempts: 1", "repeats: 2\nattempts: 2")
    .replace("away: 20m", f"away: {FAR_M:g}m")
    .replace("count: 150", "count: 50")  # twice the time for the path
)
RESUME = ("--yes", "--allow-motion")


def place_m(field_robots: FieldRobots) -> Vector:
    place = track_of(field_robots, Role.RECEIVER)[-1].position_m
    assert place is not None
    return place


def drives(field_robots: FieldRobots) -> bool:
    return (now := receiver_motion(field_robots)) is not None and now.velocity_m_s[0] > SPEED_M_S / 2


def stationary(field_robots: FieldRobots) -> bool:
    return (now := receiver_motion(field_robots)) is not None and not now.is_moving


def motions(trial: Path) -> list[str]:
    lines = (trial / "motion.jsonl").read_text(encoding="utf-8").splitlines()
    return [json.loads(line)["event"] for line in lines]


@pytest.mark.usefixtures("_short_lease")
def test_after_a_fault_no_robot_moves_before_a_confirmation(field_robots: FieldRobots) -> None:
    (field_robots.folder / "procedures" / "drive.yaml").write_text(AFTER, encoding="utf-8")
    home_m = place_m(field_robots)
    process = start(field_robots.folder, *RUN)
    try:
        wait_during(process, lambda: drives(field_robots))
        field_robots.links.cut(Role.RECEIVER)
        wait_until(lambda: stationary(field_robots), Deadline.after(60))
        stopped_m = place_m(field_robots)
        field_robots.links.restore(Role.RECEIVER)
        _, err = process.communicate(timeout=180)
    finally:
        process.kill()
    assert process.returncode == 5, err
    assert 0.1 < math.dist(stopped_m, home_m) < FAR_M
    trial = only_trial(field_robots.folder)
    assert motions(trial) == ["origin", "begun", "held"]
    # --yes is not a confirmation.
    second_run = run_here(field_robots.folder, "resume", str(trial), *RESUME)
    assert second_run.code == 5, second_run.err
    assert "no order from the laptop for 2 s" in second_run.err
    assert place_m(field_robots) == pytest.approx(stopped_m, abs=0.01)
    # Enter is not a confirmation either, because the default answer is to stop.
    answers = field_robots.folder / "answers"
    answers.write_text("\n\n", encoding="utf-8")
    enter_run = run_here(field_robots.folder, "resume", str(trial), "--answers", str(answers), "--allow-motion")
    assert enter_run.code == 5, enter_run.err
    assert place_m(field_robots) == pytest.approx(stopped_m, abs=0.01)
    # With the option, the robot drives back along its path and then repeats the complete drive.
    started_ns = track_of(field_robots, Role.RECEIVER)[-1].utc_ns
    option_run = run_here(field_robots.folder, "resume", str(trial), *RESUME, "--allow-motion-after-fault")
    assert option_run.code == 0, option_run.err
    track = [
        point for point in track_of(field_robots, Role.RECEIVER) if point.utc_ns > started_ns and point.position_m
    ]
    error_m = [math.dist(point.position_m or home_m, home_m) for point in track]
    assert max(error_m) == pytest.approx(FAR_M, abs=0.3), (
        "it does not drive the whole distance again from where it stopped"
    )
    assert place_m(field_robots) == pytest.approx(home_m, abs=0.3)
    assert motions(trial)[3:] == ["allowed", *("begun", "ended") * 2]


SUSPEND = r"""
for folder in /proc/[0-9]*; do
  case "$(readlink "$folder/cwd")" in *"$1"*) ;; *) continue ;; esac
  words=$(tr '\0' ' ' <"$folder/cmdline")
  case $words in *python*agent-*.pyz\ drive\ *) kill "-$2" "${folder#/proc/}" ;; esac
done
"""


def test_a_suspended_driver_does_not_continue_until_a_person_confirms(field_robots: FieldRobots) -> None:
    (field_robots.folder / "procedures" / "drive.yaml").write_text(AFTER, encoding="utf-8")
    shell = field_robots.testbed.shells[Role.RECEIVER]

    def send(name: str) -> None:
        words = ("sh", "-c", SUSPEND, "sh", only_trial(field_robots.folder).name, name)
        shell.run(words, deadline=Deadline.after(30), check=False)

    process = start(field_robots.folder, *RUN)
    try:
        wait_during(process, lambda: drives(field_robots))
        send("STOP")
        wait_until(lambda: stationary(field_robots), Deadline.after(60))  # after the time limit of the base
        stopped_m, since_s = place_m(field_robots), time.monotonic()
        wait_until(lambda: time.monotonic() > since_s + 1.0, Deadline.after(60))
        send("CONT")
        _, err = process.communicate(timeout=180)
    finally:
        send("CONT")
        process.kill()
    assert process.returncode == 5, err
    assert "its program was suspended for" in err
    assert place_m(field_robots) == pytest.approx(stopped_m, abs=0.01)
    trial = only_trial(field_robots.folder)
    answers = field_robots.folder / "answers"
    answers.write_text("\nconfirm\n", encoding="utf-8")
    field_robots.testbed.place(PLACEMENT)
    confirmed_run = run_here(field_robots.folder, "resume", str(trial), "--answers", str(answers), "--allow-motion")
    assert confirmed_run.code == 0, confirmed_run.err
    assert motions(trial)[2:6] == ["held", "confirmed", "origin", "begun"]
