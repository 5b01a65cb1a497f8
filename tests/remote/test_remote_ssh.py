"""The SSH shell with a real OpenSSH server: faults that occur in the field, and the required reactions."""

import hashlib
import resource
import select
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import ConfigurationError, LinkError, RobotError
from fieldkit.remote.command import printable, quote, with_environment
from fieldkit.remote.ssh import SshShell
from tests.helpers.sshd import Server, free_port, make_key, sshd

pytestmark = pytest.mark.emulated

SOON = 60.0


@pytest.fixture
def shell(server: Server) -> Iterator[SshShell]:
    test_shell = server.shell()
    yield test_shell
    test_shell.close()


def soon() -> Deadline:
    return Deadline.after(SOON)


def test_output_streams_and_exit_code_are_returned(shell: SshShell) -> None:
    completed = shell.run(("sh", "-c", "echo out; echo err >&2; exit 3"), deadline=soon(), check=False)
    assert (completed.exit_code, completed.stdout, completed.stderr) == (3, b"out\n", b"err\n")


def test_begin_returns_after_the_expected_output(shell: SshShell, tmp_path: Path) -> None:
    go = tmp_path / "go"
    script = 'cat; sleep 0.2; echo up; until [ -e "$0" ]; do sleep 0.02; done; echo over; exit 4'
    session = shell.begin(("sh", "-c", script, str(go)), deadline=soon(), until=b"up\n")
    assert session.is_ready
    go.touch()
    completed = session.end(deadline=soon(), check=False)
    assert (completed.exit_code, completed.stdout) == (4, b"over\n")


def test_begin_returns_when_the_command_ended_without_the_output(shell: SshShell) -> None:
    session = shell.begin(("sh", "-c", "echo u; echo why >&2; exit 4"), deadline=soon(), until=b"up\n")
    assert not session.is_ready
    assert session.end(deadline=soon(), check=False).stderr == b"why\n"


class CountingDeadline(Deadline):
    """A deadline that counts how often it is checked."""

    count = 0

    @property
    def expired(self) -> bool:
        type(self).count += 1
        return super().expired


def test_wait_for_output_does_not_poll_because_of_standard_error(shell: SshShell, tmp_path: Path) -> None:
    go = tmp_path / "go"
    script = 'echo why >&2; until [ -e "$0" ]; do sleep 0.02; done; echo up'
    threading.Timer(0.5, go.touch).start()
    session = shell.begin(("sh", "-c", script, str(go)), deadline=CountingDeadline.after(SOON), until=b"up\n")
    assert session.end(deadline=soon()).stderr == b"why\n"
    assert CountingDeadline.count < SOON


def test_command_without_output_causes_a_timeout(shell: SshShell) -> None:
    shell.run(("true",), deadline=soon())  # the next command waits for no connection
    with pytest.raises(LinkError, match="did not report in time"):
        shell.begin(("sleep", "20"), deadline=Deadline.after(2.0), until=b"up\n")


@pytest.mark.parametrize("sessions", [1, 2])
def test_server_with_few_channels_runs_commands_in_sequence(tmp_path: Path, sessions: int) -> None:
    with sshd(tmp_path, MaxSessions=str(sessions)) as limited_server:
        shell = limited_server.shell()
        for number in range(5):
            assert shell.run(("echo", str(number)), deadline=soon()).stdout == f"{number}\n".encode()
        shell.close()


def test_server_without_sessions_is_reported_and_not_polled(tmp_path: Path) -> None:
    notices: list[str] = []
    with sshd(tmp_path, MaxSessions="0") as server_without_sessions:
        shell = server_without_sessions.shell(reconnect_timeout_s=4.0, on_notice=notices.append)
        with pytest.raises(LinkError, match="its SSH server opens no session") as error_info:
            shell.run(("true",), deadline=Deadline.after(4))
        shell.close()
    assert "MaxSessions" in error_info.value.remedy
    assert len(notices) < 12, "a link lasts 2 s and causes two notices"


