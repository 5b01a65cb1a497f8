"""The namespaces of a node: the command that makes them, and what an ordinary user needs to be allowed to."""

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
# Root inside is this user outside; the other accounts inside, which sshd and tcpdump change to, are its subordinates.
_AS_ROOT_INSIDE: Final = ("--user", "--map-root-user", "--map-auto")
# Without the subordinates first: where the kernel refuses, unshare would leave the process behind that maps them.
_PROBES: Final = (("--user", "--map-root-user"), _AS_ROOT_INSIDE)

_SUBORDINATES: Final = 65534
"""Ids that a node needs beside root's: up to that of `nobody`."""
_USUAL_SUBORDINATES: Final = 65536
_FIRST_SUBORDINATE: Final = 100_000
"""The first that useradd gives (SUB_UID_MIN of login.defs)."""

_OPTION_OF: Final = {"/etc/subuid": "--add-subuids", "/etc/subgid": "--add-subgids"}
"""Option of usermod per file that says whose the subordinate ids are."""

_SWITCHES: Final = {
    "kernel.unprivileged_userns_clone": ("0", "1"),
    "kernel.apparmor_restrict_unprivileged_userns": ("1", "0"),
    "user.max_user_namespaces": ("0", "10000"),
}
"""Settings of a kernel (Debian's, Ubuntu's, any) by which it forbids user namespaces, and by which it allows them."""

_TIMEOUT_S: Final = 10.0


@dataclass(frozen=True)
class IdRange:
    """A line of `/etc/subuid` or `/etc/subgid`.

    Attributes:
        owner: Name or id of the user whose they are.
        first: The first id.
        count: How many there are.
    """

    owner: str
    first: int
    count: int


def command() -> tuple[str, ...]:
    """Return the command that runs another as root in namespaces of its own, which end with it."""
    return _command(() if is_root() else _AS_ROOT_INSIDE)


def is_root() -> bool:
    """Return whether this user needs nobody's leave."""
    return os.geteuid() == 0


def check() -> None:
    """Check that this ordinary user can have namespaces, by making them.

    Raises:
        ConfigurationError: It has no subordinate ids, or the kernel forbids it.
    """
    uid = os.geteuid()
    try:
        user = pwd.getpwuid(uid).pw_name
    except KeyError as error:
        raise ConfigurationError(f"user {uid} has no account", remedy=f"sudo useradd --uid {uid} NAME") from error
    _check_subordinates(user, uid)
    for as_root in _PROBES:
        argv = _command(as_root, "true")
        done = subprocess.run(
            argv, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False, env={"PATH": PATH}
        )
        if done.returncode != 0:
            raise _refused(user, done.stderr.strip())


def forbidding(settings: Path) -> dict[str, str]:
    """Return the kernel settings below `settings` that forbid user namespaces, as `name = value`, with the remedy."""
    found = {}
    for name, (forbids, allows) in _SWITCHES.items():
        path = settings / name.replace(".", "/")
        if path.exists() and path.read_text(encoding="ascii").strip() == forbids:
            found[f"{name} = {forbids}"] = f"sudo sysctl {name}={allows}"
    return found


def id_ranges(text: str) -> list[IdRange]:
    """Return the ranges in the text of a file of subordinate ids; a line that is none gives nobody anything."""
    lines = re.findall(r"^([^:\n]+):(\d+):(\d+)$", text, re.MULTILINE | re.ASCII)
    return [IdRange(owner, int(first), int(count)) for owner, first, count in lines]


def _check_subordinates(user: str, uid: int) -> None:
    given = {path: id_ranges(_text(Path(path))) for path in _OPTION_OF}
    enough = {
        path: any(ids.owner in {user, str(uid)} and ids.count >= _SUBORDINATES for ids in ranges)
        for path, ranges in given.items()
    }
    if all(enough.values()):
        return
    lacking = [path for path in given if not enough[path]]
    taken = (ids.first + ids.count for ranges in given.values() for ids in ranges)
    first = max((_FIRST_SUBORDINATE, *taken))
    options = " ".join(f"{_OPTION_OF[path]} {first}-{first + _USUAL_SUBORDINATES - 1}" for path in lacking)
    raise ConfigurationError(
        f"{user} has no {_SUBORDINATES} subordinate ids in {' and '.join(lacking)}",
        remedy=f"sudo usermod {options} {user}",
    )


def _refused(user: str, cause: str) -> ConfigurationError:
    for name, remedy in forbidding(Path("/proc/sys")).items():
        return ConfigurationError(f"the kernel forbids user namespaces: {name}", remedy=remedy)
    return ConfigurationError(f"{user} gets no namespaces: {cause}", remedy="run it by sudo, or see man newuidmap")


def _command(as_root: tuple[str, ...], *words: str) -> tuple[str, ...]:
    return ("unshare", *as_root, *_NAMESPACES, "--fork", "--kill-child", "--", *words)


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8", errors="replace") if path.exists() else ""
