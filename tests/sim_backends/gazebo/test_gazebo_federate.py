"""The physics federate `gazebo`, tested with a server that behaves like Gazebo Fortress with DART."""

import math
import os
import re
import shlex
import signal
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest

from fieldkit.cli import main
from sim_backends.cosim import load_scenario
from sim_backends.cosim.scenario.agent_setup import make_bodies
from sim_backends.cosim.scenario.external import make_hello
from sim_backends.cosim.scenario.sdf_world import scenario_sdf
from sim_backends.federates.conformance.probe import Target
from sim_backends.federates.conformance.suite import checks, run_check
from sim_backends.federates.frames import PHYSICS
from sim_backends.federates.handshake import Hello
from sim_backends.federates.protocols import FederateError
from sim_backends.federates.remote import RemotePhysics, open_physics
from sim_backends.federates.session import open_session
from sim_backends.gazebo.federate import adapter
from sim_backends.gazebo.sdf import model_sdf
from sim_backends.physics import robot_limits
from sim_backends.physics.body import Twist, Velocity
from sim_backends.physics.robot_limits import QuadrotorLimits
from sim_backends.world.motion import State
from sim_backends.world.world import load_world
from tests.helpers.gazebo_server import GazeboServer, gazebo_server, missing_libraries
from tests.helpers.host import descendants, process_file

pytestmark = [pytest.mark.emulated, pytest.mark.skipif(bool(missing_libraries()), reason=missing_libraries())]

SDF = scenario_sdf(load_scenario("convoy"))
WINDOW_NS = 10_000_000
REPORTED_S = 8
"""Time after which a lack of progress is reported; on a busy machine, Gazebo was found after more than 4 s."""


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[GazeboServer]:
    """Return a server whose resets are like those of Fortress: they only set the time."""
    with gazebo_server(tmp_path_factory.mktemp("gazebo"), SDF) as gazebo:
        yield gazebo


def hello(gazebo: GazeboServer, options: Mapping[str, object], changes: Mapping[str, object]) -> Hello:
    federate = {"physics.federate": "gazebo", "physics.options": {**gazebo.options, **options}}
    scenario = load_scenario("convoy", {**federate, **changes})
    world = load_world(scenario.world)
    return make_hello(scenario, world, make_bodies(scenario, world), 1, PHYSICS)


@contextmanager
def open_federate(
    gazebo: GazeboServer,
    options: Mapping[str, object] | None = None,
    changes: Mapping[str, object] | None = None,
    deadline_s: float = 30.0,
) -> Iterator[RemotePhysics]:
    physics = open_physics(
        shlex.quote(str(adapter().path())), hello(gazebo, options or {}, changes or {}), deadline_s
    )
    try:
        yield physics
    finally:
        physics.close()


def drive(physics: RemotePhysics, windows: int = 50) -> list[dict[str, State]]:
    """Return the states at the ends of windows; all robots have a new command in each window."""
    states = [dict(physics.advance(0, {}))]
    for window in range(1, windows + 1):
        commands = {
            "leader": Twist(0.01 * window),
            "follower": Twist(0.5, 0.02 * window),
            "drone": Velocity((0.01 * window, 0.0, 0.0), 0.5),
        }
        states.append(dict(physics.advance(window * WINDOW_NS, commands)))
    return states


def error_of(gazebo: GazeboServer, options: Mapping[str, object], windows: int = 100) -> str:
    with pytest.raises(FederateError) as error_info, open_federate(gazebo, options) as physics:
        drive(physics, windows)
    return str(error_info.value.what)


@pytest.fixture(scope="module")
def rebuilding_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[GazeboServer]:
    """Return a server whose resets build the world again, as later versions do."""
    with gazebo_server(tmp_path_factory.mktemp("exact"), SDF, "--reset", "world") as gazebo:
        gazebo.options.update(deterministic=True, acknowledge="required")
        yield gazebo


def test_the_gazebo_federate_passes_the_conformance_checks(rebuilding_server: GazeboServer) -> None:
    opener = partial(open_session, PHYSICS, shlex.quote(str(adapter().path())), deadline_s=30.0)
    target = Target(opener, hello(rebuilding_server, {}, {}), windows=200)
    results = [
        run_check(target, name, check)
        for name, check in checks(is_physics=True).items()
        # DART's last bits depend on memory addresses; two runs in one process of Gazebo are compared below.
        if name != "determinism"
    ]
    assert [result for result in results if result.failure] == []
    assert {result.name for result in results if result.skipped} == {"fork"}


