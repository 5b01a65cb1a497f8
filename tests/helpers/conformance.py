"""Tests of the requirements of fieldkit on shells and testbeds: derive a class, add the fixtures, and run pytest.

The backends of other packages are tested in the same way as fieldkit's backends; see `test_conformance.py`.
"""

import hashlib
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

from fieldkit.backends.protocols import Cast, Testbed
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import LinkError, RobotError
from fieldkit.core.model import Placement, Protocol, Role, Scenario, Topology
from fieldkit.core.units import parse_distance
from fieldkit.remote import evidence, fetching, jobs
from fieldkit.remote.jobs import Job
from fieldkit.remote.shell import Shell
from tests.helpers.sshd import wait_until

SOON_S = 60.0
# Larger than all transport windows; the window of paramiko has 2 MiB.
LARGE_BYTES = 3_000_000
LARGE_FILE_BYTES = fetching.PIECE_BYTES + 100
"""Size of an evidence file that must be fetched in two pieces."""

GAP_S = 3.0
"""Duration of a short outage of the link."""
NOTICED_S = 40.0
"""Time limit for a wait on a dead link, also on a busy machine; on an idle machine it takes at most 10 s.

See tests/remote/test_remote_dead_link.py.
"""


@dataclass(frozen=True)
class Subject:
    """A Shell under test.

    Attributes:
        shell: The Shell.
        cut: Cuts the link to the robot without a reset, so that no packet arrives from the robot.
        restore: Restores the link.
        give_up_s: Time limit for restoring a lost link, including the last attempt; short, to save time.
    """

    shell: Shell
    cut: Callable[[], None]
    restore: Callable[[], None]
    give_up_s: float

    @contextmanager
    def dead_link(self) -> Iterator[None]:
        """Cut the link for the duration of the context."""
        self.cut()
        try:
            yield
        finally:
            self.restore()


def deadline_soon() -> Deadline:
    return Deadline.after(SOON_S)


def output_of(shell: Shell, *argv: str) -> str:
    return shell.run(argv, deadline=deadline_soon()).stdout.decode()


@contextmanager
def endless_command(shell: Shell, *, first: str = ":") -> Iterator[tuple[str, ...]]:
    """Yield a command that does `first` and then sleeps for a long time; it is killed at the end of the context.

    Not all SSH servers kill the commands of a disconnected client: OpenSSH does not.
    """
    try:
        yield ("sh", "-c", f"{first}; echo $$ >endless; exec sleep 600")
    finally:
        output_of(shell, "sh", "-c", "kill $(cat endless) 2>/dev/null; rm -f endless")


@contextmanager
def waiting_thread(shell: Shell) -> Iterator[Callable[[float], BaseException | None]]:
    """Wait in a thread for an endless command while neither side sends data.

    Yields a function that waits up to a number of seconds for the thread, and returns its error.
    """
    with endless_command(shell, first="cat") as argv, ThreadPoolExecutor(1) as pool:
        session = shell.begin(argv, deadline=deadline_soon())
        session_end = pool.submit(session.end, deadline=Deadline.after(2 * SOON_S))
        output_of(shell, "sh", "-c", "until [ -s endless ]; do sleep 0.05; done")
        yield session_end.exception


def is_responsive(shell: Shell) -> bool:
    try:
        return output_of(shell, "echo", "back") == "back\n"
    except LinkError:
        return False


