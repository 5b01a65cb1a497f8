"""Stop of programs that move robots: the script of the robot runs in a folder of this machine in each userland."""

from pathlib import Path

import pytest

from fieldkit.agent.orders import CANCELLED
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import LinkError, LockLostError, RobotError
from fieldkit.core.model import Role
from fieldkit.motion import halting
from fieldkit.remote import evidence, jobs
from fieldkit.remote.jobs import Job
from fieldkit.remote.motion_states import UNCONFIRMED_STATES, MotionState
from fieldkit.trial.running.locks import Holder, locked
from tests.helpers.sshd import wait_until
from tests.helpers.userlands import USERLANDS, LocalShell, userland_path

pytestmark = pytest.mark.emulated

FOLDER = jobs.work_folder("trial-a", "tcp-01-1")
ANNA = Holder("trial-a", "anna@one", "trial-a")
DRIVE_SCRIPT = "trap 'touch .jobs/drive/stationary; exit' INT; echo up; while :; do sleep 0.05; done"
LANDING_SCRIPT = (
    "trap 'echo 1.0 land: x >&2; until [ -e ground ]; do sleep 0.05; done; echo 5.0 landed >&2; exit' INT; "
    "echo up; while :; do sleep 0.05; done"
)
ALARM_SCRIPT = (
    "trap 'touch .jobs/fly/unhurried; echo 1.0 land: x >&2; echo 1.2 ALARM: IT MAY FALL >&2; trap : INT' INT; "
    "echo up; while :; do sleep 0.05; done"
)
IDLE_LOOP = "while :; do sleep 0.05; done"
HANGING_SCRIPT = "trap '' INT; echo up; while :; do sleep 0.05; done"


@pytest.fixture(params=USERLANDS)
def robot(tmp_path: Path, request: pytest.FixtureRequest) -> LocalShell:
    home = tmp_path / "home"
    home.mkdir()
    shell = LocalShell(home, userland_path(request.param, tmp_path / "bin"), "turtlebot-1")
    jobs.install(shell, Deadline.after(30))
    return shell


def start(robot: LocalShell, name: str, verb: str, script: str) -> None:
    """Start a program with the command line of the agent and the behaviour of a shell script."""
    argv = ("sh", "-c", script, "python3", "../../agent-0123456789ab.pyz", verb, '{"over": "ros1"}')
    jobs.start(robot, Job(FOLDER, name, argv, 60.0, f"{name}.log", ready="log:up"))


def running_jobs(robot: LocalShell) -> list[str]:
    return [line.split()[0].rpartition("/")[2] for line in jobs.list_running(robot, Deadline.after(30))]


def test_all_moving_programs_are_stopped_and_report_their_state(robot: LocalShell) -> None:
    evidence.begin(robot, FOLDER, "sender", "lo")
    start(robot, "drive", "drive", DRIVE_SCRIPT)
    start(robot, "fly", "fly", LANDING_SCRIPT)
    start(robot, "record", "mavlink", HANGING_SCRIPT)
    halted = halting.halt(robot, "bert@two", Deadline.after(60))
    assert halted.error is None
    assert dict(halted.programs) == {
        f"{FOLDER}/.jobs/drive": MotionState.STATIONARY,
        f"{FOLDER}/.jobs/fly": MotionState.LAND,
    }
    assert halted.state is MotionState.LAND, "the most dangerous state is reported"
    names = [name for name, _ in halted.programs]
    (robot.home / FOLDER / "ground").touch()
    wait_until(
        lambda: halting.poll_states(robot, names, Deadline.after(30)).state is MotionState.LANDED, Deadline.after(60)
    )
    assert "record" in running_jobs(robot), "the recorder does not move the robot"
    second_result = halting.halt(robot, "bert@two", Deadline.after(60))
    assert (second_result.programs, second_result.state) == ((), MotionState.NOTHING)
    with pytest.raises(RobotError, match=r"the jobs of .* were stopped by bert@two"):
        start(robot, "later", "drive", DRIVE_SCRIPT)
    evidence.end_jobs(robot, FOLDER)


def test_alarm_is_the_state_of_a_drone_that_does_not_land(robot: LocalShell) -> None:
    evidence.begin(robot, FOLDER, "sender", "lo")
    start(robot, "fly", "fly", ALARM_SCRIPT)
    start(robot, "record", "mavlink", HANGING_SCRIPT)
    halted = halting.halt(robot, "bert@two", Deadline.after(60))
    assert halted.programs == ((f"{FOLDER}/.jobs/fly", MotionState.ALARM),)
    aborted = jobs.abort(robot, "bert@two", Deadline.after(60))
    assert aborted.landing == ((f"{FOLDER}/.jobs/fly", "alarm"),), "the landing pilot is not killed"
    assert [line.split()[0] for line in aborted.jobs] == [f"{FOLDER}/fly", f"{FOLDER}/record"]
    assert running_jobs(robot) == ["fly"]
    (robot.home / FOLDER / ".jobs/fly/unhurried").unlink()
    assert jobs.abort(robot, "bert@two", Deadline.after(60)).landing == ()
    assert running_jobs(robot) == []


