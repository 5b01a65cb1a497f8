"""Robots that drive by themselves, from the outside: by ROS 1, DDS and Zenoh, and a laptop with the field backend."""

import json
import math
from bisect import bisect_left
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from fieldkit.config.site import load_site
from fieldkit.core.deadline import Deadline
from fieldkit.core.model import Role, Topology, Vector, Whereabouts
from fieldkit.lab.protocol import Destination
from fieldkit.remote.command import with_environment
from fieldkit.remote.ssh import SshShell
from sim_backends.emulated.backend import EmulatedBackend
from sim_backends.emulated.ros.steered import Steered
from tests.helpers.host import wait_for_end
from tests.helpers.outside import Outside, robots_outside
from tests.helpers.paths import ROOT
from tests.helpers.runs import fieldkit, only_trial, rows, start
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
robots: {robot-1: {profile: turtlebot3_burger}}
roles: {}
emulated: {ros: debian}
"""
SPEED_M_S = 0.6
LEASE_S = 2.0
SETUP = ("/opt/ros/noetic/setup.bash",)
DRIVE = """\
name: drive
summary: The receiver drives away
scenario: los
topology: master
protocols: [udp]
repeats: 1
attempts: 1
steps:
  - move:
      robot: receiver
      path: [{away: 20m}]
      speed: 0.6m/s
      during:
        - ping: {from: sender, to: receiver, count: 150, interval: 200ms, payload_bytes: 500}