def test_failed_command_is_reported_with_its_output(shell: SshShell) -> None:
    with pytest.raises(RobotError, match=r"ended with exit code 2: .*No such file"):
        shell.run(("ls", "/no/such/file"), deadline=soon())
    with pytest.raises(RobotError, match=r"ended with exit code 1: This account is not available"):
        shell.run(("sh", "-c", "echo This account is not available; exit 1"), deadline=soon())


def test_both_streams_may_exceed_all_windows(shell: SshShell) -> None:
    # Reading one stream while the other one fills up deadlocks paramiko (paramiko/paramiko#1778).
    script = "head -c 6000000 /dev/zero >&2; head -c 6000000 /dev/zero"
    completed = shell.run(("sh", "-c", script), deadline=soon())
    assert len(completed.stdout) == 6_000_000
    assert completed.stderr.strip(b"\0") == b""


def test_standard_input_may_exceed_all_windows(shell: SshShell) -> None:
    data = bytes(range(256)) * 40_000
    completed = shell.run(("sha256sum",), stdin=data, deadline=soon())
    assert completed.stdout.split()[0].decode() == hashlib.sha256(data).hexdigest()


def test_endless_command_causes_a_timeout(shell: SshShell, tmp_path: Path) -> None:
    script = 'echo up; while [ -e "$0" ]; do sleep 0.1; done'
    session = shell.begin(("sh", "-c", script, str(tmp_path)), deadline=soon(), until=b"up\n")
    start_s = time.monotonic()
    with pytest.raises(LinkError, match="did not end in time"):
        session.end(deadline=Deadline.after(0.5))
    assert time.monotonic() - start_s < SOON
    tmp_path.rmdir()  # sshd does not terminate the command of a lost client
    assert shell.run(("echo", "again"), deadline=soon()).stdout == b"again\n"


