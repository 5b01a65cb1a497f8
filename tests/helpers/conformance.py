"""What fieldkit relies on in every Shell and every testbed, as tests: subclass, give the fixtures, run pytest.

A backend of somebody else's is tested in the same way as fieldkit's own, see `test_conformance.py`.
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
# Larger than every window: paramiko's has 2 MiB.
LARGE_BYTES = 5_000_000
LARGE_FILE_BYTES = fetching.PIECE_BYTES + 100
"""Evidence of two pieces."""

GAP_S = 3.0
NOTICED_S = 40.0
"""Within this time, also on a busy machine, a wait on a dead link must end. On a quiet one it takes 10 s at most:
tests/remote/test_remote_dead_link.py.
"""


@dataclass(frozen=True)
class Subject:
    """A Shell under test.

    Attributes:
        shell: The Shell.
        cut: Lets the way to the robot die without a word: nothing comes from it any more.
        restore: Lets it come back.
        give_up_s: How long the Shell tries to bring a lost link back, a last attempt included; short, to save time.
    """

    shell: Shell
    cut: Callable[[], None]
    restore: Callable[[], None]
    give_up_s: float

    @contextmanager
    def dead_link(self) -> Iterator[None]:
        """Cut the link for as long as the context lasts."""
        self.cut()
        try:
            yield
        finally:
            self.restore()


def soon() -> Deadline:
    return Deadline.after(SOON_S)


def said(shell: Shell, *argv: str) -> str:
    return shell.run(argv, deadline=soon()).stdout.decode()


@contextmanager
def endless(shell: Shell, *, first: str = ":") -> Iterator[tuple[str, ...]]:
    """Yield a command that does `first` and then nothing for long; at the end of the context it is ended.

    Not every SSH server ends what a client leaves: OpenSSH does not.
    """
    try:
        yield ("sh", "-c", f"{first}; echo $$ >endless; exec sleep 600")
    finally:
        said(shell, "sh", "-c", "kill $(cat endless) 2>/dev/null; rm -f endless")


@contextmanager
def waiting(shell: Shell) -> Iterator[Callable[[float], BaseException | None]]:
    """Let a thread wait for a command that never ends, with nothing to be said by either side.

    Yields what gives the thread's error, within so many seconds.
    """
    with endless(shell, first="cat") as argv, ThreadPoolExecutor(1) as pool:
        session = shell.begin(argv, deadline=soon())
        ended = pool.submit(session.end, deadline=Deadline.after(2 * SOON_S))
        said(shell, "sh", "-c", "until [ -s endless ]; do sleep 0.05; done")
        yield ended.exception


def answers(shell: Shell) -> bool:
    try:
        return said(shell, "echo", "back") == "back\n"
    except LinkError:
        return False


class ShellConformance:
    """A Shell's promises; needs a fixture `subject` that gives a `Subject`, of class scope to save time."""

    @pytest.mark.parametrize("code", [0, 1, 3, 124, 255])
    def test_both_streams_and_the_exit_code_arrive(self, subject: Subject, code: int) -> None:
        argv = ("sh", "-c", f"echo out; echo err >&2; exit {code}")
        done = subject.shell.run(argv, deadline=soon(), check=False)
        assert (done.argv, done.exit_code, done.stdout, done.stderr) == (argv, code, b"out\n", b"err\n")

    def test_a_failed_command_is_the_robot_s_error_with_its_words(self, subject: Subject) -> None:
        with pytest.raises(RobotError, match=r"exit code 3.*no bag today"):
            subject.shell.run(("sh", "-c", "echo no bag today >&2; exit 3"), deadline=soon())

    def test_a_command_that_is_not_there_has_exit_code_127(self, subject: Subject) -> None:
        done = subject.shell.run(("no-such-program",), deadline=soon(), check=False)
        assert done.exit_code == 127
        assert b"no-such-program" in done.stderr

    def test_words_arrive_as_they_are(self, subject: Subject) -> None:
        words = ["", " ", "a b", "'", '"', "$HOME", "`id`", "\\", "*", "~", "a\nb", "-n", ";", "größe", "机器人"]
        assert said(subject.shell, "printf", "%s\\0", *words).split("\0")[:-1] == words

    def test_both_streams_may_be_large_at_once(self, subject: Subject) -> None:
        script = f"head -c {LARGE_BYTES} /dev/zero >&2 & head -c {LARGE_BYTES} /dev/zero; wait; echo end >&2"
        done = subject.shell.run(("sh", "-c", script), deadline=soon())
        assert done.stdout == bytes(LARGE_BYTES)
        assert done.stderr.endswith(b"\0end\n")

    def test_standard_input_may_be_large(self, subject: Subject) -> None:
        data = bytes(range(256)) * (LARGE_BYTES // 256)
        done = subject.shell.run(("sha256sum",), stdin=data, deadline=soon())
        assert done.stdout.split()[0].decode() == hashlib.sha256(data).hexdigest()

    def test_a_session_s_input_ends_when_its_end_is_awaited(self, subject: Subject) -> None:
        session = subject.shell.begin(("cat",), deadline=soon())
        assert said(subject.shell, "echo", "meanwhile") == "meanwhile\n"
        assert session.end(deadline=soon()).exit_code == 0

    def test_silence_touches_no_link_that_lives(self, subject: Subject) -> None:
        with subject.shell.silence(SOON_S):
            assert said(subject.shell, "echo", "here") == "here\n"
        assert said(subject.shell, "echo", "again") == "again\n"

    def test_many_commands_run_at_once(self, subject: Subject) -> None:
        with ThreadPoolExecutor(8) as pool:
            texts = [f"{number}\n" for number in range(8)]
            assert list(pool.map(lambda text: said(subject.shell, "printf", text), texts)) == texts

    def test_a_file_is_fetched_whole(self, subject: Subject, tmp_path: Path) -> None:
        script = f'head -c {LARGE_BYTES} /dev/urandom >"$HOME/large" && sha256sum "$HOME/large"'
        digest = said(subject.shell, "sh", "-c", script).split()[0]
        take = ("sh", "-c", 'cat "$HOME/large" && rm "$HOME/large"')
        subject.shell.fetch(take, tmp_path / "large", deadline=soon(), limit_bytes=LARGE_BYTES)
        assert hashlib.sha256((tmp_path / "large").read_bytes()).hexdigest() == digest

    def test_a_robot_that_sends_without_end_is_stopped(self, subject: Subject, tmp_path: Path) -> None:
        with pytest.raises(RobotError, match="more than 1000 bytes"):
            subject.shell.fetch(("cat", "/dev/zero"), tmp_path / "endless", deadline=soon(), limit_bytes=1000)
        assert said(subject.shell, "echo", "on") == "on\n"

    def test_a_command_that_never_ends_meets_the_deadline(self, subject: Subject) -> None:
        with endless(subject.shell) as argv:
            began_s = time.monotonic()
            with pytest.raises(LinkError):
                subject.shell.run(argv, deadline=Deadline.after(1.0))
            assert 1.0 <= time.monotonic() - began_s < 1.0 + NOTICED_S
        assert said(subject.shell, "echo", "on") == "on\n"

    def test_a_killed_command_is_the_robot_s_error(self, subject: Subject) -> None:
        with pytest.raises(RobotError):
            subject.shell.run(("sh", "-c", "kill -KILL $$"), deadline=soon())
        assert said(subject.shell, "echo", "on") == "on\n"

    def test_closing_ends_the_waiting_of_another_thread(self, subject: Subject) -> None:
        with waiting(subject.shell) as error:
            subject.shell.close()
            assert isinstance(error(NOTICED_S), LinkError)
        assert said(subject.shell, "echo", "made again") == "made again\n"

    def test_a_detached_job_outlives_the_connection_and_is_collected(self, subject: Subject, tmp_path: Path) -> None:
        shell, folder = subject.shell, jobs.work_folder("conformance", "job-1")
        jobs.install(shell, soon())
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

    def test_a_gap_in_the_link_is_survived(self, subject: Subject) -> None:
        session = subject.shell.begin(("sh", "-c", "sleep 1; echo done"), deadline=soon())
        subject.cut()
        back = threading.Timer(GAP_S, subject.restore)
        back.start()
        try:
            assert session.end(deadline=soon()).stdout == b"done\n"
        finally:
            back.join()

    def test_a_dead_link_is_noticed_by_who_merely_waits(self, subject: Subject) -> None:
        with waiting(subject.shell) as error, subject.dead_link():
            assert isinstance(error(NOTICED_S + subject.give_up_s), LinkError)
        # The Shell gives up soon, to save time: on a busy machine sooner than a new connection takes.
        wait_until(lambda: answers(subject.shell), soon())


class RebootConformance:
    """What holds of a robot that can be rebooted; needs fixtures `subject` and `reboot`.

    `reboot` is a function that takes the robot's power and returns when it has power again.
    """

    def test_a_robot_that_reboots_is_reached_again(self, subject: Subject, reboot: Callable[[], object]) -> None:
        boot = said(subject.shell, "cat", "/proc/sys/kernel/random/boot_id")
        reboot()
        assert said(subject.shell, "cat", "/proc/sys/kernel/random/boot_id") != boot


class BackendConformance:
    """What a backend's testbed promises; needs fixtures `testbed`, `cast` and `topology`."""

    def test_every_robot_of_the_cast_has_a_shell_of_its_name(self, testbed: Testbed, cast: Cast) -> None:
        assert {role: shell.robot for role, shell in testbed.shells.items()} == {
            role: robot.name for role, robot in cast.items()
        }

    def test_each_address_is_on_the_radio_and_the_others_are_reached_by_it(
        self, testbed: Testbed, cast: Cast
    ) -> None:
        for role, robot in cast.items():
            interface = robot.profile.radio.interface
            assert f" {robot.address}/" in said(testbed.shells[role], "ip", "-4", "addr", "show", "dev", interface)
            for other in cast.values():
                if other is not robot:
                    route = said(testbed.shells[role], "ip", "route", "get", other.address)
                    assert f"dev {interface}" in route

    def test_robots_hear_each_other_where_they_are_placed(
        self, testbed: Testbed, cast: Cast, topology: Topology
    ) -> None:
        for distance in ("10m", "5m"):
            testbed.place(Placement(Scenario.LOS, topology, parse_distance(distance)))
            said(testbed.shells[Role.SENDER], "ping", "-c", "5", "-i", "0.2", cast[Role.RECEIVER].address)

    def test_what_a_testbed_can_know_does_not_change(self, testbed: Testbed) -> None:
        assert testbed.oracle is testbed.oracle

    def test_an_oracle_knows_the_lateness_of_each_packet(self, testbed: Testbed, cast: Cast) -> None:
        if testbed.oracle is None:
            return  # as of every testbed whose radio is real
        before = testbed.oracle.lateness()
        said(testbed.shells[Role.SENDER], "ping", "-c", "5", "-i", "0.2", cast[Role.RECEIVER].address)
        after = testbed.oracle.lateness()
        assert sum(after.packets.values()) - sum(before.packets.values()) >= 10
        assert before.bound_ns == after.bound_ns > 0

    def test_an_oracle_knows_the_delays_of_each_packet_that_arrived(self, testbed: Testbed, cast: Cast) -> None:
        if (oracle := testbed.oracle) is None:
            return
        flow, other = ((Role.SENDER, Role.RECEIVER, Protocol.UDP, port) for port in (9, 99))
        before = oracle.delays(*flow)
        assert oracle.delays(*other).packets == 0, "nobody has asked for it before"
        says = "for n in 1 2 3 4 5; do echo x >/dev/udp/$0/9; sleep 0.1; done"
        said(testbed.shells[Role.SENDER], "bash", "-c", says, cast[Role.RECEIVER].address)
        wait_until(lambda: oracle.delays(*flow).packets >= before.packets + 5, Deadline.after(30))
        after = oracle.delays(*flow)
        assert oracle.delays(*other).packets == 0, "packets to another port are another flow's"
        parts = ("processing_ns", "transmission_ns", "propagation_ns", "queuing_ns")
        grown_ns = [getattr(after, name) - getattr(before, name) for name in parts]
        assert min(grown_ns) >= 0
        assert sum(grown_ns) > 0

    def test_an_oracle_knows_where_each_robot_is(self, testbed: Testbed, cast: Cast) -> None:
        if testbed.oracle is None:
            return
        now_ns = time.time_ns()
        track = testbed.oracle.track(now_ns)
        assert {one.role for one in track if one.utc_ns <= now_ns} == set(cast)
        assert [one.utc_ns for one in track] == sorted(one.utc_ns for one in track)

    def test_an_oracle_records_the_air_until_it_is_told_to_stop(
        self, testbed: Testbed, cast: Cast, tmp_path: Path
    ) -> None:
        if testbed.oracle is None:
            return
        testbed.oracle.record_air(tmp_path)
        try:
            said(testbed.shells[Role.SENDER], "ping", "-c", "1", cast[Role.RECEIVER].address)
        finally:
            testbed.oracle.record_air(None)
        sizes = {path: path.stat().st_size for path in tmp_path.iterdir()}
        said(testbed.shells[Role.SENDER], "ping", "-c", "1", cast[Role.RECEIVER].address)
        assert {path: path.stat().st_size for path in tmp_path.iterdir()} == sizes