class ShellConformance:
    """Requirements on a Shell; needs a fixture `subject` with a `Subject`, of class scope to save time."""

    @pytest.mark.parametrize("code", [0, 1, 3, 124, 255])
    def test_both_streams_and_the_exit_code_arrive(self, subject: Subject, code: int) -> None:
        argv = ("sh", "-c", f"echo out; echo err >&2; exit {code}")
        completed = subject.shell.run(argv, deadline=deadline_soon(), check=False)
        assert (completed.argv, completed.exit_code, completed.stdout, completed.stderr) == (
            argv,
            code,
            b"out\n",
            b"err\n",
        )

    def test_a_failed_command_raises_a_robot_error_with_its_output(self, subject: Subject) -> None:
        with pytest.raises(RobotError, match=r"exit code 3.*no bag today"):
            subject.shell.run(("sh", "-c", "echo no bag today >&2; exit 3"), deadline=deadline_soon())

    def test_a_missing_command_has_exit_code_127(self, subject: Subject) -> None:
        completed = subject.shell.run(("no-such-program",), deadline=deadline_soon(), check=False)
        assert completed.exit_code == 127
        assert b"no-such-program" in completed.stderr

    def test_arguments_arrive_unchanged(self, subject: Subject) -> None:
        arguments = ["", " ", "a b", "'", '"', "$HOME", "`id`", "\\", "*", "~", "a\nb", "-n", ";", "größe", "机器人"]
        assert output_of(subject.shell, "printf", "%s\\0", *arguments).split("\0")[:-1] == arguments

    def test_both_streams_may_be_large(self, subject: Subject) -> None:
        script = f"head -c {LARGE_BYTES} /dev/zero >&2 & head -c {LARGE_BYTES} /dev/zero; wait; echo end >&2"
        completed = subject.shell.run(("sh", "-c", script), deadline=deadline_soon())
        assert completed.stdout == bytes(LARGE_BYTES)
        assert completed.stderr.endswith(b"\0end\n")

    def test_standard_input_may_be_large(self, subject: Subject) -> None:
        data = bytes(range(256)) * (LARGE_BYTES // 256)
        completed = subject.shell.run(("sha256sum",), stdin=data, deadline=deadline_soon())
        assert completed.stdout.split()[0].decode() == hashlib.sha256(data).hexdigest()

    def test_the_input_of_a_session_is_closed_when_its_end_is_awaited(self, subject: Subject) -> None:
        session = subject.shell.begin(("cat",), deadline=deadline_soon())
        assert output_of(subject.shell, "echo", "meanwhile") == "meanwhile\n"
        assert session.end(deadline=deadline_soon()).exit_code == 0

    def test_expected_silence_does_not_affect_a_working_link(self, subject: Subject) -> None:
        with subject.shell.silence(SOON_S):
            assert output_of(subject.shell, "echo", "here") == "here\n"
        assert output_of(subject.shell, "echo", "again") == "again\n"

    def test_commands_run_concurrently(self, subject: Subject) -> None:
        with ThreadPoolExecutor(8) as pool:
            texts = [f"{number}\n" for number in range(8)]
            assert list(pool.map(lambda text: output_of(subject.shell, "printf", text), texts)) == texts

    def test_a_file_is_fetched_completely(self, subject: Subject, tmp_path: Path) -> None:
        script = f'head -c {LARGE_BYTES} /dev/urandom >"$HOME/large" && sha256sum "$HOME/large"'
        digest = output_of(subject.shell, "sh", "-c", script).split()[0]
        argv = ("sh", "-c", 'cat "$HOME/large" && rm "$HOME/large"')
        subject.shell.fetch(argv, tmp_path / "large", deadline=deadline_soon(), limit_bytes=LARGE_BYTES)
        assert hashlib.sha256((tmp_path / "large").read_bytes()).hexdigest() == digest

    def test_output_beyond_the_limit_raises_a_robot_error(self, subject: Subject, tmp_path: Path) -> None:
        with pytest.raises(RobotError, match="more than 1000 bytes"):
            subject.shell.fetch(
                ("cat", "/dev/zero"), tmp_path / "endless", deadline=deadline_soon(), limit_bytes=1000
            )
        assert output_of(subject.shell, "echo", "on") == "on\n"

    def test_an_endless_command_raises_a_link_error_at_the_deadline(self, subject: Subject) -> None:
        with endless_command(subject.shell) as argv:
            started_s = time.monotonic()
            with pytest.raises(LinkError):
                subject.shell.run(argv, deadline=Deadline.after(1.0))
            assert 1.0 <= time.monotonic() - started_s < 1.0 + NOTICED_S
        assert output_of(subject.shell, "echo", "on") == "on\n"

    def test_a_killed_command_raises_a_robot_error(self, subject: Subject) -> None:
        with pytest.raises(RobotError):
            subject.shell.run(("sh", "-c", "kill -KILL $$"), deadline=deadline_soon())
        assert output_of(subject.shell, "echo", "on") == "on\n"

    def test_close_ends_the_wait_of_another_thread(self, subject: Subject) -> None:
        with waiting_thread(subject.shell) as error:
            subject.shell.close()
            assert isinstance(error(NOTICED_S), LinkError)
        assert output_of(subject.shell, "echo", "made again") == "made again\n"

    def test_a_detached_job_outlives_the_connection_and_is_collected(self, subject: Subject, tmp_path: Path) -> None:
        shell, folder = subject.shell, jobs.work_folder("conformance", "job-1")
        jobs.install(shell, deadline_soon())
        evidence.begin(shell, folder, "sender", "lo")
        script = f"head -c {LARGE_FILE_BYTES} /dev/urandom >large.bag; sleep 1; echo done"
        job = Job(folder, "slow", ("sh", "-c", script), limit_s=60.0, log="slow.log")
        jobs.start(shell, job)
        shell.close()
        assert jobs.begin_wait(shell, job, 20).end(SOON_S) == 0
        fetching.fetch(shell, folder, "sender", "lo", tmp_path)
        evidence.discard(shell, "conformance")
        assert (tmp_path / "slow.log").read_text(encoding="ascii") == "done\n"
        assert (tmp_path / "large.bag").stat().st_size == LARGE_FILE_BYTES

    def test_a_session_survives_a_short_link_outage(self, subject: Subject) -> None:
        session = subject.shell.begin(("sh", "-c", "sleep 1; echo done"), deadline=deadline_soon())
        subject.cut()
        timer = threading.Timer(GAP_S, subject.restore)
        timer.start()
        try:
            assert session.end(deadline=deadline_soon()).stdout == b"done\n"
        finally:
            timer.join()

    def test_a_waiting_thread_detects_a_dead_link(self, subject: Subject) -> None:
        with waiting_thread(subject.shell) as error, subject.dead_link():
            assert isinstance(error(NOTICED_S + subject.give_up_s), LinkError)
        # The Shell gives up early to save time; on a busy machine, a new connection may take longer.
        wait_until(lambda: is_responsive(subject.shell), deadline_soon())


class RebootConformance:
    """Requirements on a robot that can be rebooted; needs fixtures `subject` and `reboot`.

    `reboot` is a function that cuts the robot's power and returns when it has power again.
    """

    def test_a_robot_is_reachable_after_a_reboot(self, subject: Subject, reboot: Callable[[], object]) -> None:
        boot = output_of(subject.shell, "cat", "/proc/sys/kernel/random/boot_id")
        reboot()
        assert output_of(subject.shell, "cat", "/proc/sys/kernel/random/boot_id") != boot


class BackendConformance:
    """Requirements on the testbed of a backend; needs fixtures `testbed`, `cast` and `topology`."""

    def test_each_robot_of_the_cast_has_a_shell_with_its_name(self, testbed: Testbed, cast: Cast) -> None:
        assert {role: shell.robot for role, shell in testbed.shells.items()} == {
            role: robot.name for role, robot in cast.items()
        }

    def test_each_address_is_on_the_radio_interface_and_routes_use_it(self, testbed: Testbed, cast: Cast) -> None:
        for role, robot in cast.items():
            interface = robot.profile.radio.interface
            assert f" {robot.address}/" in output_of(
                testbed.shells[role], "ip", "-4", "addr", "show", "dev", interface
            )
            for other in cast.values():
                if other is not robot:
                    route = output_of(testbed.shells[role], "ip", "route", "get", other.address)
                    assert f"dev {interface}" in route

    def test_placed_robots_reach_each_other(self, testbed: Testbed, cast: Cast, topology: Topology) -> None:
        for distance in ("10m", "5m"):
            testbed.place(Placement(Scenario.LOS, topology, parse_distance(distance)))
            output_of(testbed.shells[Role.SENDER], "ping", "-c", "5", "-i", "0.2", cast[Role.RECEIVER].address)

    def test_the_oracle_of_a_testbed_is_constant(self, testbed: Testbed) -> None:
        assert testbed.oracle is testbed.oracle

    def test_the_oracle_reports_the_lateness_of_each_packet(self, testbed: Testbed, cast: Cast) -> None:
        if testbed.oracle is None:
            return  # a testbed with a real radio has no oracle
        before = testbed.oracle.lateness()
        output_of(testbed.shells[Role.SENDER], "ping", "-c", "5", "-i", "0.2", cast[Role.RECEIVER].address)
        after = testbed.oracle.lateness()
        assert sum(after.packets.values()) - sum(before.packets.values()) >= 10
        assert before.bound_ns == after.bound_ns > 0

    def test_the_oracle_reports_the_delays_of_arrived_packets(self, testbed: Testbed, cast: Cast) -> None:
        if (oracle := testbed.oracle) is None:
            return
        flow, other_flow = ((Role.SENDER, Role.RECEIVER, Protocol.UDP, port) for port in (9, 99))
        before = oracle.delays(*flow)
        assert oracle.delays(*other_flow).packets == 0, "the first query of a flow"
        script = "for n in 1 2 3 4 5; do echo x >/dev/udp/$0/9; sleep 0.1; done"
        output_of(testbed.shells[Role.SENDER], "bash", "-c", script, cast[Role.RECEIVER].address)
        wait_until(lambda: oracle.delays(*flow).packets >= before.packets + 5, Deadline.after(30))
        after = oracle.delays(*flow)
        assert oracle.delays(*other_flow).packets == 0, "packets to another port belong to another flow"
        parts = ("processing_ns", "transmission_ns", "propagation_ns", "queuing_ns")
        increases_ns = [getattr(after, name) - getattr(before, name) for name in parts]
        assert min(increases_ns) >= 0
        assert sum(increases_ns) > 0

    def test_the_oracle_reports_the_position_of_each_robot(self, testbed: Testbed, cast: Cast) -> None:
        if testbed.oracle is None:
            return
        now_ns = time.time_ns()
        track = testbed.oracle.track(now_ns)
        assert {entry.role for entry in track if entry.utc_ns <= now_ns} == set(cast)
        assert [entry.utc_ns for entry in track] == sorted(entry.utc_ns for entry in track)

    def test_the_oracle_records_frames_until_it_is_stopped(
        self, testbed: Testbed, cast: Cast, tmp_path: Path
    ) -> None:
        if testbed.oracle is None:
            return
        testbed.oracle.record_air(tmp_path)
        try:
            output_of(testbed.shells[Role.SENDER], "ping", "-c", "1", cast[Role.RECEIVER].address)
        finally:
            testbed.oracle.record_air(None)
        sizes = {path: path.stat().st_size for path in tmp_path.iterdir()}
        output_of(testbed.shells[Role.SENDER], "ping", "-c", "1", cast[Role.RECEIVER].address)
        assert {path: path.stat().st_size for path in tmp_path.iterdir()} == sizes
