"""Persistent shells on a robot: real shells behind a real SSH server, with commands that disturb them."""

import os
import shlex
import signal
import socket
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Final, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import LinkError, RobotError
from fieldkit.remote.drain import drain, wait_for_output
from fieldkit.remote.link import SPARE_CHANNELS, Channel, Link, UnfitServerError
from fieldkit.remote.persistent_shells import PersistentShell, wait_for_start
from fieldkit.remote.script import CALL, SCRIPT, SCRIPT_PATH
from fieldkit.remote.shell import Completed
from fieldkit.remote.ssh import SshSession, SshShell
from tests.helpers.host import wait_for_end
from tests.helpers.sshd import Server, sshd, wait_until
from tests.helpers.userlands import USERLANDS_OF_LONG_TESTS, userland_path

SOON: Final = 60.0

# The job script with a verb that runs the code of a test.
SCRIPT_WITH_EVAL: Final = SCRIPT.replace(b'\nmain "$@"\n', b'\nleft() { eval "$1"; }\nmain "$@"\n')


def soon() -> Deadline:
    return Deadline.after(SOON)


@dataclass
class Robot:
    """A robot behind a real SSH server, with a separate home.

    Attributes:
        shell: The shell of fieldkit.
        server: Its SSH server.
        home: Its home.
    """

    shell: SshShell
    server: Server
    home: Path

    def run(self, code: str, *, check: bool = True) -> Completed:
        return self.shell.run((*CALL, "left", code), deadline=soon(), check=check)

    def pid(self) -> int:
        """Return the pid of the process that runs commands: a persistent shell, or a separate session."""
        return int(self.run("echo $$").stdout)

    def shell_pid(self) -> int:
        """Return the pid of the persistent shell when it is open."""
        pids: list[int] = []

        def is_same_shell() -> bool:
            pids.append(self.pid())
            return pids[-2:-1] == pids[-1:]

        wait_until(is_same_shell, soon())
        return pids[-1]


@contextmanager
def robot(
    folder: Path, userland: str = "debian", *, script: bytes = SCRIPT_WITH_EVAL, **options: str
) -> Iterator[Robot]:
    """Run an SSH server whose sessions have this userland and a home in `folder`."""
    home = folder / "home"
    path = userland_path(userland, folder / "bin")
    (home / SCRIPT_PATH).parent.mkdir(parents=True)
    (home / SCRIPT_PATH).write_bytes(script)
    before = options.pop("before", ":")
    forced_command = f'{before}; cd {shlex.quote(str(home))} && PATH={path} && eval "$SSH_ORIGINAL_COMMAND"'
    with sshd(folder, ForceCommand=forced_command, **options) as server, ExitStack() as stack:
        shell = server.shell()
        stack.callback(shell.close)
        yield Robot(shell, server, home)


@pytest.fixture(params=USERLANDS_OF_LONG_TESTS)
def userland_robot(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Robot]:
    with robot(tmp_path, request.param) as started_robot:
        yield started_robot


@pytest.fixture
def debian_robot(tmp_path: Path) -> Iterator[Robot]:
    with robot(tmp_path) as started_robot:
        yield started_robot


COMMANDS: Final = [
    ("exit 3", 3, b"", b""),
    ("printf out; printf err >&2", 0, b"out", b"err"),
    (r"printf '\000\377\n\n\000'; exit 255", 255, b"\0\xff\n\n\0", b""),
    ("cat; echo over", 0, b"over\n", b""),
    ("cd /; umask 077; set +u; exec echo replaced", 0, b"replaced\n", b""),
    ("exec >&- 2>&-; exit 4", 4, b"", b""),
    ("exec <&-; trap 'echo left' EXIT", 0, b"left\n", b""),
    ("read -r me _ </proc/self/stat; kill -KILL $me", 137, b"", None),
    ("head -c 3000000 /dev/zero >&2; head -c 3000000 /dev/zero", 0, bytes(3_000_000), None),
    ('printf %s "$nonce" | wc -c; env | grep -c "$nonce"', 1, b"32\n0\n", b""),
]
"""Code, exit code, standard output and standard error; None if the shell may add a message to it."""


@pytest.mark.emulated
def test_streams_and_exit_code_of_commands_are_returned(userland_robot: Robot) -> None:
    pid = userland_robot.shell_pid()
    for code, exit_code, stdout, stderr in COMMANDS:
        completed = userland_robot.run(code, check=False)
        assert (completed.exit_code, completed.stdout) == (exit_code, stdout), code
        assert stderr is None or completed.stderr == stderr, code
    assert userland_robot.pid() == pid, "the same shell continues"