def test_commands_apply_in_their_window_and_equal_runs_are_equal(rebuilding_server: GazeboServer) -> None:
    runs = []
    for _ in range(2):
        with open_federate(rebuilding_server) as physics:
            runs.append(drive(physics))
    for first, second in zip(*runs, strict=True):
        for name, state in first.items():
            assert state.position_m == pytest.approx(second[name].position_m, abs=1e-6)
    start, last = runs[0][0], runs[0][-1]
    # Acceleration and speed are those of the command; a turning robot with four wheels slips.
    assert last["leader"].velocity_m_s[0] == pytest.approx(0.49, abs=0.02)
    assert last["leader"].position_m[0] - start["leader"].position_m[0] == pytest.approx(0.125, abs=0.02)
    assert 0.05 < (last["follower"].heading_rad or 0.0) < 0.25
    # Gravity is compensated, and the drone turns to its direction.
    assert last["drone"].position_m == pytest.approx((19.125, 12.0, 8.0), abs=0.02)
    assert last["drone"].position_m[2] == pytest.approx(8.0, abs=1e-3)
    assert last["drone"].heading_rad == pytest.approx(0.43, abs=0.05)


def test_poses_of_an_older_time_are_not_used(rebuilding_server: GazeboServer, tmp_path: Path) -> None:
    with open_federate(rebuilding_server) as physics:
        expected = drive(physics, 10)
    assert "<dynamic_pose_hertz>2000<" in SDF
    slow_sdf = SDF.replace("<dynamic_pose_hertz>2000<", "<dynamic_pose_hertz>60<")
    with gazebo_server(tmp_path, slow_sdf) as gazebo, open_federate(gazebo) as physics:
        states = drive(physics, 10)
    for name, state in states[-1].items():
        assert state.position_m == pytest.approx(expected[-1][name].position_m, abs=1e-6)


def test_the_clock_may_arrive_after_the_poses_of_its_step(tmp_path: Path) -> None:
    with gazebo_server(tmp_path, SDF, "--fault", "late-clock@0") as gazebo, open_federate(gazebo) as physics:
        states = drive(physics, 20)
    assert states[-1]["leader"].position_m[0] > states[0]["leader"].position_m[0]


def test_lost_commands_are_sent_again(tmp_path: Path) -> None:
    states: list[dict[str, State]] = []
    for fault in ((), ("--fault", "lost-commands@0.3545")):
        (folder := tmp_path / str(len(states))).mkdir()
        with gazebo_server(folder, SDF, *fault) as gazebo, open_federate(gazebo) as physics:
            states.append(drive(physics)[-1])
    for name, state in states[0].items():
        assert state.position_m == pytest.approx(states[1][name].position_m, abs=1e-6)


def test_the_federate_reports_that_it_is_busy_if_gazebo_is_slow(tmp_path: Path) -> None:
    assert "<real_time_factor>5<" in SDF
    slow_sdf = SDF.replace("<real_time_factor>5<", "<real_time_factor>0.05<")
    start_s = time.monotonic()
    # 0.2 s until the robots are at rest take 4 s, which is longer than the deadline.
    with gazebo_server(tmp_path, slow_sdf) as gazebo, open_federate(gazebo, deadline_s=3.0) as physics:
        assert time.monotonic() - start_s > 3
        assert physics.advance(0, {}).keys() == {"leader", "follower", "drone"}


def test_a_run_starts_with_robots_at_their_starts_and_an_obstacle_stops_them(server: GazeboServer) -> None:
    with open_federate(server, {"velocity": "window"}) as physics:
        assert physics.welcome.software.startswith("Ignition Transport 11.")
        drive(physics)
    start_changes = {"agents.leader.at_m": [31.8, 53], "agents.follower.heading_deg": 90}
    with open_federate(server, changes=start_changes) as physics:
        start = physics.advance(0, {})
        assert start["leader"].position_m[:2] == pytest.approx((31.8, 53), abs=0.01)
        assert start["follower"].heading_rad == pytest.approx(1.5708, abs=0.01)
        states_at_wall = physics.advance(1_500_000_000, {"leader": Twist(0.8)})
    # The western side of the box is at 33 m, and the Husky is 0.99 m long.
    assert states_at_wall["leader"].position_m[0] == pytest.approx(33 - 0.495, abs=0.02)


