"""Detached jobs: the script for robots, run in a folder of this machine by a shell without SSH."""

import os
import re
import shlex
import shutil
import signal
import stat
import subprocess
import tarfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import EvidenceError, RobotError
from fieldkit.core.model import Protocol
from fieldkit.measure.evidence import clock, host
from fieldkit.measure.evidence.terminations import Cause
from fieldkit.remote import evidence, fetching, jobs, script
from fieldkit.remote.jobs import Job
from fieldkit.remote.shell import Completed
from tests.helpers.host import EXITED_STATES
from tests.helpers.paths import DATA
from tests.helpers.sshd import free_port, wait_until
from tests.helpers.userlands import USERLANDS_OF_LONG_TESTS, LocalSession, LocalShell, userland_path

pytestmark = pytest.mark.emulated

FOLDER = jobs.work_folder("trial", "udp-01-1")
LINK_JOB = "link"
SNAPSHOTS = ("sender-sources-after.txt", "sender-sources-before.txt")
LINK_FILES = {"sender-link.txt.gz"} if shutil.which("iw", path=f"{os.environ['PATH']}:/usr/sbin:/sbin") else set()
"""Samples of the link, which fieldkit/remote/telemetry.sh records if iw is installed."""


@pytest.fixture(params=USERLANDS_OF_LONG_TESTS)
def shell(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[LocalShell]:
    home = tmp_path / "home"
    home.mkdir()
    local_shell = LocalShell(home, userland_path(request.param, tmp_path / "bin"))
    jobs.install(local_shell, Deadline.after(30))
    evidence.begin(local_shell, FOLDER, "sender", "lo")
    # Sampling of the link, if iw is installed, ends because this interface is not Wi-Fi.
    wait_until(lambda: jobs.list_running(local_shell, Deadline.after(30)) == (), Deadline.after(60))
    yield local_shell
    evidence.end_jobs(local_shell, FOLDER)
    assert jobs.list_running(local_shell, Deadline.after(30)) == ()


def stop(shell: LocalShell, job_spec: Job, *, signal: str = "INT", settle: str | None = None) -> int:
    """Stop a job with a timeout that is sufficient on a busy machine."""
    return jobs.stop(shell, job_spec, signal=signal, grace_s=30, settle=settle)


def job(*argv: str, name: str = "job", limit_s: float = 30.0) -> Job:
    return Job(folder=FOLDER, name=name, argv=argv, limit_s=limit_s, log=f"{name}.log")


def replace_program(shell: LocalShell, name: str, body: str) -> None:
    """Replace a program of the robot by a script. `{program}` in `body` is the command line of the real program."""
    program_path = Path(shell.path.partition(":")[0]) / name
    real_command = f"busybox {name}" if program_path.exists() else shutil.which(name)
    program_path.unlink(missing_ok=True)
    program_path.write_text(f"#!/bin/sh\n{body.format(program=real_command)}\n", encoding="ascii")
    program_path.chmod(0o755)


def leader(shell: LocalShell, name: str = "job") -> int:
    return int((shell.home / FOLDER / ".jobs" / name / "pid").read_text(encoding="ascii").split()[0])


def has_group_exited(pid: int) -> bool:
    """Return True if no process of the group runs."""
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, group = path.read_text(encoding="utf-8").rpartition(")")[2].split()[:3]
        except OSError:
            continue
        if int(group) == pid and state not in EXITED_STATES:
            return False
    return True


def test_job_keeps_streams_command_and_exit_code(shell: LocalShell) -> None:
    (shell.home / FOLDER / "in.txt").write_text("data", encoding="utf-8")
    job_spec = replace(job("sh", "-c", "cat; echo note >&2; exit 7"), stdin="in.txt", stdout="out.txt")
    assert jobs.run(shell, job_spec) == 7
    assert (shell.home / FOLDER / "out.txt").read_text(encoding="utf-8") == "data"
    assert (shell.home / FOLDER / "job.log").read_text(encoding="utf-8") == "note\n"
    assert jobs.begin_wait(shell, job_spec, 20).end(30) == 7


def test_run_waits_for_the_time_limit_and_the_time_to_become_ready(
    shell: LocalShell, monkeypatch: pytest.MonkeyPatch
) -> None:
    end = LocalSession.end
    waits_s: list[float] = []

    def record_end(session: LocalSession, *, deadline: Deadline, check: bool = True) -> Completed:
        waits_s.append(deadline.remaining_s)
        return end(session, deadline=deadline, check=check)

    monkeypatch.setattr(LocalSession, "end", record_end)
    assert jobs.run(shell, replace(job("true", limit_s=500), ready="log:up", ready_s=700)) == 0
    assert max(waits_s) > 1200


def test_start_returns_when_the_log_contains_the_text(shell: LocalShell) -> None:
    job_spec = replace(job("sh", "-c", "sleep 0.2; echo now listening on x >&2; sleep 60"), ready="log:listening on")
    jobs.start(shell, job_spec)
    assert "listening on" in (shell.home / FOLDER / "job.log").read_text(encoding="utf-8")
    assert stop(shell, job_spec, signal="TERM") == 128 + signal.SIGTERM


def test_start_has_no_output(shell: LocalShell) -> None:
    completed = shell.run(jobs.command("start", job("sh", "-c", "exit 0")), deadline=Deadline.after(30))
    assert (completed.stdout, completed.stderr) == (b"", b"")


@pytest.mark.parametrize("protocol", Protocol)
def test_start_returns_when_the_port_is_bound(shell: LocalShell, protocol: Protocol) -> None:
    port = free_port()
    udp = ("-u",) if protocol is Protocol.UDP else ()
    job_spec = replace(
        job("nc.traditional", *udp, "-l", "-p", str(port)), ready=jobs.ready_when_bound(protocol, port)
    )
    jobs.start(shell, job_spec)
    table = Path(f"/proc/net/{protocol}").read_text(encoding="ascii")
    assert f":{port:04X} " in table
    jobs.stop(shell, job_spec, signal="TERM")


def test_job_that_ends_before_it_is_ready_is_an_error_with_its_log(shell: LocalShell) -> None:
    job_spec = replace(job("sh", "-c", "echo no such device >&2; exit 1"), ready="log:listening on")
    with pytest.raises(RobotError, match="no such device"):
        jobs.start(shell, job_spec)


def test_sigint_reaches_a_detached_command(shell: LocalShell) -> None:
    # A program that a script starts with & would ignore SIGINT (field notes); rosbag needs it to close its bag.
    script = "trap 'echo closed; exit 5' INT; echo up; while :; do sleep 0.05; done"
    job_spec = replace(job("sh", "-c", script), ready="log:up")
    jobs.start(shell, job_spec)
    assert stop(shell, job_spec, signal="INT") == 5
    assert "closed" in (shell.home / FOLDER / "job.log").read_text(encoding="utf-8")


def test_job_that_ignores_its_signal_is_killed_with_its_children(shell: LocalShell) -> None:
    script = "trap '' INT TERM; sleep 300 & echo up; while :; do sleep 0.05; done"
    job_spec = replace(job("sh", "-c", script), ready="log:up")
    jobs.start(shell, job_spec)
    pid = leader(shell)
    assert jobs.stop(shell, job_spec, signal="INT", grace_s=1) == jobs.KILLED
    wait_until(lambda: has_group_exited(pid), Deadline.after(30))


def test_remaining_processes_of_a_command_are_terminated(shell: LocalShell) -> None:
    job_spec = job("sh", "-c", "sleep 300 & exit 0")
    assert jobs.run(shell, job_spec) == 0
    pid = leader(shell)
    wait_until(lambda: has_group_exited(pid), Deadline.after(30))


def test_robot_stops_a_job_at_its_limit(shell: LocalShell) -> None:
    script = "trap 'exit 9' INT; echo up; while :; do sleep 0.02; done"
    assert jobs.run(shell, replace(job("sh", "-c", script, limit_s=0.3), ready="log:up")) == 9


def test_limit_starts_when_the_job_is_ready(shell: LocalShell) -> None:
    # The file `go` is created after the time limit, which would stop the job if it started with the job.
    script = (
        "trap 'echo early; exit 1' INT; until [ -e go ]; do sleep 0.02; done; trap 'exit 9' INT; echo up; sleep 60"
    )
    pending = jobs.begin(shell, replace(job("sh", "-c", script, limit_s=0.1), ready="log:up"))
    other_job = job("true", name="other", limit_s=0.5)
    assert jobs.run(shell, replace(other_job, argv=("sleep", "60"))) == 128 + signal.SIGINT
    (shell.home / FOLDER / "go").touch()
    assert pending.end(30) == 9


def test_job_of_begin_reports_its_end_on_request_only(shell: LocalShell) -> None:
    pending = jobs.begin(shell, job("sh", "-c", "exit 3"))
    exit_file = shell.home / FOLDER / ".jobs" / "job" / "exit"
    wait_until(lambda: exit_file.exists() and exit_file.read_text(encoding="ascii") == "3\n", Deadline.after(30))
    assert isinstance(pending.session, LocalSession)
    with pytest.raises(subprocess.TimeoutExpired):
        pending.session.process.wait(0.2)
    assert pending.end(30) == 3


def test_wait_has_a_timeout(shell: LocalShell) -> None:
    job_spec = job("sleep", "60")
    jobs.start(shell, job_spec)
    assert jobs.begin_wait(shell, job_spec, 1).end(30) == jobs.STILL_RUNNING
    jobs.stop(shell, job_spec, signal="TERM")


def test_wait_returns_when_a_job_is_killed_externally(shell: LocalShell) -> None:
    job_spec = job("sleep", "60")
    jobs.start(shell, job_spec)
    killer = threading.Timer(0.2, lambda: os.killpg(leader(shell), signal.SIGKILL))
    killer.start()
    assert jobs.begin_wait(shell, job_spec, 20).end(30) == jobs.KILLED
    killer.join()


def test_stop_ignores_an_ended_job(shell: LocalShell) -> None:
    job_spec = job("true")
    assert jobs.run(shell, job_spec) == 0
    assert jobs.stop(shell, job_spec) == 0


def test_reused_pid_is_not_signalled(shell: LocalShell) -> None:
    """A job is identified by pid, start time and boot ID, never by its pid only."""
    job_spec = job("sleep", "60")
    jobs.start(shell, job_spec)
    with subprocess.Popen(("sleep", "60"), start_new_session=True) as other_process:
        record = shell.home / FOLDER / ".jobs" / "job" / "pid"
        true_record = record.read_text(encoding="ascii")
        _, ticks, boot = true_record.split()
        record.write_text(f"{other_process.pid} {int(ticks) - 1} {boot}\n", encoding="ascii")
        assert jobs.stop(shell, job_spec, signal="KILL") == jobs.KILLED
        assert other_process.poll() is None
        other_process.kill()
        record.write_text(true_record, encoding="ascii")
    jobs.stop(shell, job_spec, signal="TERM")


def test_repeated_run_joins_the_job_and_returns_its_exit_code(shell: LocalShell) -> None:
    job_spec = job("sh", "-c", "echo once >>out; sleep 0.3; exit 4")
    first, second = jobs.begin(shell, job_spec), jobs.begin(shell, job_spec)
    assert (first.end(30), second.end(30)) == (4, 4)
    assert jobs.run(shell, job_spec) == 4
    assert (shell.home / FOLDER / "out").read_text(encoding="ascii") == "once\n"


def test_repeated_start_waits_until_the_job_is_ready(shell: LocalShell) -> None:
    job_spec = replace(job("sh", "-c", "echo once >>out; sleep 0.3; echo up; sleep 60"), ready="log:up")
    with ThreadPoolExecutor(2) as pool:
        for start_call in [pool.submit(jobs.start, shell, job_spec) for _ in range(2)]:
            start_call.result()
            assert "up" in (shell.home / FOLDER / "job.log").read_text(encoding="ascii")
    assert (shell.home / FOLDER / "out").read_text(encoding="ascii") == "once\n"
    jobs.stop(shell, job_spec, signal="TERM")
    jobs.start(shell, job_spec)  # the log shows that the job was ready
    assert jobs.stop(shell, job_spec) == 128 + signal.SIGTERM


def test_repeated_start_reports_that_the_job_ended_before_it_was_ready(shell: LocalShell) -> None:
    job_spec = replace(job("sh", "-c", "echo no such device >&2; exit 1"), ready="log:listening on")
    for _ in range(2):
        with pytest.raises(RobotError, match="job job ended before it was ready: no such device"):
            jobs.start(shell, job_spec)


def test_job_that_is_not_ready_in_time_is_killed_and_its_log_reported(shell: LocalShell) -> None:
    ignoring_signals = job("sh", "-c", "trap '' INT TERM; echo still looking; while :; do sleep 0.05; done")
    job_spec = replace(ignoring_signals, ready="log:up", ready_s=3)
    with pytest.raises(RobotError, match="job job was not ready within 3 s: still looking") as error_info:
        jobs.start(shell, job_spec)
    assert FOLDER in error_info.value.remedy
    assert jobs.stop(shell, job_spec) == jobs.KILLED
    pid = leader(shell)
    wait_until(lambda: has_group_exited(pid), Deadline.after(30))


def test_serve_reports_readiness_and_exit_code(shell: LocalShell) -> None:
    wait_script = "echo up; until [ -e go ]; do sleep 0.05; done; exit 6"
    job_spec = replace(job("sh", "-c", f"echo once >>out; {wait_script}"), ready="log:up")
    first, second = jobs.serve(shell, job_spec), jobs.serve(shell, job_spec)
    assert "up" in (shell.home / FOLDER / "job.log").read_text(encoding="ascii")
    (shell.home / FOLDER / "go").touch()
    assert (first.end(30), second.end(30)) == (6, 6)
    assert (shell.home / FOLDER / "out").read_text(encoding="ascii") == "once\n"


def test_ended_listener_counts_as_ready_after_a_lost_link(shell: LocalShell) -> None:
    port = free_port()
    listen = 'nc.traditional -l -p "$0" & until [ -e go ]; do sleep 0.02; done; kill $!; exit 6'
    job_spec = replace(job("sh", "-c", listen, str(port)), ready=jobs.ready_when_bound(Protocol.TCP, port))
    first = jobs.serve(shell, job_spec)
    (shell.home / FOLDER / "go").touch()
    assert first.end(30) == 6
    assert jobs.serve(shell, job_spec).end(30) == 6, "although no process listens now"


def test_serve_reports_a_job_that_was_not_ready(shell: LocalShell) -> None:
    job_spec = replace(job("sh", "-c", "echo no such port >&2; exit 1"), ready="log:listening on")
    for _ in range(2):
        with pytest.raises(RobotError, match="job job ended before it was ready: no such port") as error_info:
            jobs.serve(shell, job_spec)
        assert FOLDER in error_info.value.remedy


PRINT_END_TEXT = "trap 'echo counted; sleep 0.3; echo gone; exit {code}' INT; echo up; while :; do sleep 0.05; done"


@pytest.mark.parametrize("code", [0, 3])
def test_job_may_run_after_its_end_text_until_the_evidence_is_fetched(
    shell: LocalShell, tmp_path: Path, code: int
) -> None:
    job_spec = replace(job("sh", "-c", PRINT_END_TEXT.format(code=code)), ready="log:up")
    into = tmp_path / "local"
    into.mkdir()
    jobs.start(shell, job_spec)
    for _ in range(2):  # the first answer may have been lost
        assert jobs.stop(shell, job_spec, grace_s=30, end_text="counted") == 0
    if code:
        with pytest.raises(RobotError, match="job job ended with exit code 3"):
            fetching.fetch(shell, FOLDER, "sender", "lo", into)
    else:
        fetching.fetch(shell, FOLDER, "sender", "lo", into)
        assert (into / "job.log").read_text(encoding="ascii").endswith("counted\ngone\n")
    assert jobs.list_running(shell, Deadline.after(30)) == ()


def test_job_that_does_not_end_after_its_end_text_is_killed(shell: LocalShell, tmp_path: Path) -> None:
    script = "trap 'echo counted; while :; do sleep 0.05; done' INT; echo up; while :; do sleep 0.05; done"
    job_spec = replace(job("sh", "-c", script), ready="log:up")
    jobs.start(shell, job_spec)
    assert jobs.stop(shell, job_spec, grace_s=30, end_text="counted") == 0
    with pytest.raises(RobotError, match=f"job job ended with exit code {jobs.KILLED}"):
        fetching.fetch(shell, FOLDER, "sender", "lo", tmp_path)
    assert jobs.list_running(shell, Deadline.after(30)) == ()


def test_job_that_ends_without_its_end_text_returns_its_exit_code(shell: LocalShell) -> None:
    job_spec = replace(job("sh", "-c", "trap 'exit 9' INT; echo up; while :; do sleep 0.05; done"), ready="log:up")
    jobs.start(shell, job_spec)
    assert jobs.stop(shell, job_spec, grace_s=30, end_text="counted") == 9


def test_job_that_a_reboot_interrupted_is_reported(shell: LocalShell) -> None:
    job_spec = job("sleep", "60")
    jobs.start(shell, job_spec)
    os.killpg(leader(shell), signal.SIGKILL)
    record = shell.home / FOLDER / ".jobs" / "job" / "pid"
    record.write_text(" ".join([*record.read_text(encoding="ascii").split()[:2], "another-boot"]), encoding="ascii")
    calls: list[Callable[[], int]] = [
        lambda: jobs.stop(shell, job_spec),
        lambda: jobs.run(shell, job_spec),
        lambda: jobs.begin_wait(shell, job_spec, 5).end(30),
    ]
    for call in calls:
        with pytest.raises(RobotError, match="job job was interrupted: the robot rebooted"):
            call()
    assert jobs.list_running(shell, Deadline.after(30)) == ()


def test_no_job_starts_in_a_folder_whose_jobs_were_stopped(shell: LocalShell) -> None:
    evidence.end_jobs(shell, FOLDER)
    with pytest.raises(RobotError, match="cannot start: the jobs of"):
        jobs.run(shell, job("true"))


def wrap_with_pause(shell: LocalShell, name: str) -> tuple[Path, Path]:
    """Replace the robot's program `name` by one that creates a file when it is called, and waits for another file."""
    called_file, go_file = shell.home / "called", shell.home / "go"
    replace_program(
        shell, name, f'touch "{called_file}"; until [ -e "{go_file}" ]; do sleep 0.01; done; exec {{program}} "$@"'
    )
    return called_file, go_file


@pytest.mark.parametrize("call", [jobs.start, jobs.run])
def test_job_that_starts_during_an_abort_does_not_run(
    shell: LocalShell, call: Callable[[LocalShell, Job], object]
) -> None:
    called_file, go_file = wrap_with_pause(
        shell, "mkfifo"
    )  # called after the folder of the job is created, and before its identity is written
    job_spec = job("sh", "-c", "touch started; exec sleep 60")
    with ThreadPoolExecutor(1) as pool:
        starting = pool.submit(call, shell, job_spec)
        wait_until(called_file.exists, Deadline.after(30))
        assert jobs.abort(shell, "bert@two", Deadline.after(30)).jobs == ()
        go_file.touch()
        with pytest.raises(RobotError, match=f"cannot start: the jobs of {FOLDER} were stopped by bert@two"):
            starting.result(30)
    # `start` returns as soon as the leader has an identity; the leader may then still be about to exit.
    wait_until(lambda: jobs.list_running(shell, Deadline.after(30)) == (), Deadline.after(30))
    assert not (shell.home / FOLDER / "started").exists()


def test_wait_for_a_lost_caller_has_a_timeout(shell: LocalShell) -> None:
    """The link was cut while the job ran: the SSH server has not detected it, and keeps standard input open."""
    query_log = shell.home / "queries"
    replace_program(shell, "timeout", f'echo "$1" >>"{query_log}"; shift; exec {{program}} 1 "$@"')
    pending = jobs.begin(shell, job("sh", "-c", "exit 3", limit_s=20))
    assert isinstance(pending.session, LocalSession)
    assert pending.session.process.wait(30) == 3
    (seconds,) = query_log.read_text(encoding="ascii").split()
    assert 20 < int(seconds) <= 20 + jobs.READY_S + 10


def test_process_whose_folder_was_deleted_is_listed_and_stopped(shell: LocalShell) -> None:
    pending = jobs.begin(shell, job("sh", "-c", "touch up; exec sleep 60"))
    assert isinstance(pending.session, LocalSession)
    wait_until((shell.home / FOLDER / "up").exists, Deadline.after(30))
    pid = leader(shell)
    shutil.rmtree(shell.home / FOLDER)
    assert any(line.startswith(f"{FOLDER} {pid} ") for line in jobs.list_running(shell, Deadline.after(30)))
    jobs_ended = jobs.abort(shell, "anna@one", Deadline.after(30)).jobs
    assert any(line.startswith(FOLDER) and line.endswith("sleep 60") for line in jobs_ended)
    assert pending.session.process.wait(30) == -signal.SIGKILL
    wait_until(lambda: has_group_exited(pid), Deadline.after(30))


@pytest.mark.parametrize("lost_record", ["the identity", "the folder"])
def test_records_lost_in_a_power_failure_are_reported(shell: LocalShell, lost_record: str) -> None:
    job_spec = job("true")
    jobs.run(shell, job_spec)
    began_file = shell.home / FOLDER / ".began"
    token, _ = began_file.read_text(encoding="ascii").split()
    began_file.write_text(f"{token} another-boot\n", encoding="ascii")
    shutil.rmtree(shell.home / FOLDER / ".jobs" / "job")
    if lost_record == "the identity":
        (shell.home / FOLDER / ".jobs" / "job").mkdir()
    calls: list[Callable[[], int]] = [
        lambda: jobs.stop(shell, job_spec),
        lambda: jobs.begin_wait(shell, job_spec, 5).end(30),
    ]
    for call in calls:
        with pytest.raises(RobotError, match="job job was interrupted: the robot rebooted"):
            call()


def test_files_of_root_can_be_deleted_by_the_user(shell: LocalShell) -> None:
    for path in (shell.home, *shell.home.rglob("*")):
        os.chown(path, 65534, 65534, follow_symlinks=False)
    jobs.run(shell, job("true"))
    assert (shell.home / FOLDER / ".jobs" / "job").stat().st_uid == 65534
    user_command = ("setpriv", "--reuid=65534", "--regid=65534", "--clear-groups")
    subprocess.run((*user_command, "rm", "-r", "udp-01-1"), cwd=(shell.home / FOLDER).parent, check=True)


def test_exit_code_of_a_job_is_not_mistaken_for_an_exit_code_of_the_script(shell: LocalShell) -> None:
    for code in (28, 75, 76, 124, 125):
        assert jobs.run(shell, job("sh", "-c", f"echo job.sh: lies >&2; exit {code}", name=f"exit-{code}")) == code


def test_repeated_begin_keeps_the_first_state_and_running_jobs(shell: LocalShell) -> None:
    before = shell.home / FOLDER / "sender-before.txt"
    first = before.read_bytes()
    jobs.start(shell, job("sleep", "60"))
    evidence.begin(shell, FOLDER, "sender", "lo")
    assert before.read_bytes() == first
    assert jobs.begin_wait(shell, job("sleep", "60"), 1).end(30) == jobs.STILL_RUNNING
    jobs.stop(shell, job("sleep", "60"), signal="TERM")


def test_begin_rejects_a_disk_with_less_space_than_needed(shell: LocalShell) -> None:
    with pytest.raises(RobotError, match=r"\d+ KiB of disk are free, 10{15} KiB are needed") as error_info:
        evidence.begin(shell, jobs.work_folder("trial", "udp-02-1"), "sender", "lo", required_kib=10**15)
    assert "du -sh ~/.fieldkit/*" in error_info.value.remedy
    assert not (shell.home / jobs.work_folder("trial", "udp-02-1")).exists()


def test_missing_program_is_reported_at_the_installation(tmp_path: Path) -> None:
    folder = tmp_path / "bin"
    path = userland_path("busybox", folder)
    (folder / "setsid").unlink()
    shell = LocalShell(tmp_path, str(folder))
    with pytest.raises(RobotError, match="it lacks setsid") as error_info:
        jobs.install(shell, Deadline.after(30))
    assert "apt-get install util-linux" in error_info.value.remedy
    assert path


def test_unknown_job_is_an_error(shell: LocalShell) -> None:
    with pytest.raises(RobotError, match="no job in"):
        jobs.stop(shell, job("true", name="never"))


def test_remaining_jobs_are_listed_and_stopped(shell: LocalShell) -> None:
    jobs.start(shell, job("sleep", "60"))
    (line,) = jobs.list_running(shell, Deadline.after(30))
    assert line.endswith("sleep 60")
    evidence.end_jobs(shell, FOLDER)
    assert jobs.list_running(shell, Deadline.after(30)) == ()


def test_stop_waits_until_a_file_has_stopped_growing(shell: LocalShell) -> None:
    # The file grows whenever the script sleeps between two checks, so that the load of this machine has no effect.
    append_lines = 'case $1 in 0.02) [ "$(wc -l <out)" -ge 20 ] || echo >>out ;; esac'
    replace_program(shell, "sleep", f'cd "{shell.home / FOLDER}" && {append_lines}\nexec {{program}} "$@"')
    script = "trap 'wc -l <out >seen; exit 0' TERM; : >out; echo up; while :; do sleep 0.05; done"
    job_spec = replace(job("sh", "-c", script), ready="log:up")
    jobs.start(shell, job_spec)
    assert stop(shell, job_spec, signal="TERM", settle="out") == 0
    assert (shell.home / FOLDER / "seen").read_text(encoding="ascii").split() == ["20"]


@pytest.mark.parametrize(
    ("state", "is_running"), [("R", True), ("S", True), ("D", True), ("T", True), ("Z", False), ("X", False)]
)
def test_zombie_and_dead_process_do_not_count_as_running(
    shell: LocalShell, tmp_path: Path, state: str, is_running: bool
) -> None:
    """The state of a process is Z until its parent waits for it, and X briefly afterwards."""
    (tmp_path / "stat").write_text(f"7 (a) b) {state} {' '.join(map(str, range(4, 53)))}\n", encoding="ascii")
    common_script = Path(script.__file__).with_name("common.sh")
    argv = ("sh", "-c", '. "$1"; identify "../$2"; echo $? "$identity"', "sh", str(common_script), str(tmp_path))
    code, *identity = shell.run(argv, deadline=Deadline.after(30)).stdout.split()
    assert (code == b"0", len(identity)) == ((True, 3) if is_running else (False, 0))


def test_folder_is_fetched_completely_with_the_host_state_before_and_after(shell: LocalShell, tmp_path: Path) -> None:
    jobs.run(shell, replace(job("printf", "abc"), stdout="scan.bag"))
    into = tmp_path / "local"
    into.mkdir()
    fetching.fetch(shell, FOLDER, "sender", "lo", into)
    expected = {"job.log", "scan.bag", "sender-after.txt", "sender-before.txt", *SNAPSHOTS, *LINK_FILES}
    assert {path.name for path in into.iterdir()} == expected
    assert (into / "scan.bag").read_bytes() == b"abc"
    assert "==> /proc/net/snmp <==\n" in (into / "sender-before.txt").read_text(encoding="utf-8")


def test_end_of_each_job_is_recorded_with_boot_id_and_clock(shell: LocalShell, tmp_path: Path) -> None:
    waiting = ("sh", "-c", "trap 'exit 0' INT; echo up; while :; do sleep 0.02; done")
    stopped, broken, lost_record, slow = (
        replace(job(*waiting, name=name), ready="log:up") for name in ("stopped", "broken", "lost", "slow")
    )
    for job_spec in (stopped, broken, lost_record):
        jobs.start(shell, job_spec)
    assert jobs.run(shell, job("sh", "-c", "sleep 0.3; exit 3")) == 3
    assert jobs.run(shell, replace(slow, limit_s=0.1)) == 0
    os.killpg(leader(shell, "broken"), signal.SIGINT)
    assert jobs.begin_wait(shell, broken, 20).end(30) == 0
    os.killpg(leader(shell, "lost"), signal.SIGKILL)
    assert jobs.begin_wait(shell, lost_record, 20).end(30) == jobs.KILLED
    for job_spec in (stopped, broken):
        assert stop(shell, job_spec) == 0, "the exit code is the same as without a stop"
    into = tmp_path / "local"
    into.mkdir()
    fetching.fetch(shell, FOLDER, "sender", "lo", into)
    before, after = (host.read_state(into / f"sender-{moment}.txt") for moment in ("before", "after"))
    assert after.terminations is not None
    assert before.terminations is None
    terminations = {
        name: (termination.cause, termination.code)
        for name, termination in after.terminations.items()
        if name != LINK_JOB
    }
    assert terminations == {
        "stopped": (Cause.STOPPED, 0),
        "broken": (Cause.EXITED, 0),
        "lost": (Cause.EXITED, None),
        "job": (Cause.EXITED, 3),
        "slow": (Cause.LIMIT, 0),
    }
    duration_s = after.terminations["job"].duration_s
    assert duration_s is not None
    assert duration_s >= 0.28
    assert before.boot == after.boot == evidence.boot_id(shell) == evidence.begin(shell, FOLDER, "sender", "lo")
    assert before.clock is not None
    assert after.clock is not None
    assert clock.step_description(before.clock, after.clock) is None
    assert clock.clock_step(before.clock, after.clock).error_s < 1, "busybox also reports fractions of a second"


def test_state_of_the_radio_is_recorded_before_and_after(shell: LocalShell, tmp_path: Path) -> None:
    into = tmp_path / "local"
    into.mkdir()
    # This machine has no radio, so the outputs are from a real robot.
    answers = {"info": "info-station", "station": "stations-ap", "get": "power-save-on"}
    files = {verb: shlex.quote(str(DATA / "iw" / f"{name}.txt")) for verb, name in answers.items()}
    cases = "\n".join(f"{verb}) exec cat {file} ;;" for verb, file in files.items())
    iw = tmp_path / "bin" / "iw"
    iw.write_text(f"#!/bin/sh\ncase $3 in\n{cases}\nesac\n", encoding="utf-8")
    iw.chmod(0o755)
    evidence.begin(shell, f"{FOLDER}-2", "sender", "wlan0")
    fetching.fetch(shell, f"{FOLDER}-2", "sender", "wlan0", into)
    for moment in ("before", "after"):
        state = (into / f"sender-{moment}.txt").read_text(encoding="utf-8")
        assert "==> iw power save <==\nPower save: on\n" in state
        assert re.search(r"==> iw info <==\n[^=]*channel \d+", state)
        assert re.search(r"==> iw station dump <==\n[^=]*tx retries:.*\n[^=]*signal:", state)


def test_regular_files_in_one_level_of_folders_are_fetched(shell: LocalShell, tmp_path: Path) -> None:
    script = """mkdir -p scan/deeper; echo a >scan/metadata.yaml; echo b >scan/scan_0.db3; echo c >scan/deeper/file
    ln -s /etc/passwd link; ln -s /etc/passwd scan/link; mkfifo fifo; echo d >.hidden"""
    assert jobs.run(shell, job("sh", "-c", script)) == 0
    into = tmp_path / "local"
    into.mkdir()
    for _ in range(2):  # the first answer may have been lost
        shutil.rmtree(into)
        into.mkdir()
        fetching.fetch(shell, FOLDER, "sender", "lo", into)
        assert {str(path.relative_to(into)) for path in into.rglob("*") if path.is_file()} == {
            "job.log",
            "scan/metadata.yaml",
            "scan/scan_0.db3",
            "sender-after.txt",
            "sender-before.txt",
            *SNAPSHOTS,
            *LINK_FILES,
        }
    assert (into / "scan" / "scan_0.db3").read_text(encoding="ascii") == "b\n"


def test_jobs_run_in_a_userland_without_fractions_of_seconds(tmp_path: Path) -> None:
    """As in old and small versions of busybox, sleep accepts no fractions, and timeout has another syntax."""
    shell = LocalShell(tmp_path, userland_path("busybox", tmp_path / "bin"))
    restrictions = {
        "sleep": "case $1 in *.*) exit 1 ;; esac",
        "timeout": "case $1 in -t) shift ;; *) exit 127 ;; esac",
    }
    for name, restriction in restrictions.items():
        replace_program(shell, name, f'{restriction}\nexec {{program}} "$@"')
    jobs.install(shell, Deadline.after(30))
    evidence.begin(shell, FOLDER, "sender", "lo")
    job_spec = replace(job("sh", "-c", "echo up; exec sleep 60"), ready="log:up")
    jobs.start(shell, job_spec)
    assert jobs.begin_wait(shell, job_spec, 1).end(30) == jobs.STILL_RUNNING
    assert stop(shell, job_spec, signal="TERM") == 128 + signal.SIGTERM
    script = "trap 'exit 9' INT; echo up; while :; do sleep 1; done"
    assert jobs.run(shell, replace(job("sh", "-c", script, name="x", limit_s=0.3), ready="log:up")) == 9
    assert jobs.list_running(shell, Deadline.after(30)) == ()


def test_job_of_another_version_of_the_script_is_listed_and_stopped(shell: LocalShell) -> None:
    meta = shell.home / jobs.work_folder("older", "tcp-01-1") / ".jobs" / "capture"
    meta.mkdir(parents=True)
    (meta / "command").write_text("tcpdump -i wlan0\n", encoding="ascii")
    with subprocess.Popen(("sleep", "60"), start_new_session=True) as process:
        ticks = Path(f"/proc/{process.pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()[19]
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        (meta / "pid").write_text(f"{process.pid} {ticks} {boot}\n", encoding="ascii")
        line = f".fieldkit/older/tcp-01-1/capture {process.pid} tcpdump -i wlan0"
        assert jobs.list_running(shell, Deadline.after(30)) == (line,)
        assert jobs.abort(shell, "anna@one", Deadline.after(30)).jobs == (line,)
        assert process.wait(30) == -signal.SIGINT


def test_all_files_of_a_trial_on_a_robot_are_deleted(shell: LocalShell) -> None:
    jobs.run(shell, replace(job("echo", "sent"), stdout="recv.bag"))
    assert (shell.home / FOLDER / "recv.bag").is_file()
    evidence.discard(shell, "trial")
    assert [path.name for path in (shell.home / jobs.HOME).iterdir()] == [Path(jobs.SCRIPT_PATH).name]


class HostileShell(LocalShell):
    """A robot that sends any archive."""

    def __init__(self, home: Path, members: dict[str, bytes], *, link: str = "") -> None:
        super().__init__(home)
        self.archive = home / "lie.tar"
        with tarfile.open(self.archive, "w", format=tarfile.GNU_FORMAT) as tar:
            for name, content in members.items():
                path = home / "member"
                path.write_bytes(content)
                tar.add(path, arcname=name)
            if link:
                (home / "link").symlink_to("/etc/passwd")
                tar.add(home / "link", arcname=link)

    def fetch(self, argv: Sequence[str], to: Path, *, deadline: Deadline, limit_bytes: int) -> Completed:
        to.write_bytes(self.archive.read_bytes())
        return Completed(tuple(argv), 0, b"", b"")


EMPTY_SUM = "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"


@pytest.mark.parametrize(
    ("members", "link", "message"),
    [
        ({"../evil": b""}, "", "not a regular file"),
        ({"//etc/evil": b""}, "", "hash differs or file missing: etc/evil"),
        ({".hidden": b""}, "", "not a regular file"),
        ({"a\nb": b""}, "", "not a regular file"),
        ({"a/b/c": b""}, "", "not a regular file"),
        ({"a/../b": b""}, "", "not a regular file"),
        ({"a/.b": b""}, "", "not a regular file"),
        ({"a": b"", "a/b": b""}, "", "sent before"),
        ({}, "scan.bag", "not a regular file"),
        ({"scan.bag": b""}, "", "hash differs"),
        ({"scan.bag": b"x", ".sums-1": f"{EMPTY_SUM}  scan.bag\n".encode()}, "", "hash differs"),
        ({".sums-1": f"{EMPTY_SUM}  scan.bag\n".encode()}, "", "hash differs or file missing: scan.bag"),
        ({}, "", "file missing"),
    ],
)
def test_archive_cannot_leave_the_folder_or_skip_checks(
    tmp_path: Path, members: dict[str, bytes], link: str, message: str
) -> None:
    home, into = tmp_path / "home", tmp_path / "into"
    home.mkdir()
    into.mkdir()
    with pytest.raises(EvidenceError, match=message):
        fetching.fetch(HostileShell(home, members, link=link), FOLDER, "sender", "lo", into)
    assert {path.name for path in tmp_path.iterdir()} == {"home", "into"}
    assert not list(into.glob(".*"))


def test_truncated_archive_is_rejected(tmp_path: Path) -> None:
    hostile = HostileShell(tmp_path, {"scan.bag": b"x" * 5000})
    hostile.archive.write_bytes(hostile.archive.read_bytes()[:2000])
    with pytest.raises(EvidenceError):
        fetching.fetch(hostile, FOLDER, "sender", "lo", tmp_path)


def test_other_users_cannot_write_to_the_folder_of_the_script(shell: LocalShell) -> None:
    folder = shell.home / jobs.HOME
    folder.chmod(0o777)
    jobs.install(shell, Deadline.after(30))
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700


@pytest.mark.parametrize("damage", ["another's", "cut", "a link"])
def test_script_with_other_owner_or_content_is_replaced(shell: LocalShell, damage: str) -> None:
    path = shell.home / jobs.SCRIPT_PATH
    match damage:
        case "another's":
            os.chown(path, 65534, 65534)
        case "cut":
            path.write_bytes(script.SCRIPT[:-100])
        case _:
            path.rename(path.with_suffix(".moved"))
            path.symlink_to(path.with_suffix(".moved").name)
    jobs.install(shell, Deadline.after(30))
    assert path.read_bytes() == script.SCRIPT
    assert path.stat().st_uid == os.geteuid()
    assert not path.is_symlink()


class GreetingRobot(LocalShell):
    """A robot whose `.bashrc` prints a text before each command."""

    def begin(self, argv: Sequence[str], *, deadline: Deadline, until: bytes | None = None) -> LocalSession:
        return super().begin(
            ("sh", "-c", 'echo "ROS noetic"; exec "$@"', "sh", *argv), deadline=deadline, until=until
        )


def test_login_shell_with_a_greeting_is_reported(tmp_path: Path) -> None:
    with pytest.raises(RobotError, match="its login shell answers every command with 'ROS noetic'") as error_info:
        jobs.install(GreetingRobot(tmp_path), Deadline.after(30))
    assert "case $- in" in error_info.value.remedy


def test_read_only_robot_is_reported_and_can_be_aborted(shell: LocalShell) -> None:
    jobs.start(shell, job("sleep", "60"))
    script_file = shell.home / jobs.SCRIPT_PATH
    script_file.unlink()
    mount_command = ("/bin/mount", "--bind", "-o", "ro", str(shell.home), str(shell.home))
    namespace_command = ("unshare", "--mount", "--propagation", "private", "sh", "-c", 'exec "$@"', "sh")

    class ReadOnly(LocalShell):
        def begin(self, argv: Sequence[str], *, deadline: Deadline, until: bytes | None = None) -> LocalSession:
            command = ("sh", "-c", f'{shlex.join(mount_command)} && cd "$HOME" && exec "$@"', "sh")
            return super().begin((*namespace_command, *command, *argv), deadline=deadline, until=until)

    robot = ReadOnly(shell.home, shell.path)
    with pytest.raises(RobotError, match="Read-only file system") as error_info:
        jobs.install(robot, Deadline.after(30))
    assert "touch ~/.fieldkit/x" in error_info.value.remedy
    jobs.install(shell, Deadline.after(30))
    with pytest.raises(RobotError, match="Read-only file system") as error_info:
        evidence.begin(robot, f"{FOLDER}-2", "sender", "lo", required_kib=0)
    assert "a failing SD card" in error_info.value.remedy
    (job_ended,) = jobs.abort(robot, "anna@one", Deadline.after(30)).jobs
    assert job_ended.endswith("sleep 60")
    jobs.install(shell, Deadline.after(30))


def test_installed_script_is_not_sent_again(shell: LocalShell) -> None:
    before = (shell.home / jobs.SCRIPT_PATH).stat().st_ino
    jobs.install(shell, Deadline.after(30))
    assert (shell.home / jobs.SCRIPT_PATH).stat().st_ino == before


def test_script_is_installed_under_the_hash_of_its_content(shell: LocalShell) -> None:
    before = time.time_ns()
    jobs.install(shell, Deadline.after(30))
    path = shell.home / jobs.SCRIPT_PATH
    assert path.read_bytes() == script.SCRIPT
    assert path.stat().st_mtime_ns >= before - 60 * 10**9
