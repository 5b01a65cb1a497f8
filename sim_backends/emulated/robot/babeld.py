"""The routing daemon of a robot that forwards for others: Debian's babeld, which speaks Babel (RFC 8966)."""

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
    network = IPv4Interface(address).network
    settings = (
        f"interface {interface} type wireless hello-interval {hello_s:g}",
        f"redistribute local ip {network} allow",
        "redistribute local deny",
    )
    said = (word for setting in settings for word in ("-C", setting))
    program = shutil.which("babeld") or "/usr/sbin/babeld"
    return (program, "-I", str(PID), "-S", _LONG_TERM_STATE, *said, interface)