def test_parallel_runs_use_one_gazebo_in_sequence(
    server: GazeboServer, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    options = ", ".join(f"{key}: {value}" for key, value in server.options.items())
    words = ["cosim", "run", "convoy", "--physics", "gazebo", "--set", f"physics.options={{{options}}}"]
    words += ["--set", "agents.drone.disappears=300ms"]
    code = main([*words, "--duration", "500ms", "--window", "20ms", "--policy", "sliding_window", "--seeds", "2"])
    output = capsys.readouterr()
    assert code == 0, output.err
    assert "2 seeds" in output.out or "leader" in output.out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"world": "moon"},
            "no service|/world/moon/control has not been found \\(visible worlds: baylands\\) within 8 s",
        ),
        ({"models": {"drone": "kite"}}, "it has no moving model kite \\(models and links: leader, follower, drone"),
        ({"command_topics": {"drone": "/nowhere"}}, "nothing subscribes to the commands of drone on /nowhere"),
        (
            {"origins_m": {"leader": [0, 0, 9]}, "place": False},
            "the model leader is .* m away from the start of leader",
        ),
    ],
)
def test_a_world_that_does_not_fit_is_reported(
    server: GazeboServer, options: Mapping[str, object], message: str
) -> None:
    with pytest.raises(FederateError, match=message), open_federate(server, {"timeout_s": REPORTED_S, **options}):
        pass


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("pause", "it has not reached Gazebo's time .* another program may have paused it within 8 s"),
        ("reset", "it was reset; Gazebo's clock is at 0"),
        ("step", "another program has advanced it; Gazebo's clock is at|it has advanced beyond"),
        ("remove", "the model leader has been removed"),
    ],
)
def test_another_program_that_controls_gazebo_is_reported(tmp_path: Path, fault: str, message: str) -> None:
    with gazebo_server(tmp_path, SDF, "--fault", f"{fault}@0.3545") as gazebo:
        error = error_of(gazebo, {"timeout_s": REPORTED_S})
    assert error.startswith("physics gazebo (")
    assert "failed at the request to advance from 0.25 s to 0.26 s" in error or fault != "pause"
    assert "Gazebo world 'baylands', whose last time is 0.2" in error
    assert re.search(message, error), error


def test_a_gazebo_that_exits_or_is_suspended_is_reported(tmp_path: Path) -> None:
    with gazebo_server(tmp_path, SDF, "--fault", "exit@0.3545") as gazebo:
        assert "it has disappeared, or is suspended; Gazebo's clock is at 0.35" in error_of(gazebo, {})
    with gazebo_server(tmp_path, SDF) as gazebo, open_federate(gazebo) as physics:
        physics.advance(WINDOW_NS, {})
        gazebo.suspend()
        with pytest.raises(
            FederateError, match=r"'baylands', whose last time is 0.01 s: it has disappeared, or is suspended"
        ):
            physics.advance(2 * WINDOW_NS, {})


LIFETIMES = {"agents.leader.appears": "100ms", "agents.drone.disappears": "300.5ms"}


def record_presence(physics: RemotePhysics) -> dict[str, list[int]]:
    """Return the times of each agent's states in ms; the leader drives from 150 ms on."""
    times_ms: dict[str, list[int]] = {}
    for time_ms in range(0, 401, 10):
        commands = {"leader": Twist(0.8)} if time_ms == 160 else {}
        for name, state in physics.advance(time_ms * 1_000_000, commands).items():
            times_ms.setdefault(name, []).append(time_ms)
            if name == "leader" and time_ms <= 150:
                assert state.position_m == pytest.approx((20, 53, 0.39), abs=0.05)
                assert math.hypot(*state.velocity_m_s) < 0.05
    return times_ms


