"""The lab's process: starts the robots, detaches from the terminal, answers requests, and stops the robots."""

import os
import shlex
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from types import FrameType
from typing import Final

from fieldkit.core import runtime
from fieldkit.core.errors import ConfigurationError, FieldkitError
from fieldkit.core.events import Sink
from fieldkit.core.runtime import NameHeldError
from fieldkit.lab import requests
from fieldkit.lab.folder import LabFolder, make, remove
from fieldkit.lab.protocol import Lab, LabBackend, Login, unknown_robot_error
from fieldkit.lab.requests import LabState, RobotState

OnReady = Callable[[Path], None]
"""Called when start-up is complete, with the log file for all further output."""

_READY: Final = b"+"


def run_detached(work: Callable[[OnReady], int]) -> int:
    """Run `work` in a child process; return when its start-up is complete or the child has exited.

    During start-up the child keeps this terminal: its output is shown here, and it receives Ctrl-C. If an exception,
    such as KeyboardInterrupt, ends the wait of this process, the child is terminated first.

    Args:
        work: Receives a function that it calls with its log file when start-up is complete; after that call it has no
            terminal. Returns its exit code.

    Returns:
        0 if start-up is complete. If the child exited earlier, its exit code: the result of `work`, 1 if `work`
        raised an exception, or the negative number of the signal that killed the child.
    """
    ready_reader, ready_writer = os.pipe()
    sys.stdout.flush()  # otherwise the child would write a copy of the buffered text
    pid = os.fork()
    if pid == 0:
        os.close(ready_reader)
        code = 1
        try:
            code = work(lambda log: _detach(ready_writer, log))
        except BaseException:  # noqa: BLE001 (reported as the interpreter reports it; only the parent cleans up)
            sys.excepthook(*sys.exc_info())
        sys.stdout.flush()
        os._exit(code)
    os.close(ready_writer)
    try:
        with os.fdopen(ready_reader, "rb") as ready:
            if ready.read() == _READY:
                return 0
    except BaseException:
        os.kill(pid, signal.SIGTERM)
        os.waitpid(pid, 0)
        raise
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def _detach(ready_writer: int, log: Path) -> None:
    """Detach from the terminal and the current directory, and notify the parent that start-up is complete."""
    sys.stdout.flush()
    os.setsid()
    os.chdir("/")
    null = os.open(os.devnull, os.O_RDONLY)
    output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
    for source, target in ((null, 0), (output, 1), (output, 2)):
        os.dup2(source, target)
    os.close(null)
    os.close(output)
    os.write(ready_writer, _READY)
    os.close(ready_writer)


REQUEST_S: Final = 5.0
"""Timeout of each read from a client and each write to it, and of the connection to a robot."""

_REQUEST_BYTES: Final = 4096


def run(folder: LabFolder, backend: LabBackend, *, seed: int, sink: Sink, on_ready: Callable[[Lab], None]) -> None:
    """Run the robots of a backend until SIGINT, SIGTERM or SIGHUP, then remove them completely.

    It must be called in the main thread: only this thread can set signal handlers, and the kernel terminates the
    robots when the thread that started them exits.

    Args:
        folder: The folder of the lab.
        backend: Starts the robots.
        seed: Seed of all random numbers of the lab.
        sink: Receives the names of phases.
        on_ready: Called with the lab when its robots have started and its files are written. The requests of clients
            are answered after this call.

    Raises:
        ConfigurationError: A lab of this directory is already up, or other users have access to its folder.
        FieldkitError: For the same reasons as `LabBackend.open_lab`.
    """
    with (
        _until_signal(),
        _lab_lock(folder),
        _listen(folder) as listener,
        backend.open_lab(seed=seed, sink=sink) as lab,
    ):
        start_s = time.monotonic()
        write_ssh_config(folder, lab.login)
        on_ready(lab)
        while True:
            client, _ = listener.accept()
            _serve(client, lab, start_s)


@contextmanager
def _lab_lock(folder: LabFolder) -> Iterator[None]:
    """Hold the lock that allows only one lab per directory; raises `ConfigurationError` if a process holds it."""
    with ExitStack() as stack:
        try:
            stack.enter_context(runtime.hold_lock(folder.lock_name))
        except NameHeldError as error:
            raise ConfigurationError(
                "a lab is already running in this directory", remedy="fieldkit lab down"
            ) from error
        yield


@contextmanager
def _listen(folder: LabFolder) -> Iterator[socket.socket]:
    make(folder)
    try:
        with socket.socket(socket.AF_UNIX) as listener:
            listener.bind(str(folder.socket))
            folder.socket.chmod(0o600)
            listener.listen(128)
            yield listener
    finally:
        remove(folder)


