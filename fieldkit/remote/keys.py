"""Private keys for the login: from a file that the site file names, or from the SSH agent."""

import io
from collections.abc import Sequence
from pathlib import Path

import paramiko

from fieldkit.core.errors import ConfigurationError, shell_command


def private_keys(text: str | None, *, where: str) -> Sequence[paramiko.PKey]:
    """Return the key in `text`, or the keys of the SSH agent if `text` is None.

    Raises:
        ConfigurationError: There is no key, or it cannot be used.
    """
    if text is not None:
        return (_parse_private_key(text, where=where),)
    if not (keys := paramiko.Agent().get_keys()):
        raise ConfigurationError(
            "the SSH agent has no key", where=where, remedy="ssh-add, or name `key:` in the site file"
        )
    return keys


def read_private_key(path: str, *, where: str) -> str:
    """Return the text of a private key file, after a check that the key can be used.

    Raises:
        ConfigurationError: It cannot be read, has a passphrase, or contains no supported key.
    """
    try:
        text = Path(path).expanduser().read_text(encoding="ascii")
    except (OSError, UnicodeDecodeError, RuntimeError) as error:  # RuntimeError: `~NAME` names an unknown user
        raise ConfigurationError(
            f"its key {path} cannot be read",
            where=where,
            remedy=f"{_key_command('ls -l', path)}; correct key: in the site file, or leave it out to use the agent",
        ) from error
    _parse_private_key(text, where=where, path=path)
    return text


def _key_command(command: str, path: str) -> str:
    """Return a shell command for a key file; `~/` is outside the quotes, so that the shell expands it."""
    home = "~/" if path.startswith("~/") else ""
    return f"{command} {home}{shell_command(path.removeprefix(home))}"


def _parse_private_key(text: str, *, where: str, path: str = "FILE") -> paramiko.PKey:
    for kind in (paramiko.Ed25519Key, paramiko.ECDSAKey, paramiko.RSAKey):
        try:
            return kind.from_private_key(io.StringIO(text))
        except paramiko.PasswordRequiredException as error:
            raise ConfigurationError(
                "its private key has a passphrase",
                where=where,
                remedy=f"{_key_command('ssh-add', path)}, and leave out key: in the site file",
            ) from error
        except (paramiko.SSHException, ValueError):
            continue
    raise ConfigurationError(
        "its private key cannot be used",
        where=where,
        remedy=f"use an ed25519 key: {_key_command('ssh-keygen -t ed25519 -f', f'{path}.new')}",
    )