@pytest.mark.emulated
def test_later_output_of_a_remaining_process_is_dropped(userland_robot: Robot) -> None:
    pid = userland_robot.shell_pid()
    userland_robot.run(
        "{ until [ -e go ] || [ ! -d $PWD ]; do sleep 0.01; done; echo stray; echo stray >&2; : >went; } & :"
    )
    (userland_robot.home / "go").touch()
    wait_until((userland_robot.home / "went").exists, soon())
    completed = userland_robot.run("echo $$")
    assert (completed.stdout, completed.stderr) == (f"{pid}\n".encode(), b"")


@pytest.mark.emulated
def test_long_command_does_not_block_others(debian_robot: Robot) -> None:
    pid = debian_robot.shell_pid()
    code = "echo up; until [ -e go ] || [ ! -d $PWD ]; do sleep 0.01; done; echo $$; exit 5"
    session = debian_robot.shell.begin((*CALL, "left", code), deadline=soon(), until=b"up\n")
    assert session.is_ready
    assert debian_robot.pid() != pid
    (debian_robot.home / "go").touch()
    completed = session.end(deadline=soon(), check=False)
    assert (completed.exit_code, completed.stdout) == (5, f"{pid}\n".encode())
    assert debian_robot.pid() == pid


@pytest.mark.emulated
def test_held_command_reports_its_end_on_request(userland_robot: Robot) -> None:
    pid = userland_robot.shell_pid()
    session = userland_robot.shell.begin((*CALL, "left", ": >done; exit 5"), deadline=soon())
    wait_until((userland_robot.home / "done").exists, soon())
    # The shell waits in read or poll, see proc_pid_syscall(5).
    wait_until(lambda: Path(f"/proc/{pid}/syscall").read_text().split()[0] in {"0", "7"}, soon())
    assert isinstance(session, SshSession)
    assert session._link_and_channel is not None
    assert not session._link_and_channel[1].eof_received, "no end was reported"
    assert userland_robot.pid() != pid
    assert session.end(deadline=soon(), check=False).exit_code == 5
    assert userland_robot.pid() == pid


@pytest.mark.emulated
def test_unrequested_command_ends_with_its_link(debian_robot: Robot) -> None:
    pid = debian_robot.shell_pid()
    debian_robot.shell.begin((*CALL, "left", ": >done"), deadline=soon())
    wait_until((debian_robot.home / "done").exists, soon())
    debian_robot.shell.close()
    # If its parent exits first, it remains a zombie of this process.
    wait_for_end({pid}, within_s=SOON)


@pytest.mark.emulated
def test_wait_for_output_ends_with_the_command(debian_robot: Robot) -> None:
    debian_robot.shell_pid()
    session = debian_robot.shell.begin(
        (*CALL, "left", "echo u; echo why >&2; exit 4"), deadline=soon(), until=b"up\n"
    )
    assert not session.is_ready
    assert session.end(deadline=soon(), check=False).stderr == b"why\n"


@pytest.mark.emulated
def test_abandoned_command_releases_its_shell(debian_robot: Robot) -> None:
    pid = debian_robot.shell_pid()
    session = debian_robot.shell.begin((*CALL, "left", "echo up; cat <>held"), deadline=soon(), until=b"up\n")
    del session
    assert debian_robot.shell_pid() != pid


@pytest.mark.emulated
def test_ended_shell_is_replaced(debian_robot: Robot) -> None:
    pid = debian_robot.shell_pid()
    os.kill(pid, signal.SIGKILL)
    assert debian_robot.shell_pid() != pid


@pytest.mark.emulated
def test_command_that_kills_its_shell_is_not_a_lost_link(debian_robot: Robot) -> None:
    pid = debian_robot.shell_pid()
    with pytest.raises(RobotError, match="a signal ended the command"):
        debian_robot.run("kill -KILL $$")
    assert debian_robot.shell_pid() != pid


@pytest.mark.emulated
def test_endless_command_causes_a_timeout(debian_robot: Robot) -> None:
    pid = debian_robot.shell_pid()
    argv = (*CALL, "left", "echo up; until [ -e go ] || [ ! -d $PWD ]; do sleep 0.01; done")
    session = debian_robot.shell.begin(argv, deadline=soon(), until=b"up\n")
    with pytest.raises(LinkError, match="did not end in time"):
        session.end(deadline=Deadline.after(0.5))
    assert debian_robot.shell_pid() != pid
    (debian_robot.home / "go").touch()


