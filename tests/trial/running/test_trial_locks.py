"""Locks on robots: never two holders at the same time, expiry, and abort from another laptop."""

import re
import uuid
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import pytest

from fieldkit.core import runtime
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import ConfigurationError, LinkError, LockLostError, RobotError
from fieldkit.core.events import Event, Note
from fieldkit.core.model import Role
from fieldkit.remote import evidence, jobs
from fieldkit.remote.jobs import Job
from fieldkit.trial.running import locks
from fieldkit.trial.running.locks import Holder, locked, locked_exclusively
from fieldkit.trial.running.robots import Robots
from tests.helpers.casts import plain_plan
from tests.helpers.idle_testbed import IdleTestbed
from tests.helpers.sshd import wait_until
from tests.helpers.userlands import USERLANDS, LocalSession, LocalShell, userland_path

pytestmark = pytest.mark.emulated

ANNA = Holder("trial-a", "anna@one", "trial-a")
BERT = Holder("trial-b", "bert@two", "trial-b")
FOLDER = jobs.work_folder("trial-a", "tcp-01-1")


@pytest.fixture(params=USERLANDS)
def robot(tmp_path: Path, request: pytest.FixtureRequest) -> LocalShell:
    home = tmp_path / "home"
    home.mkdir()
    return LocalShell(home, userland_path(request.param, tmp_path / "bin"), "turtlebot-1")


def fail_on_event(event: Event) -> None:
    raise AssertionError(event)


def record_words(robot: LocalShell) -> list[str]:
    (path,) = (robot.home / ".fieldkit").glob("lock.*")
    return path.read_text(encoding="ascii").split()


def change_record(robot: LocalShell, *changes: tuple[int, str]) -> None:
    (path,) = (robot.home / ".fieldkit").glob("lock.*")
    words = path.read_text(encoding="ascii").split()
    for index, word in changes:
        words[index] = word
    path.write_text(" ".join(words) + "\n", encoding="ascii")


def begin(robot: LocalShell, holder: Holder) -> None:
    evidence.begin(robot, FOLDER, "sender", "lo", token=holder.token)


def test_a_locked_robot_names_its_holder_and_is_unlocked(robot: LocalShell) -> None:
    with locked({Role.SENDER: robot}, ANNA, sink=fail_on_event):
        begin(robot, ANNA)
        with (
            pytest.raises(
                RobotError, match=r"turtlebot-1: anna@one locked it at \d\d:\d\d:\d\d UTC, \d\.0 s ago, for trial-a"
            ) as caught,
            locked({Role.SENDER: robot}, BERT, sink=fail_on_event),
        ):
            raise AssertionError("taken twice")
        assert re.search(r"; the lock expires in (1 h 00 min|59 min \d\d s)$", caught.value.what)
        assert caught.value.remedy == "wait, resume that trial if it is yours, or end it: fieldkit abort"
    with locked({Role.SENDER: robot}, BERT, sink=fail_on_event):
        begin(robot, BERT)


def test_the_holder_is_read_without_locking_the_robot(robot: LocalShell) -> None:
    jobs.install(robot, Deadline.after(30))
    assert locks.read_lock(robot) is None
    with locked({Role.SENDER: robot}, ANNA, sink=fail_on_event, ttl_s=60):
        lock = locks.read_lock(robot)
        assert lock is not None
        assert lock.holder == ANNA
        assert 50 < lock.remaining_s <= 60
        change_record(robot, (4, "0"))
        assert locks.read_lock(robot) is None, "it has expired"
    assert locks.read_lock(robot) is None


def test_the_same_trial_can_lock_its_robot_again(robot: LocalShell) -> None:
    with (
        locked({Role.SENDER: robot}, ANNA, sink=fail_on_event),
        locked({Role.SENDER: robot}, ANNA, sink=fail_on_event),
    ):
        begin(robot, ANNA)


def test_only_one_of_many_simultaneous_laptops_locks_the_robot(robot: LocalShell) -> None:
    jobs.install(robot, Deadline.after(30))
    holders = [Holder(f"trial-{number}", f"laptop-{number}", "x") for number in range(12)]

    def try_lock(holder: Holder) -> bool:
        argv = ("sh", jobs.SCRIPT_PATH, "lock", holder.token, "60", holder.user, holder.purpose)
        return robot.run(argv, deadline=Deadline.after(60), check=False).exit_code == 0

    for turn in range(3):
        with ThreadPoolExecutor(len(holders)) as pool:
            winners = [
                holder for holder, is_locked in zip(holders, pool.map(try_lock, holders), strict=True) if is_locked
            ]
        (winner,) = winners
        assert record_words(robot)[:2] == ["held", winner.token]
        # Let the lock expire, so that the laptops compete to replace it in the next round.
        change_record(robot, (4, "1"), (5, "0"), (6, "1"))
        assert turn < 3


