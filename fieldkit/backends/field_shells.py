"""SSH connections to the robots of a site file.

This module imports neither pydantic nor profiles, so that `fieldkit stop` starts quickly.
"""

from collections.abc import Callable
from typing import Protocol

from fieldkit.remote import passwords
from fieldkit.remote.keys import read_private_key
from fieldkit.remote.sockets import over_tcp
from fieldkit.remote.ssh import RECONNECT_TIMEOUT_S, SshShell


class SshAccess(Protocol):
    """SSH access data of a robot: a `SiteRobot` or a `RobotAccess`."""

    @property
    def host(self) -> str | None:
        """Host name or address; None only for an emulated robot."""
        ...

    @property
    def port(self) -> int:
        """SSH port."""
        ...

    @property
    def user(self) -> str | None:
        """Login name; None only for an emulated robot."""
        ...

    @property
    def host_key(self) -> str | None:
        """Pinned host key; None only for an emulated robot."""
        ...

    @property
    def key(self) -> str | None:
        """Path of the private key; None for a key of the SSH agent, or for a password."""
        ...

    @property
    def password(self) -> str | None:
        """Source of the password: `ask` or `keyring`; None without a password."""
        ...


def find_password(
    name: str, access: SshAccess, ask: passwords.PasswordSource = passwords.read_from_terminal
) -> str | None:
    """Return the password of a robot from the source in its access data; None if it needs no password.

    Args:
        name: Name of the robot.
        access: Its SSH access data.
        ask: Requests the password from the operator.

    Raises:
        ConfigurationError: The password cannot be requested, or the keyring does not have it.
    """
    source = access.password
    if source is None:
        return None
    read_password = ask if source == "ask" else passwords.read_from_keyring
    return read_password(access.user or "", access.host or "", name)


def open_shell(
    name: str,
    access: SshAccess,
    password: str | None,
    *,
    reconnect_timeout_s: float = RECONNECT_TIMEOUT_S,
    on_notice: Callable[[str], None] = lambda _: None,
    crosses_radio: bool = False,
) -> SshShell:
    """Return the connection to a robot, which is opened at its first use.

    Args:
        name: Name of the robot.
        access: Its SSH access data.
        password: Its password; None if it needs no password.
        reconnect_timeout_s: Time after a loss during which attempts to reopen the connection are made.
        on_notice: Called with a line of text when the connection is lost or restored.
        crosses_radio: Whether the connection crosses the radio under test.

    Raises:
        ConfigurationError: The private key cannot be used, or the host key is not valid.
    """
    host = access.host or ""
    return SshShell(
        name,
        connect=over_tcp(host, access.port),
        user=access.user or "",
        host_key=access.host_key or "",
        private_key=None if access.key is None else read_private_key(access.key, where=name),
        password=password,
        host=host,
        port=access.port,
        reconnect_timeout_s=reconnect_timeout_s,
        on_notice=on_notice,
        crosses_radio=crosses_radio,
    )