@pytest.mark.emulated
def test_shell_that_does_not_start_a_command_causes_a_timeout(debian_robot: Robot) -> None:
    pid = debian_robot.shell_pid()
    os.kill(pid, signal.SIGSTOP)
    try:
        with pytest.raises(LinkError, match="did not start in time"):
            debian_robot.shell.run((*CALL, "left", ":"), deadline=Deadline.after(0.5))
    finally:
        os.kill(pid, signal.SIGCONT)
    assert debian_robot.run("echo on").stdout == b"on\n"


@pytest.mark.emulated
def test_output_beyond_the_limit_is_an_error_and_closes_the_shell(debian_robot: Robot, tmp_path: Path) -> None:
    pid = debian_robot.shell_pid()
    argv = (*CALL, "left", "cat /dev/zero")
    with pytest.raises(RobotError, match="sent more than 1000 bytes"):
        debian_robot.shell.fetch(argv, tmp_path / "out", deadline=soon(), limit_bytes=1000)
    assert debian_robot.shell_pid() != pid


@pytest.mark.emulated
def test_command_whose_link_breaks_is_sent_again(debian_robot: Robot) -> None:
    streams = []

    def connect(timeout_s: float) -> socket.socket:
        streams.append(debian_robot.server.connect(timeout_s))
        return streams[-1]

    reconnecting_robot = Robot(debian_robot.server.shell(connect=connect), debian_robot.server, debian_robot.home)
    reconnecting_robot.shell_pid()
    code = "echo >>starts; until [ -e go ] || [ ! -d $PWD ]; do sleep 0.01; done; echo over"
    with ThreadPoolExecutor(1) as pool:
        future = pool.submit(reconnecting_robot.run, code)
        wait_until((debian_robot.home / "starts").exists, soon())
        streams[-1].shutdown(socket.SHUT_RDWR)
        wait_until(lambda: (debian_robot.home / "starts").read_text() == "\n\n", soon())
        (debian_robot.home / "go").touch()
        assert future.result(SOON).stdout == b"over\n"
    reconnecting_robot.shell.close()
    assert len(streams) == 2


@pytest.mark.emulated
@pytest.mark.parametrize(("owner", "name"), [(Link, "_open"), (PersistentShell, "open")])
def test_opening_channels_are_awaited_before_a_measurement(
    debian_robot: Robot, monkeypatch: pytest.MonkeyPatch, owner: type, name: str
) -> None:
    go, is_opened, original_open = threading.Event(), threading.Event(), getattr(owner, name)

    def open_after_go(*args: object) -> object:
        go.wait(SOON)
        result = original_open(*args)
        is_opened.set()
        return result

    def measure() -> bool:
        with shell.silence(SOON):
            return is_opened.is_set()

    shell = debian_robot.server.shell(crosses_radio=True)
    shell.run(("true",), deadline=soon())
    shell._connection._link.wait_until_open(soon())  # type: ignore[union-attr]
    monkeypatch.setattr(owner, name, open_after_go)
    shell.run((*CALL, "left", ":"), deadline=soon())
    with ThreadPoolExecutor(1) as pool:
        measurement = pool.submit(measure)
        wait_until(lambda: measurement.done() or bool(shell._connection._silence_s()), soon())
        go.set()
        assert measurement.result(SOON)
    shell.close()


@pytest.mark.emulated
def test_nothing_is_opened_over_the_radio_during_a_measurement(debian_robot: Robot) -> None:
    def open_channels() -> int:
        link = shell._connection._link
        assert link is not None
        return len(link._spares)

    shell = debian_robot.server.shell(crosses_radio=True)
    shell.run(("true",), deadline=soon())
    with shell.silence(SOON):
        assert open_channels() == SPARE_CHANNELS
        shell.run(("true",), deadline=soon())
        assert open_channels() == SPARE_CHANNELS - 1
        shell.run((*CALL, "left", ":"), deadline=soon())
        assert open_channels() == SPARE_CHANNELS - 2
        assert shell._connection.shells._opener is None
    shell.run((*CALL, "left", ":"), deadline=soon())
    assert open_channels() == SPARE_CHANNELS
    assert shell._connection.shells._opener is not None
    shell.close()