def test_a_lock_number_that_was_used_and_removed_is_not_valid(robot: LocalShell) -> None:
    """The next number may be free again for a laptop that read the lock before two other laptops changed it."""
    jobs.install(robot, Deadline.after(30))
    script = """set -- needs; . "$1"; base=.fieldkit; newest
    for words in "lock trial-b 60 bert x" "unlock trial-b" "lock trial-c 60 carl x"; do sh "$0" $words || exit; done
    record held trial-a 60 anna x && echo won; ls .fieldkit/lock.*"""
    script = script.replace('"$1"', jobs.SCRIPT_PATH)
    completed = robot.run(("sh", "-c", script, jobs.SCRIPT_PATH), deadline=Deadline.after(30), check=False)
    assert completed.stdout == b".fieldkit/lock.3\n", completed.stderr
    assert record_words(robot)[:2] == ["held", "trial-c"]


def test_an_expired_lock_is_replaced_and_its_holder_is_notified(robot: LocalShell) -> None:
    with locked({Role.SENDER: robot}, ANNA, sink=fail_on_event):
        change_record(robot, (4, "1"))
        with locked({Role.SENDER: robot}, BERT, sink=fail_on_event):
            with pytest.raises(LockLostError, match=r"bert@two locked the robot at .* for trial-b") as caught:
                begin(robot, ANNA)
            assert caught.value.exit_code == 3
            begin(robot, BERT)


def test_a_lock_of_an_earlier_boot_expires_by_the_clock(robot: LocalShell) -> None:
    with locked({Role.SENDER: robot}, ANNA, sink=fail_on_event):
        change_record(robot, (2, "another-boot"), (4, "1"))
        with (
            pytest.raises(RobotError, match="anna@one locked it"),
            locked({Role.SENDER: robot}, BERT, sink=fail_on_event),
        ):
            raise AssertionError("taken twice")
        change_record(robot, (5, "99999999999"), (6, "99999999999"))  # the robot's clock has no battery and is behind
        with locked({Role.SENDER: robot}, BERT, sink=fail_on_event):
            begin(robot, BERT)


