"""Passwords from the terminal or the system's keyring, never from a file. Only this module imports keyring."""

import getpass
import shutil
import sys
from collections.abc import Callable
from typing import Final

from fieldkit.core.errors import ConfigurationError, shell_command

SERVICE: Final = "fieldkit"

PasswordSource = Callable[[str, str, str], str]
"""Returns a password; the arguments are the user, the host, and the name of the robot."""


def read_from_terminal(user: str, host: str, robot: str) -> str:
    """Return the password that the operator types, without echo.

    Raises:
        ConfigurationError: Standard input is not a terminal.
    """
    if not sys.stdin.isatty():
        raise ConfigurationError(
            f"the password of {user}@{host} must be typed, but standard input is not a terminal",
            where=robot,
            remedy=f"{_store_command(user, host)}, and write `password: keyring`; or use a key",
        )
    return getpass.getpass(f"password of {user}@{host} ({robot}): ")


def read_from_keyring(user: str, host: str, robot: str) -> str:
    """Return the password from the keyring.

    Raises:
        ConfigurationError: The keyring has no such password, or there is no keyring.
    """
    import keyring  # noqa: PLC0415 (takes 50 ms, which would delay `fieldkit stop`)
    import keyring.errors  # noqa: PLC0415

    try:
        password = keyring.get_password(SERVICE, f"{user}@{host}")
    except keyring.errors.KeyringError as error:
        raise ConfigurationError(
            f"the keyring cannot be read: {error}", where=robot, remedy="write `password: ask`, or use a key"
        ) from error
    if password is None:
        raise ConfigurationError(
            f"the keyring has no password for {user}@{host}", where=robot, remedy=_store_command(user, host)
        )
    return password


def _store_command(user: str, host: str) -> str:
    """Return the command that stores a password; in an environment of pipx, `keyring` is not on the PATH."""
    program = ("keyring",) if shutil.which("keyring") else (sys.executable, "-m", "keyring")
    return shell_command(*program, "set", SERVICE, f"{user}@{host}")
