"""Passwords, from a person at the terminal or the system's keyring; never in a file. The only user of keyring."""

import getpass
import shutil
import sys
from collections.abc import Callable
from typing import Final

from fieldkit.core.errors import ConfigurationError, typed

SERVICE: Final = "fieldkit"

Ask = Callable[[str, str, str], str]
"""Returns the password of a user on a host, which is a robot's."""


def at_terminal(user: str, host: str, robot: str) -> str:
    """Return the password that a person types, unseen.

    Raises:
        ConfigurationError: There is no terminal to ask at.
    """
    if not sys.stdin.isatty():
        raise ConfigurationError(
            f"the password of {user}@{host} must be typed, and there is no terminal to ask at",
            where=robot,
            remedy=f"{_store(user, host)}, and write `password: keyring`; or use a key",
        )
    return getpass.getpass(f"password of {user}@{host} ({robot}): ")


def in_keyring(user: str, host: str, robot: str) -> str:
    """Return the password that the keyring has.

    Raises:
        ConfigurationError: It has none, or there is no keyring.
    """
    import keyring  # noqa: PLC0415 (50 ms, which `fieldkit stop` has no time for)
    import keyring.errors  # noqa: PLC0415

    try:
        password = keyring.get_password(SERVICE, f"{user}@{host}")
    except keyring.errors.KeyringError as error:
        raise ConfigurationError(
            f"the keyring cannot be read: {error}", where=robot, remedy="write `password: ask`, or use a key"
        ) from error
    if password is None:
        raise ConfigurationError(
            f"the keyring has no password of {user}@{host}", where=robot, remedy=_store(user, host)
        )
    return password


def _store(user: str, host: str) -> str:
    """Return what stores a password; an environment of its own, as pipx makes them, is on no path."""
    program = ("keyring",) if shutil.which("keyring") else (sys.executable, "-m", "keyring")
    return typed(*program, "set", SERVICE, f"{user}@{host}")
