"""The shell that stays open on a robot: real shells behind a real SSH server, and whatever commands do to them."""

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
from fieldkit.remote.link import SPARES, Channel, Link, UnfitServerError
from fieldkit.remote.script import CALL, SCRIPT, SCRIPT_PATH
from fieldkit.remote.shell import Completed
from fieldkit.remote.ssh import SshSession, SshShell
from fieldkit.remote.standing import PersistentShell, RunningCommand
from tests.helpers.sshd import Server, sshd, wait_until
from tests.helpers.userlands import USERLANDS, path_of

SOON: Final = 60.0

# The job script with a verb that does what a test wants.
OBEYS: Final = SCRIPT.replace(b'\nmain "$@"\n', b'\nleft() { eval "$1"; }\nmain "$@"\n')


def soon() -> Deadline:
    return Deadline.after(SOON)


@dataclass
class Robot:
    """A robot behind a real SSH server, with a home of its own.

    Attributes:
        shell: How fieldkit reaches it.
        server: Its SSH server.
        home: Its home.
    """

    shell: SshShell
    server: Server
    home: Path

    def run(self, code: str, *, check: bool = True) -> Completed:
        return self.shell.run((*CALL, "left", code), deadline=soon(), check=check)

    def pid(self) -> int:
        """Return the process that reads commands, in a session of a command's own this command."""
        return int(self.run("echo $$").stdout)

    def stands(self) -> int:
        """Return the process of the standing shell, once there is one."""
        found: list[int] = []

        def same() -> bool:
            found.append(self.pid())
            return found[-2:-1] == found[-1:]

        wait_until(same, soon())
        return found[-1]


@contextmanager
def robot(folder: Path, userland: str = "debian", *, script: bytes = OBEYS, **options: str) -> Iterator[Robot]:
    """Run an SSH server whose sessions have this userland and a home in `folder`."""
    home = folder / "home"
    path = path_of(userland, folder / "bin")
    (home / SCRIPT_PATH).parent.mkdir(parents=True)
    (home / SCRIPT_PATH).write_bytes(script)
    before = options.pop("before", ":")
    words = f'{before}; cd {shlex.quote(str(home))} && PATH={path} && eval "$SSH_ORIGINAL_COMMAND"'
    with sshd(folder, ForceCommand=words, **options) as server, ExitStack() as stack:
        shell = server.shell()
        stack.callback(shell.close)
        yield Robot(shell, server, home)


@pytest.fixture(params=USERLANDS)
def one(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Robot]:
    with robot(tmp_path, request.param) as made:
        yield made


@pytest.fixture
def two(tmp_path: Path) -> Iterator[Robot]:
    with robot(tmp_path) as made:
        yield made


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
"""Code, exit code, standard output and standard error, None where the shell may say something of it."""


@pytest.mark.emulated
def test_streams_and_exit_code_are_a_commands_own(one: Robot) -> None:
    pid = one.stands()
    for code, exit_code, stdout, stderr in COMMANDS:
        done = one.run(code, check=False)
        assert (done.exit_code, done.stdout) == (exit_code, stdout), code
        assert stderr is None or done.stderr == stderr, code
    assert one.pid() == pid, "the same shell goes on"


@pytest.mark.emulated
def test_what_a_process_left_behind_writes_later_is_dropped(one: Robot) -> None:
    pid = one.stands()
    one.run("{ until [ -e go ] || [ ! -d $PWD ]; do sleep 0.01; done; echo stray; echo stray >&2; : >went; } & :")
    (one.home / "go").touch()
    wait_until((one.home / "went").exists, soon())
    done = one.run("echo $$")
    assert (done.stdout, done.stderr) == (f"{pid}\n".encode(), b"")


@pytest.mark.emulated
def test_a_command_that_takes_its_time_keeps_no_other_waiting(two: Robot) -> None:
    pid = two.stands()
    code = "echo up; until [ -e go ] || [ ! -d $PWD ]; do sleep 0.01; done; echo $$; exit 5"
    session = two.shell.begin((*CALL, "left", code), deadline=soon(), until=b"up\n")
    assert session.told
    assert two.pid() != pid
    (two.home / "go").touch()
    done = session.end(deadline=soon(), check=False)
    assert (done.exit_code, done.stdout) == (5, f"{pid}\n".encode())
    assert two.pid() == pid


@pytest.mark.emulated
def test_a_command_that_is_held_tells_its_end_when_asked(one: Robot) -> None:
    pid = one.stands()
    session = one.shell.begin((*CALL, "left", ": >done; exit 5"), deadline=soon())
    wait_until((one.home / "done").exists, soon())
    # It reads, or polls before it reads: proc_pid_syscall(5).
    wait_until(lambda: Path(f"/proc/{pid}/syscall").read_text().split()[0] in {"0", "7"}, soon())
    assert isinstance(session, SshSession)
    assert session._running is not None
    assert not session._running[1].eof_received, "nothing was told"
    assert one.pid() != pid
    assert session.end(deadline=soon(), check=False).exit_code == 5
    assert one.pid() == pid


