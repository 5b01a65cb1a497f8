"""Login by password with a real sshd: the password is from a keyring or a person, and is stored nowhere."""

import logging
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import keyring
import keyring.backends.fail
import pytest
from keyring.backend import KeyringBackend

from fieldkit.backends.field import FieldBackend
from fieldkit.config.site import load_site
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import ConfigurationError, RobotError
from fieldkit.core.model import Topology
from fieldkit.core.prompts import Unattended
from fieldkit.remote import passwords
from tests.helpers.sshd import Server, sshd

SECRET = "correct horse"

SITE = """\
robots:
  turtlebot-1: {{profile: turtlebot3_burger, {same}}}
  duckiedrone-1: {{profile: duckiedrone, {access}}}
roles:
  masterless: {{sender: turtlebot-1, receiver: duckiedrone-1}}
"""


def site(access: str) -> str:
    """Return a site file with two robots, which are the same server under two host names."""
    return SITE.format(access=access, same=f"{access.replace('127.0.0.1', 'localhost')}, address: 127.0.0.2")


class MemoryKeyring(KeyringBackend):
    """A keyring in memory."""

    priority = 1.0

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.passwords: dict[tuple[str, str], str] = {}

    def get_password(self, service: str, username: str) -> str | None:
        return self.passwords.get((service, username))

    def set_password(self, service: str, username: str, password: str) -> None:
        self.passwords[service, username] = password


@pytest.fixture
def memory_keyring() -> Iterator[MemoryKeyring]:
    previous_keyring, keyring_in_memory = keyring.get_keyring(), MemoryKeyring()
    keyring.set_keyring(keyring_in_memory)
    yield keyring_in_memory
    keyring.set_keyring(previous_keyring)


@pytest.fixture(scope="module")
def password_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """Run a server with the root password `SECRET` in a mount namespace with a separate shadow file."""
    folder = tmp_path_factory.mktemp("passwords")
    crypt = subprocess.run(
        ("openssl", "passwd", "-6", "-stdin"), input=SECRET, capture_output=True, text=True, check=True
    )
    (folder / "shadow").write_text(f"root:{crypt.stdout.strip()}:20000:0:99999:7:::\nsshd:!:20000::::::\n")
    (folder / "shadow").chmod(0o640)
    command = 'mount --bind "$0" /etc/shadow && exec "$@"'
    within = ("unshare", "--mount", "--propagation", "private", "sh", "-c", command, str(folder / "shadow"))
    with sshd(folder, within=within, PermitRootLogin="yes", PasswordAuthentication="yes") as server:
        yield server


@pytest.mark.emulated
def test_password_logs_in_and_is_stored_nowhere(
    password_server: Server, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    caplog.set_level(logging.DEBUG)
    shell = password_server.shell(private_key=None, password=SECRET)
    assert shell.run(("echo", "in"), deadline=Deadline.after(20)).stdout == b"in\n"
    shell.close()
    output = capfd.readouterr()
    assert SECRET not in caplog.text + output.out + output.err + repr(vars(shell._connection))


@pytest.mark.emulated
def test_wrong_password_is_refused_and_not_shown(password_server: Server) -> None:
    shell = password_server.shell(private_key=None, password="wrong horse", host="10.1.2.3", port=2222)
    with pytest.raises(RobotError, match="refused the login of 'root' with the password") as error_info:
        shell.run(("true",), deadline=Deadline.after(20))
    assert "ssh -p 2222 root@10.1.2.3" in error_info.value.remedy
    assert "wrong horse" not in str(error_info.value)


@pytest.mark.emulated
def test_field_backend_prompts_once_per_robot_and_run(password_server: Server, tmp_path: Path) -> None:
    prompts: list[tuple[str, str, str]] = []

    def answer(user: str, host: str, robot: str) -> str:
        prompts.append((user, host, robot))
        return SECRET

    path = tmp_path / "fieldkit.yaml"
    host_key = " ".join(password_server.host_key.split()[:2])
    access = f"host: 127.0.0.1, port: {password_server.port}, user: root, password: ask, host_key: {host_key}"
    path.write_text(site(access), encoding="utf-8")
    field = FieldBackend(*load_site(path), answer)
    for _ in range(2):
        with field.open(
            field.cast(Topology.MASTERLESS), seed=1, sink=lambda event: None, operator=Unattended()
        ) as lab:
            assert len(lab.shells) == 2
    assert prompts == [("root", "localhost", "turtlebot-1"), ("root", "127.0.0.1", "duckiedrone-1")]


def test_keyring_entry_is_user_at_host(memory_keyring: MemoryKeyring) -> None:
    memory_keyring.set_password("fieldkit", "duckie@192.168.4.1", SECRET)
    assert passwords.read_from_keyring("duckie", "192.168.4.1", "duckiedrone-1") == SECRET


@pytest.mark.parametrize("path", ["with", "without"])
def test_missing_keyring_entry_is_reported_with_a_command(
    memory_keyring: MemoryKeyring, path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "keyring"
    if path == "with":
        program.touch(mode=0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ConfigurationError, match=r"no password for duckie@192\.168\.4\.1") as error_info:
        passwords.read_from_keyring("duckie", "192.168.4.1", "duckiedrone-1")
    keyring_command = "keyring" if path == "with" else f"{shlex.quote(sys.executable)} -m keyring"
    assert error_info.value.remedy == f"{keyring_command} set fieldkit duckie@192.168.4.1"


def test_missing_keyring_is_reported() -> None:
    previous_keyring = keyring.get_keyring()
    keyring.set_keyring(keyring.backends.fail.Keyring())  # type: ignore[no-untyped-call]
    try:
        with pytest.raises(ConfigurationError, match="the keyring cannot be read"):
            passwords.read_from_keyring("duckie", "192.168.4.1", "duckiedrone-1")
    finally:
        keyring.set_keyring(previous_keyring)


def test_missing_terminal_is_reported() -> None:
    with pytest.raises(ConfigurationError, match="standard input is not a terminal") as error_info:
        passwords.read_from_terminal("duckie", "192.168.4.1", "duckiedrone-1")
    assert "keyring set fieldkit duckie@192.168.4.1" in error_info.value.remedy


@pytest.mark.parametrize("password_text", [SECRET, "'ASK'", "71828182", "[s3same]"])
def test_password_in_the_site_file_is_rejected_and_not_shown(tmp_path: Path, password_text: str) -> None:
    path = tmp_path / "fieldkit.yaml"
    path.write_text(site(f"password: {password_text}"), encoding="utf-8")
    with pytest.raises(ConfigurationError, match="a password must not be in a file") as error_info:
        load_site(path)
    message = f"{error_info.value} {error_info.value.__cause__}".replace(str(tmp_path), "")
    assert password_text.strip("'[]") not in message


def test_key_and_password_together_are_rejected(tmp_path: Path) -> None:
    path = tmp_path / "fieldkit.yaml"
    path.write_text(site("password: ask, key: ~/.ssh/lab"), encoding="utf-8")
    with pytest.raises(ConfigurationError, match="a key and a password; remove one of them"):
        load_site(path)