@pytest.mark.parametrize("verb", ["drive", "fly"])
@pytest.mark.parametrize(("exit_code", "state"), [(CANCELLED, MotionState.IDLE), (1, MotionState.ENDED)])
def test_exit_without_a_confirmation_is_only_safe_before_the_start(
    robot: LocalShell, verb: str, exit_code: int, state: MotionState
) -> None:
    evidence.begin(robot, FOLDER, "sender", "lo")
    start(robot, verb, verb, f"trap 'exit {exit_code}' INT; echo up; {IDLE_LOOP}")
    halted = halting.halt(robot, "bert@two", Deadline.after(60))
    assert halted.programs == ((f"{FOLDER}/.jobs/{verb}", state),)
    assert (halted.state in UNCONFIRMED_STATES) == (state is MotionState.ENDED)


def test_landed_drone_is_confirmed_although_its_guard_had_nothing_to_land(robot: LocalShell) -> None:
    evidence.begin(robot, FOLDER, "sender", "lo")
    start(robot, "fly", "fly", f"trap 'echo 1.0 landed >&2; exit {CANCELLED}' INT; echo up; {IDLE_LOOP}")
    start(robot, "guard", "fly", f"trap 'exit {CANCELLED}' INT; echo up; {IDLE_LOOP}")
    assert halting.halt(robot, "bert@two", Deadline.after(60)).state is MotionState.LANDED


def test_liveness_file_and_time_since_boot_are_read(robot: LocalShell) -> None:
    content = bytes(range(64))
    (robot.home / FOLDER).mkdir(parents=True)
    (robot.home / FOLDER / "liveness").write_bytes(content)
    answer = halting.read_liveness(robot, f"{FOLDER}/liveness", Deadline.after(60))
    assert answer[:64] == content
    assert 0 < float(answer[64:].split()[0]) <= float(Path("/proc/uptime").read_text(encoding="ascii").split()[0])
    with pytest.raises(RobotError):
        halting.read_liveness(robot, f"{FOLDER}/missing", Deadline.after(60))


def test_program_that_does_not_confirm_is_killed_and_reported(robot: LocalShell) -> None:
    evidence.begin(robot, FOLDER, "sender", "lo")
    start(robot, "drive", "drive", HANGING_SCRIPT)
    (halted,) = halting.halt_all({"turtlebot-1": robot}, "bert@two", 60.0).values()
    assert halted.programs == ((f"{FOLDER}/.jobs/drive", MotionState.SILENT),)
    wait_until(lambda: not running_jobs(robot), Deadline.after(60))


def test_trial_with_the_lock_is_reported_and_cannot_start_programs(robot: LocalShell) -> None:
    with locked({Role.SENDER: robot}, ANNA, sink=lambda _: None):
        evidence.begin(robot, FOLDER, "sender", "lo", token=ANNA.token)
        start(robot, "drive", "drive", DRIVE_SCRIPT)
        result = halting.halt_attempt(robot, FOLDER, "the-operator", Deadline.after(60))
        assert result.state is MotionState.STATIONARY
        other_attempt = jobs.work_folder("trial-a", "tcp-01-2")
        evidence.begin(
            robot, other_attempt, "sender", "lo", token=ANNA.token
        )  # the stop of an attempt does not release the lock
        halting.halt(robot, "bert@two", Deadline.after(60))
        with pytest.raises(LockLostError, match=r"bert@two stopped the robots at \d\d:\d\d:\d\d UTC"):
            evidence.begin(robot, jobs.work_folder("trial-a", "tcp-01-3"), "sender", "lo", token=ANNA.token)
    with locked({Role.SENDER: robot}, ANNA, sink=lambda _: None):  # the trial is resumed
        evidence.begin(robot, jobs.work_folder("trial-a", "tcp-01-4"), "sender", "lo", token=ANNA.token)


def test_unreachable_robot_does_not_prevent_the_stop_of_others(robot: LocalShell) -> None:
    evidence.begin(robot, FOLDER, "sender", "lo")
    start(robot, "drive", "drive", DRIVE_SCRIPT)
    link_error = LinkError("no route", where="eve", remedy="")
    halted = halting.halt_all({"eve": link_error, "turtlebot-1": robot}, "bert@two", 60.0)
    assert halted["eve"].error is link_error
    assert halted["turtlebot-1"].state is MotionState.STATIONARY
