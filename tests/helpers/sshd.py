"""An OpenSSH server on loopback with newly generated keys."""

import random
import shutil
import socket
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import pytest

from fieldkit.core.deadline import Deadline
from fieldkit.remote.ssh import SshShell

UP_S: Final = 60.0
"""Time limit for the first answer of a server on a busy machine."""


@dataclass(frozen=True)
class Server:
    """A running sshd.

    Attributes:
        port: Port on loopback.
        host_key: Public host key.
        private_key: A key that the server accepts.
        folder: Folder with its files.
        pid: Process id.
    """

    port: int
    host_key: str
    private_key: str
    folder: Path
    pid: int

    def connect(self, timeout_s: float) -> socket.socket:
        return socket.create_connection(("127.0.0.1", self.port), timeout=timeout_s)

    def shell(self, **changes: object) -> SshShell:
        options = {
            "connect": self.connect,
            "user": "root",
            "host_key": self.host_key,
            "private_key": self.private_key,
        } | changes
        return SshShell("robot", **options)  # type: ignore[arg-type]


def make_key(path: Path, kind: str = "ed25519") -> str:
    subprocess.run(("ssh-keygen", "-q", "-t", kind, "-N", "", "-f", str(path)), check=True)
    return path.with_suffix(".pub").read_text(encoding="ascii")


def free_port() -> int:
    """An unused port outside the ephemeral range, which the kernel does not assign automatically."""
    first_ephemeral, _ = map(int, Path("/proc/sys/net/ipv4/ip_local_port_range").read_text(encoding="ascii").split())
    while True:
        port = random.SystemRandom().randrange(10_000, max(first_ephemeral, 30_000))
        with socket.socket() as probe:
            try:
                probe.bind(("", port))
            except OSError:
                continue
        return port


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with sshd(tmp_path_factory.mktemp("sshd")) as running:
        yield running


@contextmanager
def sshd(folder: Path, *, within: Sequence[str] = (), **options: str) -> Iterator[Server]:
    """Run sshd on loopback with its files in `folder`.

    Args:
        folder: Folder for the keys and the log.
        within: Words that precede its command line.
        options: Options of sshd_config in addition to the required ones.
    """
    host_key = make_key(folder / "host")
    (folder / "authorized_keys").write_text(make_key(folder / "client"), encoding="ascii")
    program = shutil.which("sshd", path="/usr/sbin:/usr/bin")
    assert program is not None
    Path("/run/sshd").mkdir(exist_ok=True)  # privilege separation folder, otherwise created by Debian's service
    port = free_port()
    options = {
        "ListenAddress": f"127.0.0.1:{port}",
        "AuthorizedKeysFile": str(folder / "authorized_keys"),
        "StrictModes": "no",
        "UsePAM": "no",
        "PidFile": "none",
        "MaxSessions": "64",
    } | options
    argv = [*within, program, "-D", "-e", "-f", "/dev/null", "-h", str(folder / "host")]
    argv += [f"-o{name}={value}" for name, value in options.items()]
    with (folder / "log").open("wb") as log, subprocess.Popen(argv, stderr=log) as process:
        try:
            wait_until(lambda: is_ssh_server(port), Deadline.after(UP_S))
            yield Server(port, host_key, (folder / "client").read_text(encoding="ascii"), folder, process.pid)
        finally:
            process.terminate()


def is_ssh_server(port: int) -> bool:
    try:
        with socket.create_connection(("127.0.0.1", port), timeout=1) as connection:
            return connection.recv(4) == b"SSH-"
    except OSError:
        return False


def wait_until(condition: Callable[[], bool], deadline: Deadline) -> None:
    while not condition():
        assert not deadline.expired, "the condition did not become true in time"
        time.sleep(0.01)
