"""Routing daemon of robots that forward for each other, and of the laptop: Debian's babeld (Babel, RFC 8966)."""

import shutil
from ipaddress import IPv4Interface
from pathlib import Path
from typing import Final

from sim_backends.emulated.robot.spec import STATE

PID: Final = Path(STATE, "babeld.pid")
"""Written when the daemon has its socket and its interface, before its first hello."""

_LONG_TERM_STATE: Final = f"{STATE}/babel-state"


def command(interface: str, address: str, hello_s: float) -> tuple[str, ...]:
    """Return the command of the routing daemon of a robot; other settings are babeld's defaults.

    Args:
        interface: The radio interface. It is declared wireless, because a TAP device has no wireless extensions.
        address: The robot's address with the prefix length; each robot announces its own address as a host route.
        hello_s: Hello interval.
    """
    return (*_program(str(PID), _LONG_TERM_STATE), *_settings(interface, address, hello_s), interface)


def guest_command(interface: str, address: str, hello_s: float) -> tuple[str, ...]:
    """Return the command of a node that uses the robots' routes, and announces only the route to itself.

    The daemon writes no files. Arguments as `command`.
    """
    filters = (f"out ip {IPv4Interface(address).ip}/32 allow", "out deny")
    return (*_program("", ""), *_settings(interface, address, hello_s, *filters), interface)


def _program(pid: str, long_term_state: str) -> tuple[str, ...]:
    return (shutil.which("babeld") or "/usr/sbin/babeld", "-I", pid, "-S", long_term_state)


def _settings(interface: str, address: str, hello_s: float, *more: str) -> tuple[str, ...]:
    settings = (
        f"interface {interface} type wireless hello-interval {hello_s:g}",
        f"redistribute local ip {IPv4Interface(address).network} allow",
        "redistribute local deny",
        *more,
    )
    return tuple(word for setting in settings for word in ("-C", setting))