def test_wait_continues_after_this_process_was_suspended(shell: SshShell, monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock of the deadline advances during the suspension, and the robot continues."""
    monotonic, wait = time.monotonic, select.select
    stopped_s: list[float] = []

    def stop_once(read: list[int], write: list[int], exceptional: list[int], wait_s: float) -> object:
        ready = wait(read, write, exceptional, wait_s)
        if not stopped_s:
            stopped_s.append(1000.0)
        return ready

    shell.run(("true",), deadline=soon())
    monkeypatch.setattr(time, "monotonic", lambda: monotonic() + sum(stopped_s))
    monkeypatch.setattr(select, "select", stop_once)
    assert shell.run(("sh", "-c", "sleep 0.1; echo here"), deadline=soon()).stdout == b"here\n"
    assert stopped_s


def test_silent_server_causes_a_timeout(server: Server) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent_server:
        port = silent_server.getsockname()[1]
        shell = server.shell(connect=lambda timeout_s: socket.create_connection(("127.0.0.1", port), timeout_s))
        with pytest.raises(LinkError):
            shell.run(("true",), deadline=Deadline.after(0.5))


def test_closed_port_is_a_link_error_with_a_remedy(server: Server) -> None:
    port = free_port()
    shell = server.shell(connect=lambda timeout_s: socket.create_connection(("127.0.0.1", port), timeout_s))
    with pytest.raises(LinkError, match="cannot be reached for SSH: nothing listens") as error_info:
        shell.run(("true",), deadline=soon())
    assert error_info.value.exit_code == 3
    assert error_info.value.remedy


def test_changed_host_key_is_reported_with_both_fingerprints(server: Server, tmp_path: Path) -> None:
    shell = server.shell(host_key=make_key(tmp_path / "other"))
    with pytest.raises(RobotError, match=r"host key changed: pinned SHA256:\S+, offered SHA256:\S+"):
        shell.run(("true",), deadline=soon())


def test_unauthorized_key_is_refused(server: Server, tmp_path: Path) -> None:
    make_key(tmp_path / "unauthorized")
    shell = server.shell(private_key=(tmp_path / "unauthorized").read_text(encoding="ascii"))
    with pytest.raises(RobotError, match=r"refused the login of 'root' with 1 key") as error_info:
        shell.run(("true",), deadline=soon())
    assert "ssh-copy-id root@robot" in error_info.value.remedy


@pytest.mark.parametrize("text", ["", "ssh-ed25519", "ssh-ed25519 !!!", "nonsense AAAA", "ssh-rsa AAAAC3NzaC1lZDI1"])
def test_invalid_host_key_is_reported(server: Server, text: str) -> None:
    with pytest.raises(ConfigurationError, match="host key cannot be read"):
        server.shell(host_key=text)


def test_unusable_private_key_is_reported(server: Server) -> None:
    shell = server.shell(private_key="-----BEGIN NOTHING-----")
    with pytest.raises(ConfigurationError, match="private key cannot be used"):
        shell.run(("true",), deadline=soon())


def test_command_terminated_by_a_signal_is_not_a_lost_link(shell: SshShell) -> None:
    with pytest.raises(RobotError, match="a signal ended the command: last words"):
        shell.run(("sh", "-c", "echo last words >&2; kill -KILL $$"), deadline=soon())
    assert shell.run(("echo", "again"), deadline=soon()).stdout == b"again\n"


def test_full_local_disk_is_not_a_lost_link(shell: SshShell, tmp_path: Path) -> None:
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 16, limit[1]))
    try:
        with pytest.raises(OSError, match="too large"):
            shell.fetch(
                ("head", "-c", "1000000", "/dev/zero"), tmp_path / "file", deadline=soon(), limit_bytes=1 << 24
            )
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)


def test_fetch_writes_to_a_file_and_limits_its_size(shell: SshShell, tmp_path: Path) -> None:
    shell.fetch(("printf", "abc"), tmp_path / "f", deadline=soon(), limit_bytes=10)
    assert (tmp_path / "f").read_bytes() == b"abc"
    with pytest.raises(RobotError, match="sent more than 100 bytes"):
        shell.fetch(("cat", "/dev/zero"), tmp_path / "f", deadline=soon(), limit_bytes=100)


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.text(st.characters(exclude_characters="\0", codec="utf-8"), max_size=20), min_size=1, max_size=5))
def test_any_argument_arrives_unchanged(shell: SshShell, words: list[str]) -> None:
    completed = shell.run(("printf", "%s\\0", *words), deadline=soon())
    assert completed.stdout.decode().split("\0")[:-1] == words


def test_setup_files_and_variables_reach_the_command(shell: SshShell, tmp_path: Path) -> None:
    setup = tmp_path / "set up.bash"
    setup.write_text("export DISTRO='noetic x'\n", encoding="utf-8")
    argv = with_environment(("sh", "-c", 'echo "$DISTRO $EXTRA"'), setup=(str(setup),), environment={"EXTRA": "a b"})
    assert shell.run(argv, deadline=soon()).stdout == b"noetic x a b\n"


def test_quote_keeps_plain_words() -> None:
    assert quote(("nc.traditional", "-l", "-p", "1234")) == "nc.traditional -l -p 1234"


def test_quote_escapes_backslashes_for_fish() -> None:
    """In single quotes of fish, two backslashes are one, and a backslash before the closing quote escapes it."""
    assert quote(("a\\b", "\\")) == """'a'"\\\\"'b' ''"\\\\"''"""


@pytest.mark.parametrize(
    ("output", "text"),
    [
        (b"Subscribing to /scan\nRecording", "to /scan Recording"),
        (b"x" * 21, "x" * 20),
        (b"all of it is here", "all of it is here"),
    ],
)
def test_long_output_is_shortened_between_words(output: bytes, text: str) -> None:
    assert printable(output, limit=20) == text


@given(st.binary(max_size=200))
def test_output_cannot_control_the_terminal(data: bytes) -> None:
    text = printable(data, limit=50)
    assert len(text) <= 50
    assert text.isprintable()
