"""Linux namespaces of a node: the command that creates them, and the permissions that an ordinary user needs."""

import os
import pwd
import re
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fieldkit.core.errors import ConfigurationError
from sim_backends.emulated.process.worker import PATH

_NAMESPACES: Final = ("--net", "--mount", "--propagation", "private", "--pid", "--uts", "--ipc")
# Outside of the namespaces, their root has the id of this user, and their other accounts (of sshd and tcpdump) have
# subordinate ids.
_AS_ROOT_INSIDE: Final = ("--user", "--map-root-user", "--map-auto")
# The first probe uses no subordinate ids, because `unshare --map-auto` leaves processes running if the kernel
# refuses.
_PROBES: Final = (("--user", "--map-root-user"), _AS_ROOT_INSIDE)

_SUBORDINATES: Final = 65534
"""Number of subordinate ids that a node needs: one for each id from 1 to that of the account `nobody`, 65534."""
_USUAL_SUBORDINATES: Final = 65536
"""Number of subordinate ids that useradd assigns to a user (SUB_UID_COUNT of login.defs)."""
_FIRST_SUBORDINATE: Final = 100_000
"""The first subordinate id that useradd assigns (SUB_UID_MIN of login.defs)."""

_OPTION_OF: Final = {"/etc/subuid": "--add-subuids", "/etc/subgid": "--add-subgids"}
"""Option of usermod for each file of subordinate ids."""

_KERNEL_SETTINGS: Final = {
    "kernel.unprivileged_userns_clone": ("0", "1"),
    "kernel.apparmor_restrict_unprivileged_userns": ("1", "0"),
    "user.max_user_namespaces": ("0", "10000"),
}
"""Kernel settings (of Debian, of Ubuntu, of any system) with the value that forbids user namespaces, and a value that
allows them."""

_TIMEOUT_S: Final = 10.0
"""Timeout of a probe."""


@dataclass(frozen=True)
class IdRange:
    """A line of `/etc/subuid` or `/etc/subgid`.

    Attributes:
        owner: Name or id of the user who owns the ids.
        first: The first id.
        count: Number of ids.
    """

    owner: str
    first: int
    count: int


def command() -> tuple[str, ...]:
    """Return the prefix that runs a command as root in new namespaces; their processes exit with the command."""
    return _command(() if is_root() else _AS_ROOT_INSIDE)


def is_root() -> bool:
    """Return True if this user is root, which needs no further permissions."""
    return os.geteuid() == 0


def check() -> None:
    """Check that this ordinary user can create namespaces, by creating them.

    Raises:
        ConfigurationError: The user has no account or too few subordinate ids, or the kernel forbids namespaces.
    """
    uid = os.geteuid()
    try:
        user = pwd.getpwuid(uid).pw_name
    except KeyError as error:
        raise ConfigurationError(f"user {uid} has no account", remedy=f"sudo useradd --uid {uid} NAME") from error
    _check_subordinates(user, uid)
    for user_options in _PROBES:
        argv = _command(user_options, "true")
        result = subprocess.run(
            argv, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False, env={"PATH": PATH}
        )
        if result.returncode != 0:
            raise _refusal(user, result.stderr.strip())


def forbidding_settings(settings: Path) -> dict[str, str]:
    """Return the remedies for kernel settings that forbid user namespaces, each by its setting, `name = value`.

    Args:
        settings: Folder of the kernel settings, `/proc/sys`.
    """
    remedies = {}
    for name, (forbids, allows) in _KERNEL_SETTINGS.items():
        path = settings / name.replace(".", "/")
        if path.exists() and path.read_text(encoding="ascii").strip() == forbids:
            remedies[f"{name} = {forbids}"] = f"sudo sysctl {name}={allows}"
    return remedies


def id_ranges(text: str) -> list[IdRange]:
    """Return the ranges in the text of a file of subordinate ids; malformed lines are ignored."""
    lines = re.findall(r"^([^:\n]+):(\d+):(\d+)$", text, re.MULTILINE | re.ASCII)
    return [IdRange(owner, int(first), int(count)) for owner, first, count in lines]


def _check_subordinates(user: str, uid: int) -> None:
    """Raise ConfigurationError if a file has no range of this user with enough subordinate ids."""
    ranges_by_file = {path: id_ranges(_text(Path(path))) for path in _OPTION_OF}
    has_enough = {
        path: any(ids.owner in {user, str(uid)} and ids.count >= _SUBORDINATES for ids in ranges)
        for path, ranges in ranges_by_file.items()
    }
    if all(has_enough.values()):
        return
    insufficient = [path for path in ranges_by_file if not has_enough[path]]
    next_free = (ids.first + ids.count for ranges in ranges_by_file.values() for ids in ranges)
    first = max((_FIRST_SUBORDINATE, *next_free))
    options = " ".join(f"{_OPTION_OF[path]} {first}-{first + _USUAL_SUBORDINATES - 1}" for path in insufficient)
    raise ConfigurationError(
        f"{user} has no {_SUBORDINATES} subordinate ids in {' and '.join(insufficient)}",
        remedy=f"sudo usermod {options} {user}",
    )


def _refusal(user: str, cause: str) -> ConfigurationError:
    for name, remedy in forbidding_settings(Path("/proc/sys")).items():  # only the first one is reported
        return ConfigurationError(f"the kernel forbids user namespaces: {name}", remedy=remedy)
    return ConfigurationError(f"{user} cannot create namespaces: {cause}", remedy="use sudo, or see man newuidmap")


def _command(user_options: tuple[str, ...], *words: str) -> tuple[str, ...]:
    return ("unshare", *user_options, *_NAMESPACES, "--fork", "--kill-child", "--", *words)


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8", errors="replace") if path.exists() else ""