@pytest.mark.emulated
def test_a_command_that_nobody_asks_about_leaves_with_its_link(two: Robot) -> None:
    pid = two.stands()
    two.shell.begin((*CALL, "left", ": >done"), deadline=soon())
    wait_until((two.home / "done").exists, soon())
    two.shell.close()
    wait_until(lambda: not Path(f"/proc/{pid}").exists(), soon())


@pytest.mark.emulated
def test_who_waits_to_be_told_hears_that_a_command_ended(two: Robot) -> None:
    two.stands()
    session = two.shell.begin((*CALL, "left", "echo u; echo why >&2; exit 4"), deadline=soon(), until=b"up\n")
    assert not session.told
    assert session.end(deadline=soon(), check=False).stderr == b"why\n"


@pytest.mark.emulated
def test_a_command_that_nobody_waits_for_any_more_holds_no_shell(two: Robot) -> None:
    pid = two.stands()
    session = two.shell.begin((*CALL, "left", "echo up; cat <>held"), deadline=soon(), until=b"up\n")
    del session
    assert two.stands() != pid


@pytest.mark.emulated
def test_a_shell_that_ended_is_none_and_another_is_opened(two: Robot) -> None:
    pid = two.stands()
    os.kill(pid, signal.SIGKILL)
    assert two.stands() != pid


@pytest.mark.emulated
def test_a_command_that_ends_its_shell_is_no_lost_link(two: Robot) -> None:
    pid = two.stands()
    with pytest.raises(RobotError, match="a signal ended the command"):
        two.run("kill -KILL $$")
    assert two.stands() != pid


@pytest.mark.emulated
def test_a_command_that_never_ends_meets_the_deadline(two: Robot) -> None:
    pid = two.stands()
    argv = (*CALL, "left", "until [ -e go ] || [ ! -d $PWD ]; do sleep 0.01; done")
    with pytest.raises(LinkError, match="did not end in time"):
        two.shell.run(argv, deadline=Deadline.after(0.5))
    assert two.stands() != pid
    (two.home / "go").touch()


@pytest.mark.emulated
def test_a_shell_that_does_not_begin_a_command_meets_the_deadline(two: Robot) -> None:
    pid = two.stands()
    os.kill(pid, signal.SIGSTOP)
    try:
        with pytest.raises(LinkError, match="did not start in time"):
            two.shell.run((*CALL, "left", ":"), deadline=Deadline.after(0.5))
    finally:
        os.kill(pid, signal.SIGCONT)
    assert two.run("echo on").stdout == b"on\n"


@pytest.mark.emulated
def test_more_output_than_is_taken_is_an_error_and_the_shell_is_left(two: Robot, tmp_path: Path) -> None:
    pid = two.stands()
    argv = (*CALL, "left", "cat /dev/zero")
    with pytest.raises(RobotError, match="sent more than 1000 bytes"):
        two.shell.fetch(argv, tmp_path / "out", deadline=soon(), limit_bytes=1000)
    assert two.stands() != pid


@pytest.mark.emulated
def test_a_command_whose_link_breaks_is_sent_again(two: Robot) -> None:
    streams = []

    def connect(timeout_s: float) -> socket.socket:
        streams.append(two.server.connect(timeout_s))
        return streams[-1]

    again = Robot(two.server.shell(connect=connect), two.server, two.home)
    again.stands()
    code = "echo >>starts; until [ -e go ] || [ ! -d $PWD ]; do sleep 0.01; done; echo over"
    with ThreadPoolExecutor(1) as pool:
        done = pool.submit(again.run, code)
        wait_until((two.home / "starts").exists, soon())
        streams[-1].shutdown(socket.SHUT_RDWR)
        wait_until(lambda: (two.home / "starts").read_text() == "\n\n", soon())
        (two.home / "go").touch()
        assert done.result(SOON).stdout == b"over\n"
    again.shell.close()
    assert len(streams) == 2


@pytest.mark.emulated
@pytest.mark.parametrize(("owner", "name"), [(Link, "_open"), (PersistentShell, "open")])
def test_what_is_being_opened_over_the_radio_is_awaited_before_that_is_measured(
    two: Robot, monkeypatch: pytest.MonkeyPatch, owner: type, name: str
) -> None:
    go, opened, opens = threading.Event(), threading.Event(), getattr(owner, name)

    def slowly(*args: object) -> object:
        go.wait(SOON)
        result = opens(*args)
        opened.set()
        return result

    def measure() -> bool:
        with shell.silence(SOON):
            return opened.is_set()

    shell = two.server.shell(on_air=True)
    shell.run(("true",), deadline=soon())
    shell._connection._link.wait_until_opened(soon())  # type: ignore[union-attr]
    monkeypatch.setattr(owner, name, slowly)
    shell.run((*CALL, "left", ":"), deadline=soon())
    with ThreadPoolExecutor(1) as pool:
        measured = pool.submit(measure)
        wait_until(lambda: measured.done() or bool(shell._connection._silence_s()), soon())
        go.set()
        assert measured.result(SOON)
    shell.close()