def test_begin_renews_the_lock_only_after_half_of_its_time(robot: LocalShell) -> None:
    with locked({Role.SENDER: robot}, ANNA, sink=fail_on_event, ttl_s=1000):
        record_before = record_words(robot)
        begin(robot, ANNA)
        assert record_words(robot) == record_before
        change_record(robot, (3, "0"), (4, str(int(record_before[3]) * 3 // 2)))  # 2/3 of the time since the boot
        begin(robot, ANNA)
        record_after = record_words(robot)
        assert int(record_after[4]) >= int(record_before[4])
        assert record_after[7:] == record_before[7:]


def test_an_expired_lock_without_a_new_holder_is_renewed(robot: LocalShell) -> None:
    with locked({Role.SENDER: robot}, ANNA, sink=fail_on_event):
        change_record(robot, (4, "1"))
        begin(robot, ANNA)
        assert int(record_words(robot)[4]) > 1


def test_abort_ends_jobs_of_any_trial_and_notifies_the_holder(robot: LocalShell) -> None:
    with locked({Role.SENDER: robot}, ANNA, sink=fail_on_event):
        begin(robot, ANNA)
        evidence.begin(robot, jobs.work_folder("older", "udp-03-1"), "sender", "lo")
        for folder in (FOLDER, jobs.work_folder("older", "udp-03-1")):
            argv = ("sh", "-c", "trap '' INT; echo up; while :; do sleep 0.05; done")
            jobs.start(robot, Job(folder=folder, name="capture", argv=argv, limit_s=60, log="log", ready="log:up"))
        (abort_result,) = locks.abort({"turtlebot-1": robot}, "bert@two").values()
        assert abort_result.error is None
        assert [line.split()[0] for line in abort_result.jobs] == [
            ".fieldkit/older/udp-03-1/capture",
            ".fieldkit/trial-a/tcp-01-1/capture",
        ]
        assert jobs.list_running(robot, Deadline.after(30)) == ()
        with pytest.raises(RobotError, match="cannot start: the jobs of"):
            jobs.run(robot, Job(folder=FOLDER, name="ping", argv=("true",), limit_s=5, log="log"))
        with pytest.raises(
            LockLostError, match=r"^turtlebot-1: the trial was aborted by bert@two at \d\d:\d\d:\d\d UTC"
        ):
            begin(robot, ANNA)
    with (
        locked({Role.SENDER: robot}, BERT, sink=fail_on_event),
        pytest.raises(LockLostError, match="bert@two locked the robot"),
    ):
        begin(robot, ANNA)
    with locked({Role.SENDER: robot}, ANNA, sink=fail_on_event):
        begin(robot, ANNA)


@pytest.mark.parametrize("output", ["", "exit 1", "echo no zone", "echo no zone; echo 1800000000"])
def test_a_robot_without_a_working_date_can_be_locked(robot: LocalShell, tmp_path: Path, output: str) -> None:
    (tmp_path / "bin" / "date").unlink(missing_ok=True)
    (tmp_path / "bin" / "date").write_text(f"#!/bin/sh\n{output}\n", encoding="ascii")
    (tmp_path / "bin" / "date").chmod(0o755)
    with locked({Role.SENDER: robot}, ANNA, sink=fail_on_event):
        with (
            pytest.raises(RobotError, match="anna@one locked it"),
            locked({Role.SENDER: robot}, BERT, sink=fail_on_event),
        ):
            raise AssertionError("taken")
        assert [result.locked for result in locks.abort({"turtlebot-1": robot}, "bert@two").values()] == [True]


def test_a_torn_record_does_not_block_for_long(robot: LocalShell) -> None:
    jobs.install(robot, Deadline.after(30))
    for content in ("", "held", "held trial-b boot x y z 1 bert trial"):
        (robot.home / ".fieldkit" / "lock.7").write_text(content, encoding="ascii")
        with locked({Role.SENDER: robot}, ANNA, sink=fail_on_event):
            begin(robot, ANNA)
        for path in (robot.home / ".fieldkit").glob("lock.*"):
            path.unlink()


def test_an_empty_record_does_not_hide_a_lock(robot: LocalShell) -> None:
    """Older versions of fieldkit leave such a record if the power fails just after they wrote it."""
    with locked({Role.SENDER: robot}, ANNA, sink=fail_on_event):
        (robot.home / ".fieldkit" / "lock.9").touch()
        with (
            pytest.raises(RobotError, match="anna@one locked it"),
            locked({Role.SENDER: robot}, BERT, sink=fail_on_event),
        ):
            raise AssertionError("taken twice")
        begin(robot, ANNA)
    assert record_words(robot)[0] == "free"


def test_a_robot_that_lost_its_records_is_locked_again(robot: LocalShell) -> None:
    with locked({Role.SENDER: robot}, ANNA, sink=fail_on_event):
        for path in (robot.home / ".fieldkit").glob("lock.*"):
            path.unlink()
        begin(robot, ANNA)
        with (
            pytest.raises(RobotError, match=r"unknown-user locked it at .*, for trial-a"),
            locked({Role.SENDER: robot}, BERT, sink=fail_on_event),
        ):
            raise AssertionError("taken twice")


def test_a_record_is_synced_before_it_becomes_a_lock(robot: LocalShell, tmp_path: Path) -> None:
    calls = tmp_path / "calls"
    for name in ("sync", "ln"):
        real = f"busybox {name}" if (tmp_path / "bin" / name).exists() else f"/bin/{name}"
        (tmp_path / "bin" / name).unlink(missing_ok=True)
        (tmp_path / "bin" / name).write_text(
            f'#!/bin/sh\nlocks=$(ls "{robot.home}/.fieldkit" | grep lock)\n'
            f'echo {name} "$(head -c 4 "$1" 2>&1)" "$locks" >>"{calls}"\nexec {real} "$@"\n',
            encoding="ascii",
        )
        (tmp_path / "bin" / name).chmod(0o755)
    with locked({Role.SENDER: robot}, ANNA, sink=fail_on_event):
        sync_call, link_call, sync_of_folder = calls.read_text(encoding="ascii").splitlines()
        assert re.fullmatch(r"sync held new-lock\.\d+", sync_call)
        assert link_call.startswith("ln held new-lock.")
        assert sync_of_folder.startswith("sync ")
        assert sync_of_folder.endswith(" lock.1")


def test_a_lock_is_extended_to_the_limit_of_a_job(robot: LocalShell) -> None:
    with locked({Role.SENDER: robot}, ANNA, sink=fail_on_event):
        begin(robot, ANNA)
        jobs.run(robot, Job(folder=FOLDER, name="long", argv=("true",), limit_s=7200, log="log"))
        lock = locks.read_lock(robot)
        assert lock is not None
        assert lock.remaining_s > 7200
        record_before = record_words(robot)
        jobs.run(robot, Job(folder=FOLDER, name="short", argv=("true",), limit_s=60, log="log"))
        assert record_words(robot) == record_before


def test_a_job_of_a_trial_that_lost_its_lock_does_not_start(robot: LocalShell) -> None:
    with locked({Role.SENDER: robot}, ANNA, sink=fail_on_event):
        begin(robot, ANNA)
        change_record(robot, (4, "1"))
        with locked({Role.SENDER: robot}, BERT, sink=fail_on_event):
            for call in (jobs.start, jobs.run):
                job = Job(folder=FOLDER, name=call.__name__, argv=("touch", "started"), limit_s=5, log="log")
                with pytest.raises(LockLostError, match=r"bert@two locked the robot at .* for trial-b"):
                    call(robot, job)
    assert not (robot.home / FOLDER / "started").exists()


def test_no_job_starts_in_a_folder_created_during_an_abort(robot: LocalShell, tmp_path: Path) -> None:
    called_file, continue_file = robot.home / "called", robot.home / "go"
    with locked({Role.SENDER: robot}, ANNA, sink=fail_on_event), ThreadPoolExecutor(1) as pool:
        real = "busybox df" if (tmp_path / "bin" / "df").exists() else "/bin/df"
        (tmp_path / "bin" / "df").unlink(missing_ok=True)
        wait = f'until [ -e "{continue_file}" ]; do sleep 0.01; done'
        wrapper = f'#!/bin/sh\ntouch "{called_file}"; {wait}; exec {real} "$@"\n'
        (tmp_path / "bin" / "df").write_text(wrapper, encoding="ascii")  # called after the lock was checked
        (tmp_path / "bin" / "df").chmod(0o755)
        submitted = pool.submit(begin, robot, ANNA)
        wait_until(called_file.exists, Deadline.after(30))
        assert locks.abort({"turtlebot-1": robot}, "bert@two")["turtlebot-1"].locked
        continue_file.touch()
        submitted.result(30)
        with pytest.raises(LockLostError, match="the trial was aborted by bert@two"):
            jobs.run(robot, Job(folder=FOLDER, name="job", argv=("touch", "started"), limit_s=5, log="log"))
    assert not (robot.home / FOLDER / "started").exists()


def test_aborting_a_free_robot_reports_no_lock(robot: LocalShell) -> None:
    for _ in range(2):
        (abort_result,) = locks.abort({"turtlebot-1": robot}, "bert@two").values()
        assert (abort_result.locked, abort_result.error) == (False, None)
    with locked({Role.SENDER: robot}, ANNA, sink=fail_on_event):
        pass
    assert not locks.abort({"turtlebot-1": robot}, "bert@two")["turtlebot-1"].locked


def test_a_holder_that_lost_a_robot_is_notified(robot: LocalShell, tmp_path: Path) -> None:
    """It is notified even if another robot does not answer."""
    plan = plain_plan()
    anna = Holder(plan.session, "anna@one", plan.trial)
    shells = {Role.SENDER: robot, Role.RECEIVER: RobotOutOfRange(tmp_path, robot="abe")}
    with locked({Role.SENDER: robot}, anna, sink=fail_on_event):
        robots = Robots(plan, IdleTestbed(shells))
        robots.require_locks()
        locks.abort({"turtlebot-1": robot}, "bert@two")
        with pytest.raises(LockLostError, match=r"turtlebot-1: the trial was aborted by bert@two at"):
            robots.require_locks()


def test_fetched_evidence_is_deleted_after_a_broken_lock(robot: LocalShell) -> None:
    with locked({Role.SENDER: robot}, ANNA, sink=fail_on_event):
        begin(robot, ANNA)
        locks.abort({"turtlebot-1": robot}, "bert@two")
        with pytest.raises(LockLostError):
            evidence.begin(robot, f"{FOLDER}-2", "sender", "lo", token=ANNA.token, old_folder=FOLDER)
    assert not (robot.home / FOLDER).exists()


class RobotOutOfRange(LocalShell):
    """A robot that does not answer after `calls_left` further commands."""

    calls_left = 0

    def begin(self, argv: object, *, deadline: Deadline, until: bytes | None = None) -> LocalSession:
        self.calls_left -= 1
        if self.calls_left < 0:
            raise LinkError("did not answer", where=self.robot)
        return super().begin(argv, deadline=deadline, until=until)  # type: ignore[arg-type]


@pytest.fixture
def cast(tmp_path: Path) -> dict[Role, RobotOutOfRange]:
    shells = {}
    for role, name in ((Role.SENDER, "zoe"), (Role.RECEIVER, "abe")):
        (tmp_path / name).mkdir()
        shells[role] = RobotOutOfRange(tmp_path / name, robot=name)
        shells[role].calls_left = 100
    return shells


def test_no_robot_stays_locked_if_one_cannot_be_locked(cast: dict[Role, RobotOutOfRange]) -> None:
    with locked({Role.SENDER: cast[Role.SENDER]}, BERT, sink=fail_on_event):
        with pytest.raises(RobotError, match="zoe: bert@two locked it"), locked(cast, ANNA, sink=fail_on_event):
            raise AssertionError("taken")
        assert record_words(cast[Role.RECEIVER])[0] == "free", (
            "it was locked first, because its name is first, and unlocked again"
        )


def test_a_robot_that_cannot_be_unlocked_is_reported(cast: dict[Role, RobotOutOfRange]) -> None:
    events: list[Event] = []
    with locked(cast, ANNA, sink=events.append):
        cast[Role.SENDER].calls_left = 0
    (note,) = events
    assert isinstance(note, Note)
    assert note.text.startswith("zoe stays locked until its lock expires")
    assert record_words(cast[Role.RECEIVER])[0] == "free"


def test_an_unreachable_robot_does_not_prevent_other_aborts(cast: dict[Role, RobotOutOfRange]) -> None:
    with ExitStack() as stack:
        stack.enter_context(locked(cast, ANNA, sink=lambda event: None))
        cast[Role.RECEIVER].calls_left = 0
        link_error = LinkError("did not answer", where="eve")
        results = locks.abort({"abe": cast[Role.RECEIVER], "eve": link_error, "zoe": cast[Role.SENDER]}, "bert@two")
    assert {name: result.error is None for name, result in results.items()} == {
        "abe": False,
        "eve": False,
        "zoe": True,
    }
    assert record_words(cast[Role.SENDER])[:2] == ["aborted", "trial-a"]


def test_the_user_and_this_machine_have_names() -> None:
    user, _, machine = runtime.user_at_host().partition("@")
    assert user
    assert machine


def test_a_second_process_with_the_token_does_not_unlock_the_robots(cast: dict[Role, RobotOutOfRange]) -> None:
    # A trial without a session uses its name as the token, which may be longer than the name of a socket.
    anna = Holder(uuid.uuid4().hex + "_of_a_long_procedure" * 10, "anna@one", "trial-a")
    with locked_exclusively(cast, anna, sink=fail_on_event):
        with (
            pytest.raises(ConfigurationError, match="another fieldkit process runs this trial"),
            locked_exclusively(cast, anna, sink=fail_on_event),
        ):
            raise AssertionError("two processes run the trial")
        for shell in cast.values():
            begin(shell, anna)
    with locked_exclusively(cast, anna, sink=fail_on_event):
        begin(cast[Role.SENDER], anna)


def test_ctrl_c_closes_connections_before_the_robots_are_unlocked(cast: dict[Role, RobotOutOfRange]) -> None:
    """Unlocking must not wait again for a lost link."""
    closed_robots: list[str] = []
    for shell in cast.values():
        shell.close = lambda name=shell.robot: closed_robots.append(name)  # type: ignore[method-assign,misc]
    with pytest.raises(KeyboardInterrupt), locked(cast, ANNA, sink=fail_on_event):
        raise KeyboardInterrupt
    assert closed_robots == ["abe", "zoe"]
    assert {record_words(shell)[0] for shell in cast.values()} == {"free"}