"""
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
RUN = ("trial", "drive", "5m", "--yes", "--allow-motion")


@pytest.fixture
def outside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Outside]:
    """Robots that outlive fieldkit, one of them quick, so that nobody waits for it."""
    monkeypatch.chdir(tmp_path)
    profile = (ROOT / "robots" / "turtlebot3_burger.yaml").read_text(encoding="utf-8")
    for old, new in (
        ("name: turtlebot3_burger", "name: rover"),
        ("max_speed_m_s: 0.22", "max_speed_m_s: 1.0"),
        ("turn_rad_s: 1.0, acceleration_m_s2: 0.5", "turn_rad_s: 3.0, acceleration_m_s2: 2.0"),
    ):
        assert old in profile
        profile = profile.replace(old, new)
    for folder in ("robots", "procedures"):
        (tmp_path / folder).mkdir()
    (tmp_path / "robots" / "rover.yaml").write_text(profile, encoding="utf-8")
    ros2 = profile.replace("name: rover", "name: rover_two").replace("variant: ros1", "variant: ros2")
    (tmp_path / "robots" / "rover_two.yaml").write_text(ros2, encoding="utf-8")
    zenoh = ros2.replace("name: rover_two", "name: rover_three").replace("distribution: foxy", "distribution: jazzy")
    zenoh = zenoh.replace("\nlimits:", "\n  environment: {RMW_IMPLEMENTATION: rmw_zenoh_cpp}\nlimits:")
    (tmp_path / "robots" / "rover_three.yaml").write_text(zenoh, encoding="utf-8")
    (tmp_path / "lab.yaml").write_text(SITE, encoding="utf-8")
    with robots_outside(tmp_path, site=tmp_path / "lab.yaml", topology=Topology.MASTER) as robots:
        yield robots


def track_of(outside: Outside, role: Role) -> list[Whereabouts]:
    return [one for one in outside.testbed.oracle.track(0) if one.role is role]


def place_at(track: list[Whereabouts], utc_ns: int) -> Vector:
    """Where the oracle had the robot, on a straight line between what it says."""
    after = bisect_left(track, utc_ns, key=lambda one: one.utc_ns)
    before, now = track[max(after - 1, 0)], track[min(after, len(track) - 1)]
    assert before.position_m is not None
    assert now.position_m is not None
    share = (utc_ns - before.utc_ns) / max(now.utc_ns - before.utc_ns, 1)
    x, y, z = (b + min(share, 1.0) * (n - b) for b, n in zip(before.position_m, now.position_m, strict=True))
    return x, y, z


def test_they_drive_there_and_back_and_the_world_agrees_with_their_odometry(outside: Outside) -> None:
    (outside.folder / "procedures" / "drive.yaml").write_text(BOTH, encoding="utf-8")
    starts_m = {role: track_of(outside, role)[-1].position_m for role in (Role.SENDER, Role.RECEIVER, Role.RELAY)}
    run = fieldkit(outside.folder, *RUN)
    assert run.code == 0, run.err
    trial = only_trial(outside.folder)
    (repeat,) = (trial / "repeats").iterdir()
    (row,) = rows(trial)
    # By ROS 1, and as it looks from the sender; by ROS 2 over DDS, and facing the other way; over Zenoh.
    for role, name, sign, way_m in (
        (Role.RECEIVER, "", 1, (0.4, 0.0)),
        (Role.SENDER, "outer.", -1, (0.3, 0.3)),
        (Role.RELAY, "zenoh.", 1, (0.0, 0.3)),
    ):
        log = [json.loads(line) for line in (repeat / f"{name}drive.jsonl").read_text(encoding="ascii").splitlines()]
        assert (log[-1]["ended"], log[-1]["phase"]) == ("home", "home")
        assert max(one["x_m"] for one in log) == pytest.approx(way_m[0], abs=0.1)
        assert max(one["y_m"] for one in log) == pytest.approx(way_m[1], abs=0.1)
        start_m, track = starts_m[role], track_of(outside, role)
        assert start_m is not None
        for one in log:
            east_m, north_m, _ = place_at(track, one["utc_ns"])
            off_m = east_m - start_m[0] - sign * one["x_m"], north_m - start_m[1] - sign * one["y_m"]
            assert max(map(abs, off_m)) < 0.25, one  # a quarter of a second at 0.6 m/s, on a busy machine
        # What it says last is of a robot that stands.
        end_m = track[-1].position_m
        assert end_m is not None
        assert sign * (end_m[0] - start_m[0]) == pytest.approx(log[-1]["x_m"], abs=0.01)
        assert sign * (end_m[1] - start_m[1]) == pytest.approx(log[-1]["y_m"], abs=0.01)
        speeds = [math.hypot(*one.velocity_m_s) for one in track]
        assert max(speeds) <= (1.0 if name else SPEED_M_S) + 1e-6
        assert max(speeds) > SPEED_M_S / 2
        # Columns of the drive against what the world saw of it.
        farthest_m = max(math.dist(one.position_m or start_m, start_m) for one in track)
        assert row[f"{name}drive_ended"] == "home"
        assert float(row[f"{name}drive_farthest_m"]) == pytest.approx(farthest_m, abs=0.02)
        assert float(row[f"{name}drive_out_m"]) == pytest.approx(math.hypot(*way_m), abs=0.1)
        assert float(row[f"{name}drive_back_off_m"]) == pytest.approx(math.dist(end_m, start_m), abs=0.01)
        assert 0 < float(row[f"{name}drive_speed_median_m_s"]) <= float(row[f"{name}drive_speed_max_m_s"])
        assert float(row[f"{name}drive_speed_max_m_s"]) == pytest.approx(max(speeds), abs=0.25)


def test_a_robot_of_a_lab_to_play_with_goes_where_it_is_driven(tmp_path: Path) -> None:
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
            topic = ("rostopic", "pub", "-r", "10", "/cmd_vel", "geometry_msgs/Twist", "{linear: {x: 0.2}}")
            # Until its input ends.
            driver = ("sh", "-c", '"$@" & cat >/dev/null; kill $!', "sh", *with_environment(topic, setup=SETUP))
            session = shell.begin(driver, deadline=Deadline.after(30))
            wait_until(lambda: lab.place_m("robot-1")[0] > place_m[0] + 0.1, Deadline.after(60))
            session.end(deadline=Deadline.after(60), check=False)
        assert lab.place_m("robot-1")[1:] == pytest.approx(place_m[1:], abs=1e-6), "it faces east"
        lab.move("robot-1", Destination(place_m[0], place_m[1], None, relative=False))
        assert lab.place_m("robot-1") == pytest.approx(place_m)


def said(outside: Outside) -> Steered | None:
    return outside.testbed.robots[Role.RECEIVER].steered()


def test_a_fieldkit_that_is_killed_stops_it(outside: Outside) -> None:
    (outside.folder / "procedures" / "drive.yaml").write_text(DRIVE, encoding="utf-8")
    process = start(outside.folder, *RUN)
    try:
        wait_until(
            lambda: (now := said(outside)) is not None and now.velocity_m_s[0] > SPEED_M_S / 2, Deadline.after(90)
        )
    finally:
        process.kill()
        process.communicate(timeout=60)
    wait_for_end({process.pid}, within_s=60.0)
    wait_until(lambda: (now := said(outside)) is not None and not now.moves, Deadline.after(60))
    shell = outside.testbed.shells[Role.RECEIVER]
    text = ("sh", "-c", "cat .fieldkit/*/*/drive.status")
    wait_until(
        lambda: json.loads(shell.run(text, deadline=Deadline.after(30)).stdout)["ended"] != "", Deadline.after(30)
    )
    status = json.loads(shell.run(text, deadline=Deadline.after(30)).stdout)
    assert status["ended"] == f"the laptop was silent for {LEASE_S:g} s"
    assert status["x_m"] < 19.0, "long before its end"