@pytest.mark.emulated
def test_nothing_is_opened_over_the_radio_while_that_is_measured(two: Robot) -> None:
    def opens_or_has() -> int:
        link = shell._connection._link
        assert link is not None
        return len(link._spares)

    shell = two.server.shell(on_air=True)
    shell.run(("true",), deadline=soon())
    with shell.silence(SOON):
        assert opens_or_has() == SPARES
        shell.run(("true",), deadline=soon())
        assert opens_or_has() == SPARES - 1
        shell.run((*CALL, "left", ":"), deadline=soon())
        assert opens_or_has() == SPARES - 2
        assert shell._connection.shells._opener is None
    shell.run((*CALL, "left", ":"), deadline=soon())
    assert opens_or_has() == SPARES
    assert shell._connection.shells._opener is not None
    shell.close()


@pytest.mark.emulated
@pytest.mark.parametrize("sessions", [1, 2, 3])
def test_a_server_that_allows_few_sessions_is_served_one_by_one(tmp_path: Path, sessions: int) -> None:
    with robot(tmp_path, MaxSessions=str(sessions)) as few:
        for _ in range(3):
            few.pid()
            assert few.shell.run(("echo", "own"), deadline=soon()).stdout == b"own\n"


@pytest.mark.emulated
def test_a_command_of_several_lines_has_a_session_of_its_own(two: Robot) -> None:
    pid = two.stands()
    assert int(two.run("echo \\\n$$").stdout) != pid


@pytest.mark.emulated
def test_a_robot_whose_login_shell_greets_is_asked_by_a_session_each(tmp_path: Path) -> None:
    with robot(tmp_path, before="echo welcome") as greeting:
        answers = [greeting.run("echo $$").stdout.split() for _ in range(4)]
    assert {answer[0] for answer in answers} == {b"welcome"}
    assert len({answer[1] for answer in answers}) == len(answers)


@pytest.mark.emulated
def test_a_robot_without_the_script_says_so_each_time(tmp_path: Path) -> None:
    with robot(tmp_path) as bare:
        (bare.home / SCRIPT_PATH).unlink()
        for _ in range(3):
            assert SCRIPT_PATH.encode() in bare.run(":", check=False).stderr


class Pieces:
    """A channel on which everything has come, in pieces.

    Args:
        out: Of standard output.
        err: Of standard error.
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


def split(data: bytes, at: Sequence[int]) -> list[bytes]:
    edges = [0, *sorted(n % (len(data) + 1) for n in at), len(data)]
    return [data[a:b] for a, b in pairwise(edges) if b > a]


CUTS = st.lists(st.integers(0, 1 << 16), max_size=6)


@given(st.tuples(OUTPUTS, CUTS), st.tuples(OUTPUTS, CUTS), st.integers(0, 255), st.binary(max_size=9))
def test_output_and_exit_code_are_told_apart_however_they_come(
    out: tuple[bytes, list[int]], err: tuple[bytes, list[int]], code: int, stray: bytes
) -> None:
    end = NONCE + f" {code}\n".encode()
    begin = stray + NONCE + b"\n"
    channel = Pieces(split(begin + out[0] + end + stray, out[1]), split(begin + err[0] + end, err[1]))
    taken = threading.Lock()
    taken.acquire()
    try:
        turn = RunningCommand(cast("Channel", channel), NONCE, taken)
        into = BytesIO()
        assert turn.wait_for_start()
        assert wait_for_output(turn, out[0][:3], deadline=soon(), robot="robot")
        done = drain(turn, into, stdin=None, deadline=soon(), limit_bytes=1 << 20, robot="robot")
        turn.close()
    finally:
        os.close(channel.event)
    assert (into.getvalue(), done) == (out[0][3:], (code, err[0]))
    assert not taken.locked()
    assert not channel.closed


@pytest.mark.parametrize("end", [b"\n", b" \n", b" 1234\n", b" -1\n", b" x\n", b"x 1\n", b" 1  \n"])
def test_an_end_without_an_exit_code_is_none(end: bytes) -> None:
    channel = Pieces([NONCE + b"\n" + NONCE + end + b"...."], [])
    with pytest.raises(UnfitServerError, match="exit code"):
        RunningCommand(cast("Channel", channel), NONCE, threading.Lock()).wait_for_start()