@pytest.mark.parametrize("reset", ["time", "world"])
def test_robots_appear_and_disappear_at_their_times(reset: str, tmp_path: Path) -> None:
    """A reset of Fortress keeps the models, so the end of a run restores those that it has created and removed."""
    changes = {**LIFETIMES, "agents.leader.at_m": [20, 53]}
    with gazebo_server(tmp_path, SDF, "--reset", reset) as gazebo:
        for _ in range(2):
            with open_federate(gazebo, changes=changes) as physics:
                times_ms = record_presence(physics)
                driven_distance_m = physics.advance(1_000_000_000, {})["leader"].position_m[0] - 20
            assert times_ms["follower"] == list(range(0, 401, 10))
            assert times_ms["leader"] == list(range(100, 401, 10))
            assert times_ms["drone"] == list(range(0, 301, 10))
            assert driven_distance_m == pytest.approx(0.55, abs=0.1), "speed and acceleration are those of its model"
        with open_federate(gazebo) as physics:
            assert physics.advance(0, {}).keys() == {"leader", "follower", "drone"}


def test_the_next_run_restores_the_models_of_a_killed_run(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """The world has no model of the leader, which the killed run creates; it removes the drone."""
    changes = {**LIFETIMES, "agents.leader.at_m": [20, 53]}
    leader = re.search(r'<model name="leader">.*?</model>', SDF, re.DOTALL)
    assert leader is not None
    with gazebo_server(tmp_path, SDF.replace(leader[0], "")) as gazebo:
        with open_federate(gazebo, changes=changes) as physics:
            record_presence(physics)
            os.kill(adapter_pid(), signal.SIGKILL)
            with pytest.raises(FederateError, match="SIGKILL"):
                physics.advance(1_000_000_000, {})
        assert "killed" not in capfd.readouterr().err
        with open_federate(gazebo, changes=changes) as physics:
            notes = capfd.readouterr().err
            assert "an earlier run was killed; the model leader, which it may have created, is removed" in notes
            assert "an earlier run was killed; the model drone is created again if it was removed" in notes
            assert record_presence(physics)["drone"] == list(range(0, 301, 10))
        with pytest.raises(FederateError, match=r"it has no moving model leader \("), open_federate(gazebo):
            pass


def adapter_pid() -> int:
    """Return the process of the adapter, which is a child of this process."""
    pids = [
        pid for pid in descendants(os.getpid()) if b"gazebo-adapter" in process_file(pid, "cmdline").split(b"\0")[0]
    ]
    assert len(pids) == 1
    return pids[0]


def test_a_robot_that_has_been_removed_is_no_obstacle(tmp_path: Path) -> None:
    changes = {
        "agents.leader.at_m": [20, 53],
        "agents.leader.disappears": "100ms",
        "agents.follower.at_m": [18.4, 53],
        "agents.follower.heading_deg": 0,
    }
    with gazebo_server(tmp_path, SDF) as gazebo, open_federate(gazebo, changes=changes) as physics:
        physics.advance(0, {})
        end = physics.advance(2_500_000_000, {"follower": Twist(0.9)})
    assert end["follower"].position_m[0] > 20


def test_a_model_can_be_created_from_a_file(tmp_path: Path) -> None:
    body = QuadrotorLimits(**{**vars(robot_limits.quadrotor("iris")), "height_m": 0.3})
    model = tmp_path / "model.sdf"
    model.write_text(model_sdf("any name", body, step_ns=1_000_000, version="fortress"), encoding="utf-8")
    options = {"model_files": {"drone": str(model)}}
    changes = {"agents.drone.appears": "20ms"}
    with gazebo_server(tmp_path, SDF) as gazebo, open_federate(gazebo, options, changes) as physics:
        assert "drone" not in physics.advance(10_000_000, {})
        assert "drone" in physics.advance(20_000_000, {})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"create_service": "/nowhere"}, "the service /nowhere has not answered"),
        ({"model_files": {"leader": "/no/such.sdf"}}, "nothing subscribes to the commands of leader"),
    ],
)
def test_a_model_that_cannot_be_created_is_reported(
    options: Mapping[str, object], message: str, tmp_path: Path
) -> None:
    with (
        gazebo_server(tmp_path, SDF) as gazebo,
        open_federate(gazebo, {"timeout_s": REPORTED_S, **options}, LIFETIMES) as physics,
    ):
        physics.advance(50_000_000, {})
        with pytest.raises(FederateError, match=message) as error_info:
            physics.advance(100_000_000, {})
    assert "whose last time is 0.099 s" in error_info.value.what
