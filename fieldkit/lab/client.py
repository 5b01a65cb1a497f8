"""What other commands ask the lab of a directory, and its end."""

import json
import os
import select
import signal
import socket
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final

from fieldkit.errors import ConfigurationError, LinkError
from fieldkit.lab.folder import LabFolder

_REPLY_S: Final = 20.0
_END_S: Final = 20.0
_NO_LAB: Final = "this directory has no lab that is up"


@dataclass(frozen=True)
class RobotState:
    """What a robot of a lab is doing.

    Attributes:
        name: Its name.
        profile: Name of its profile.
        roles: What it plays in trials.
        address: Its address on the radio.
        programs: What runs on it; nothing when it has ended.
    """

    name: str
    profile: str
    roles: tuple[str, ...]
    address: str
    programs: tuple[str, ...]


@dataclass(frozen=True)
class LabState:
    """What a lab is doing.

    Attributes:
        pid: Its process.
        up_s: For how long it has been up.
        robots: Its robots.
    """

    pid: int
    up_s: float
    robots: tuple[RobotState, ...]


def state(folder: LabFolder) -> LabState:
    """Return what the lab is doing.

    Raises:
        ConfigurationError: No lab is up.
        LinkError: It does not answer.
    """
    with _connected(folder) as lab:
        try:
            lab.sendall(b"state\n")
            answer = json.loads(b"".join(iter(lambda: lab.recv(1 << 16), b"")))
        except (OSError, ValueError) as error:
            raise LinkError(f"the lab does not answer: {error}", remedy="fieldkit lab down") from error
    robots = (
        RobotState(**{**row, "roles": tuple(row["roles"]), "programs": tuple(row["programs"])})
        for row in answer["robots"]
    )
    return LabState(answer["pid"], answer["up_s"], tuple(robots))


def end(folder: LabFolder) -> None:
    """End the lab's process and return when it is gone, its robots with it.

    Raises:
        ConfigurationError: No lab is up.
        LinkError: It does not end.
    """
    with _connected(folder) as lab:
        # The kernel says who listens, so that no other process is ever ended in its place.
        credentials = lab.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
        process = os.pidfd_open(struct.unpack("3i", credentials)[0])
    try:
        for number in (signal.SIGTERM, signal.SIGKILL):
            signal.pidfd_send_signal(process, number)
            if select.select([process], [], [], _END_S)[0]:
                return
    finally:
        os.close(process)
    raise LinkError("the lab does not end, even when it is killed", remedy="look what holds it: ps axf")


@contextmanager
def _connected(folder: LabFolder) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX) as lab:
        lab.settimeout(_REPLY_S)
        try:
            lab.connect(str(folder.socket))
        except OSError as error:
            raise ConfigurationError(_NO_LAB, remedy="fieldkit lab up") from error
        yield lab
