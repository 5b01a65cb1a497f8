"""Log in to a robot within a deadline. Each failure is reported with a command that helps to find the cause."""

import contextlib
import errno
import socket
import threading
from collections.abc import Iterator
from typing import Final

from fieldkit.core.deadline import Deadline, call_with_deadline
from fieldkit.core.errors import FieldkitError, LinkError, LinkLostError, RobotError
from fieldkit.remote.identity import Address, Credentials, HostKey
from fieldkit.remote.link import BROKEN, Link, UnfitServerError
from fieldkit.remote.sockets import Connect, Timing

_NO_ROUTE: Final = {errno.EHOSTUNREACH, errno.ENETUNREACH, errno.EHOSTDOWN, errno.ENETDOWN}


def log_in(
    address: Address,
    connect: Connect,
    credentials: Credentials,
    *,
    timing: Timing,
    deadline: Deadline,
    close_event: threading.Event,
) -> Link:
    """Return a connection that is logged in; the caller can set `close_event` to cancel the login.

    Raises:
        LinkLostError: The robot was not reached, or did not answer before the deadline.
        LinkError: `close_event` was set.
        RobotError: Its host key is not the pinned one, or its SSH server is not secure enough.
        LoginRefusedError: It refused the login.
        ConfigurationError: There is no key for the login.
    """
    link = Link(connect, timing)
    with _converting_errors(link, address, close_event):
        call_with_deadline(lambda: link.log_in(address, credentials), deadline, close_event)
    return link


def read_host_key(address: Address, connect: Connect, *, deadline: Deadline, kind: str = "ssh-ed25519") -> HostKey:
    """Return the host key of a server without a login, of type `kind` if it has one.

    Raises:
        LinkLostError: The robot was not reached, or did not answer before the deadline.
        RobotError: Its SSH server supports only insecure algorithms, or violates the protocol.
    """
    link, no_event = Link(connect, Timing()), threading.Event()
    with _converting_errors(link, address, no_event), contextlib.closing(link):
        return call_with_deadline(lambda: link.exchange_keys(kind), deadline, no_event)


@contextlib.contextmanager
def _converting_errors(link: Link, address: Address, close_event: threading.Event) -> Iterator[None]:
    """Close a link that could not be opened, and convert its exception to an error with a remedy.

    Raises the errors that `log_in` describes; exceptions that are not of a broken connection are not converted.
    """
    try:
        yield
    except BaseException as error:
        link.close()
        if isinstance(error, FieldkitError) or not isinstance(error, BROKEN):
            raise
        if close_event.is_set():
            raise closed_error(address) from error
        if isinstance(error, UnfitServerError):
            raise RobotError(
                f"its SSH server is not secure enough for a login: {error}",
                where=address.robot,
                remedy=f"update it; `ssh -vv {address.ssh_arguments} true` shows what it offers",
            ) from error
        what, remedy = _explanation(error, link.awaited_action, address)
        raise LinkLostError(what, where=address.robot, remedy=remedy) from error


def closed_error(address: Address) -> LinkError:
    """Return the error of a wait that `close` ended."""
    return LinkError("fieldkit closed the connection", where=address.robot)


def _explanation(error: BaseException, awaited_action: str, address: Address) -> tuple[str, str]:
    """Return the message of an error, and its remedy."""
    host = address.host
    unreachable = f"{host} cannot be reached for SSH"
    if isinstance(error, socket.gaierror):
        return (
            f"{unreachable}: its name cannot be resolved",
            f"getent hosts {host}; is `host` right in the site file?",
        )
    if isinstance(error, ConnectionRefusedError):
        remedy = "start its SSH server (Debian: sudo systemctl start ssh); is `port` right in the site file?"
        return f"{unreachable}: nothing listens on port {address.port}", remedy
    if isinstance(error, OSError) and error.errno in _NO_ROUTE:
        return (
            f"{unreachable}: there is no route to it",
            f"ip route get {host}; is this computer in the robots' network?",
        )
    if isinstance(error, TimeoutError):
        command = f"ping -c 3 {host}" if awaited_action == Link.FIRST_ACTION else f"ssh -v {address.ssh_arguments}"
        return f"{host} did not {awaited_action} in time", f"{command}; is the robot up and in range?"
    if awaited_action == Link.FIRST_ACTION:
        return f"{unreachable}: {error}", f"ping -c 3 {host}; is the robot up and in range?"
    return (
        f"{host} broke the connection before it could {awaited_action}: {_text(error)}",
        f"ssh -v {address.ssh_arguments}",
    )


def _text(error: BaseException) -> str:
    return str(error) or type(error).__name__
