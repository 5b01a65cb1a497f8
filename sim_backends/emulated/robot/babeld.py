"""The routing daemon of robots that forward for each other, and of the laptop: Debian's babeld (Babel, RFC 8966)."""

import shutil
from ipaddress import IPv4Interface
from pathlib import Path
from typing import Final

from sim_backends.emulated.robot.spec import STATE

PID: Final = Path(STATE, "babeld.pid")
"""Written when it has its socket and its interface, before its first hello."""

_LONG_TERM_STATE: Final = f"{STATE}/babel-state"


def command(interface: str, address: str, hello_s: float) -> tuple[str, ...]:
    """Return the command that routes over the radio; all else is as babeld has it by default.

    Args:
        interface: The radio, which babeld cannot know for one: a TAP device tells nothing of wireless extensions.
        address: The robot's address with the length of the network; each robot announces its own, as a host's.
        hello_s: How often it says hello to its neighbours.
    """
    return (*_program(str(PID), _LONG_TERM_STATE), *_said(interface, address, hello_s), interface)


def guest_command(interface: str, address: str, hello_s: float) -> tuple[str, ...]:
    """Return the command of who finds its way over others, and announces no way but the one to itself.

    It leaves no file behind. Arguments as `command`.
    """
    announced = (f"out ip {IPv4Interface(address).ip}/32 allow", "out deny")
    return (*_program("", ""), *_said(interface, address, hello_s, *announced), interface)


def _program(pid: str, long_term_state: str) -> tuple[str, ...]:
    return (shutil.which("babeld") or "/usr/sbin/babeld", "-I", pid, "-S", long_term_state)


def _said(interface: str, address: str, hello_s: float, *more: str) -> tuple[str, ...]:
    settings = (
        f"interface {interface} type wireless hello-interval {hello_s:g}",
        f"redistribute local ip {IPv4Interface(address).network} allow",
        "redistribute local deny",
        *more,
    )
    return tuple(word for setting in settings for word in ("-C", setting))
