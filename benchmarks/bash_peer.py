"""Run the bash script with which fieldkit is compared, on the same emulated robots."""

import os
import signal
import socket
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Final, Self

from benchmarks.lifetimes import Lines
from benchmarks.slow_links import SlowLinks
from fieldkit.core.deadline import Deadline
from fieldkit.core.model import Role
from sim_backends.emulated.nodes import EmulatedRobot
from sim_backends.emulated.provisioning import KeyPair
from sim_backends.emulated.robot.spec import SSH_PORT, USER
from sim_backends.emulated.testbed import EmulatedTestbed

SCRIPT: Final = Path(__file__).with_name("trial_overhead.sh")
DONE: Final = "done"

_KILLED_WITH_PARENT: Final = ("setpriv", "--pdeathsig", "KILL", "--")
_CONNECT_S: Final = 10.0
# `ProxyCommand false`: a client without its master connection fails. Otherwise it would connect to the SSH server of
# this machine.
_SSH_CONFIG: Final = """\
Host *
  HostName 127.0.0.1
  User {user}
  IdentityFile {folder}/key
  IdentitiesOnly yes
  UserKnownHostsFile {folder}/known_hosts-%n
  StrictHostKeyChecking accept-new
  LogLevel ERROR
  BatchMode yes
  ControlPath {folder}/%n
  ProxyCommand false
"""


class BashPeer:
    """The running script. `connected` makes the connections that it needs.

    Args:
        config: OpenSSH configuration with the hosts `sender` and `receiver`.
        words: The script's arguments after the configuration.
    """

    def __init__(self, config: Path, words: Sequence[str]) -> None:
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 (`close` closes it)
        self._process = subprocess.Popen(
            [*_KILLED_WITH_PARENT, "bash", str(SCRIPT), str(config), *words],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            start_new_session=True,
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._orders = self._process.stdin
        self._lines = Lines(self._process.stdout.fileno(), "the script")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def repeat(self, protocol: str, number: int, limit_s: float) -> Iterator[str]:
        """Run a repeat; yield the name of each phase at its start.

        Raises:
            RuntimeError: It failed or took longer than `limit_s`; the message has the first 4 KiB of its standard
                error.
        """
        deadline = Deadline.after(limit_s)
        self._orders.write(f"{protocol} {number}\n".encode())
        self._orders.flush()
        try:
            while (phase := self._lines.next(deadline)) != DONE:
                yield phase
        except (EOFError, TimeoutError) as error:
            errors_text = os.pread(self._errors.fileno(), 1 << 12, 0).decode(errors="replace")
            raise RuntimeError(f"{error}: {errors_text}") from error

    def close(self) -> None:
        """Kill the script and its SSH clients."""
        os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self._errors.close()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()


@contextmanager
def connected(testbed: EmulatedTestbed, roles: Sequence[Role], slow: SlowLinks | None) -> Iterator[Path]:
    """Open an OpenSSH master connection to each robot, which clients share; yield the file with their configuration.

    The connection is opened inside of the robot's network namespace, so that no other program forwards data between
    script and robot, unless slow links are used.
    """
    login = KeyPair.make()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="fieldkit-bench-")))
        config = folder / "config"
        config.write_text(_SSH_CONFIG.format(user=USER, folder=folder), encoding="utf-8")
        key = folder / "key"
        key.touch(mode=0o600)
        key.write_text(login.private, encoding="ascii")
        for role in roles:
            allow = ("sh", "-c", "cat >>.ssh/authorized_keys")
            line = f"{login.public}\n".encode()
            testbed.shells[role].run(allow, stdin=line, deadline=Deadline.after(_CONNECT_S))
            stack.enter_context(_master(testbed.robots[role], config, role, slow))
        key.unlink()
        yield config


@contextmanager
def _master(robot: EmulatedRobot, config: Path, role: Role, slow: SlowLinks | None) -> Iterator[None]:
    """Open an OpenSSH master connection to a robot while the body runs."""
    ssh = ("ssh", "-F", str(config), "-o", "ProxyCommand=none", "-M", "-N")
    if slow is None:
        command_words: tuple[str, ...] = ("nsenter", f"--net=/proc/{robot.pid}/ns/net", "--", *ssh)
    else:
        command_words = (*ssh, "-p", str(slow.port(partial(robot.stream_to, "127.0.0.1", SSH_PORT))))
    argv = [*_KILLED_WITH_PARENT, *command_words, role]
    process = subprocess.Popen(argv, stdin=subprocess.DEVNULL, start_new_session=True)
    try:
        _wait_for_socket(config.parent / role, process)
        yield
    finally:
        process.terminate()
        process.wait()


def _wait_for_socket(path: Path, process: "subprocess.Popen[bytes]") -> None:
    deadline = Deadline.after(_CONNECT_S)
    with socket.socket(socket.AF_UNIX) as probe:
        while probe.connect_ex(str(path)) != 0:
            if deadline.expired or process.poll() is not None:
                raise RuntimeError(f"no SSH connection to {path.name}")
            os.sched_yield()