@contextmanager
def _until_signal() -> Iterator[None]:
    """Leave the body at the first signal, without an exception for the caller.

    Later signals are ignored until the body has been left, so that its clean-up is not interrupted.
    """
    is_stopping = False

    def stop(_number: int, _frame: FrameType | None) -> None:
        nonlocal is_stopping
        if not is_stopping:
            is_stopping = True
            raise KeyboardInterrupt

    previous = {
        signal_number: signal.signal(signal_number, stop)
        for signal_number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    }
    try:
        yield
    except KeyboardInterrupt:
        return
    finally:
        for signal_number, handler in previous.items():
            signal.signal(signal_number, handler)


def _serve(client: socket.socket, lab: Lab, start_s: float) -> None:
    """Answer one request. After an error of the connection or an invalid request, the connection is only closed."""
    with closing(client):
        client.settimeout(REQUEST_S)
        try:
            command, _, arguments = client.recv(_REQUEST_BYTES).decode().strip().partition(" ")
            match command:
                case "connect":
                    _pass_socket(client, lab, arguments)
                case "state":
                    client.sendall(_state(lab, time.monotonic() - start_s))
                case "overview":
                    client.sendall(_overview(lab))
                case "move":
                    client.sendall(_move(lab, *arguments.split(" ", 1)))
        except (OSError, TypeError, ValueError):
            return


def _pass_socket(client: socket.socket, lab: Lab, name: str) -> None:
    """Pass a client the socket to a robot, or send it the error message."""
    try:
        stream = lab.connect(name, REQUEST_S)
    except KeyError:
        client.sendall(f"there is no robot {name!r} in this lab".encode())
    except (OSError, FieldkitError) as error:
        client.sendall(f"{name} does not answer: {error}".encode())
    else:
        with closing(stream):
            stream.setblocking(True)
            socket.send_fds(client, [b"+"], [stream.fileno()])


def _move(lab: Lab, name: str, destination: str) -> bytes:
    """Move a robot; return the answer: its new position, or the error that prevented the move."""
    try:
        if name not in lab.members:
            raise unknown_robot_error(name, lab.members)
        return requests.pack_place(lab.move(name, requests.unpack_destination(destination)))
    except FieldkitError as error:
        return requests.pack_error(error)


def _overview(lab: Lab) -> bytes:
    """Return the answer to `overview`: the plan view of the lab, or the error that prevents it."""
    try:
        return requests.pack_overview(lab.overview())
    except FieldkitError as error:
        return requests.pack_error(error)


def _state(lab: Lab, up_s: float) -> bytes:
    """Return the answer to `state`: the state of the lab, or the error that prevents it."""
    try:
        return requests.pack_state(LabState(os.getpid(), up_s, tuple(_robot_states(lab)), lab.lateness()))
    except FieldkitError as error:
        return requests.pack_error(error)


def _robot_states(lab: Lab) -> Iterator[RobotState]:
    return (
        RobotState(
            name=name,
            profile=member.profile.name,
            roles=member.roles,
            address=member.address,
            place_m=lab.place_m(name),
            programs=lab.programs(name),
        )
        for name, member in lab.members.items()
    )


_CONNECT: Final = Path(__file__).with_name("connect.py")


def write_ssh_config(folder: LabFolder, login: Login) -> None:
    """Write three files into the lab's folder: private key, host keys and ssh configuration.

    New files are readable for this user only.
    """
    hosts = "".join(f"{name} {key}\n" for name, key in login.host_keys.items())
    for path, text in (
        (folder.key, login.private_key),
        (folder.known_hosts, hosts),
        (folder.ssh_config, ssh_config(folder, login.user, login.host_keys)),
    ):
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            file.write(text)


def ssh_config(folder: LabFolder, user: str, robots: Iterable[str]) -> str:
    """Return a configuration for `ssh -F`: robots by name, with pinned host keys, connected by `connect.py`."""
    # -I ignores modules in the current directory and Python's environment variables.
    words = (sys.executable, "-I", str(_CONNECT), str(folder.socket))
    command = shlex.join(words).replace("%", "%%")
    return f"""\
Host {" ".join(robots)}
    User {user}
    IdentityFile "{folder.key}"
    IdentitiesOnly yes
    IdentityAgent none
    UserKnownHostsFile "{folder.known_hosts}"
    GlobalKnownHostsFile none
    StrictHostKeyChecking yes
    UpdateHostKeys no
    ProxyCommand {command} %n
    ProxyUseFdpass yes
"""