@pytest.mark.emulated
@pytest.mark.parametrize("sessions", [1, 2, 3])
def test_server_with_few_sessions_runs_commands_in_sequence(tmp_path: Path, sessions: int) -> None:
    with robot(tmp_path, MaxSessions=str(sessions)) as limited_robot:
        for _ in range(3):
            limited_robot.pid()
            assert limited_robot.shell.run(("echo", "own"), deadline=soon()).stdout == b"own\n"


@pytest.mark.emulated
def test_command_of_several_lines_uses_a_separate_session(debian_robot: Robot) -> None:
    pid = debian_robot.shell_pid()
    assert int(debian_robot.run("echo \\\n$$").stdout) != pid


@pytest.mark.emulated
def test_login_shell_with_a_greeting_uses_separate_sessions(tmp_path: Path) -> None:
    with robot(tmp_path, before="echo welcome") as greeting_robot:
        answers = [greeting_robot.run("echo $$").stdout.split() for _ in range(4)]
    assert {answer[0] for answer in answers} == {b"welcome"}
    assert len({answer[1] for answer in answers}) == len(answers)


@pytest.mark.emulated
def test_missing_script_is_reported_each_time(tmp_path: Path) -> None:
    with robot(tmp_path) as plain_robot:
        (plain_robot.home / SCRIPT_PATH).unlink()
        for _ in range(3):
            assert SCRIPT_PATH.encode() in plain_robot.run(":", check=False).stderr


class ReceivedChannel:
    """A channel on which all data have arrived, in pieces.

    Args:
        out: Pieces of standard output.
        err: Pieces of standard error.
    """

    def __init__(self, out: Sequence[bytes], err: Sequence[bytes]) -> None:
        self.out, self.err = list(out), list(err)
        self.closed = self.eof_received = False
        self.status_event = threading.Event()
        self.event = os.eventfd(1)

    def recv_ready(self) -> bool:
        return bool(self.out)

    def recv_stderr_ready(self) -> bool:
        return bool(self.err)

    def recv(self, size_bytes: int) -> bytes:
        return self.out.pop(0)

    def recv_stderr(self, size_bytes: int) -> bytes:
        return self.err.pop(0)

    def settimeout(self, seconds: float | None) -> None:
        pass

    def fileno(self) -> int:
        return self.event

    def close(self) -> None:
        self.closed = True


NONCE: Final = b"0123456789abcdef"
OUTPUTS = st.lists(st.one_of(st.binary(), st.integers(1, 15).map(lambda n: NONCE[:n]))).map(b"".join)


def split_at(data: bytes, positions: Sequence[int]) -> list[bytes]:
    edges = [0, *sorted(n % (len(data) + 1) for n in positions), len(data)]
    return [data[start:end_marker] for start, end_marker in pairwise(edges) if end_marker > start]


CUTS = st.lists(st.integers(0, 1 << 16), max_size=6)


@given(st.tuples(OUTPUTS, CUTS), st.tuples(OUTPUTS, CUTS), st.integers(0, 255), st.binary(max_size=9))
def test_output_and_exit_code_are_separated_for_any_pieces(
    out: tuple[bytes, list[int]], err: tuple[bytes, list[int]], code: int, stray_output: bytes
) -> None:
    end_marker = NONCE + f" {code}\n".encode()
    start_marker = stray_output + NONCE + b"\n"
    channel = ReceivedChannel(
        split_at(start_marker + out[0] + end_marker + stray_output, out[1]),
        split_at(start_marker + err[0] + end_marker, err[1]),
    )
    lock = threading.Lock()
    lock.acquire()
    try:
        running_command = wait_for_start(cast("Channel", channel), NONCE, lock)
        output = BytesIO()
        assert running_command is not None
        assert wait_for_output(running_command, out[0][:3], deadline=soon(), robot="robot")
        completed = drain(running_command, output, stdin=None, deadline=soon(), limit_bytes=1 << 20, robot="robot")
        running_command.close()
    finally:
        os.close(channel.event)
    assert (output.getvalue(), completed) == (out[0][3:], (code, err[0]))
    assert not lock.locked()
    assert not channel.closed


@pytest.mark.parametrize("end_marker", [b"\n", b" \n", b" 1234\n", b" -1\n", b" x\n", b"x 1\n", b" 1  \n"])
def test_end_without_an_exit_code_is_an_error(end_marker: bytes) -> None:
    channel = ReceivedChannel([NONCE + b"\n" + NONCE + end_marker + b"...."], [])
    with pytest.raises(UnfitServerError, match="exit code"):
        wait_for_start(cast("Channel", channel), NONCE, threading.Lock())
