"""Client of a lab's process: request its state, move its robots, terminate it."""

import os
import select
import signal
import socket
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final, TypeVar

from fieldkit.core.errors import ConfigurationError, LinkError
from fieldkit.core.model import Vector
from fieldkit.lab import answers
from fieldkit.lab.answers import LabState
from fieldkit.lab.folder import LabFolder
from fieldkit.lab.protocol import Destination, Overview

Answer = TypeVar("Answer")

_REPLY_S: Final = 20.0
_END_S: Final = 20.0
_NO_LAB: Final = "this directory has no lab that is up"


class NoLabError(ConfigurationError):
    """The directory has no lab that is up."""


def state(folder: LabFolder) -> LabState:
    """Return the state of the lab.

    Raises:
        NoLabError: No lab is up.
        LinkError: It does not answer.
    """
    return _request(folder, "state", answers.state)


def overview(folder: LabFolder) -> Overview:
    """Return the current plan view of the lab. Errors as `state`."""
    return _request(folder, "overview", answers.overview)


def move(folder: LabFolder, robot: str, to: Destination) -> Vector:
    """Move a robot instantly and return the new position of its antenna in metres. Errors as `state`.

    Raises:
        ConfigurationError: There is no such robot, or the destination is not in the world.
    """
    return _request(folder, f"move {robot} {answers.pack_destination(to)}", answers.place_m)


def end(folder: LabFolder) -> None:
    """Terminate the lab's process with its robots; return when it has exited.

    Raises:
        NoLabError: No lab is up.
        LinkError: It does not exit.
    """
    with _connected(folder) as lab:
        # The kernel reports which process listens on the socket, so that no other process is killed.
        credentials = lab.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
        process = os.pidfd_open(struct.unpack("3i", credentials)[0])
    try:
        for number in (signal.SIGTERM, signal.SIGKILL):
            signal.pidfd_send_signal(process, number)
            if select.select([process], [], [], _END_S)[0]:
                return
    finally:
        os.close(process)
    raise LinkError("the lab does not exit, not even after SIGKILL", remedy="see what blocks it: ps axf")


def _request(folder: LabFolder, request: str, read: Callable[[bytes], Answer]) -> Answer:
    with _connected(folder) as lab:
        try:
            lab.sendall(f"{request}\n".encode())
            return read(b"".join(iter(lambda: lab.recv(1 << 16), b"")))
        except (OSError, ValueError) as error:
            raise LinkError(f"the lab does not answer: {error}", remedy="fieldkit lab down") from error


@contextmanager
def _connected(folder: LabFolder) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX) as lab:
        lab.settimeout(_REPLY_S)
        try:
            lab.connect(str(folder.socket))
        except OSError as error:
            raise NoLabError(_NO_LAB, remedy="fieldkit lab up") from error
        yield lab
