"""Requests of other commands to the lab of a directory, and its end."""

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
    """Return what the lab is doing.

    Raises:
        NoLabError: No lab is up.
        LinkError: It does not answer.
    """
    return _ask(folder, "state", answers.state)


def overview(folder: LabFolder) -> Overview:
    """Return the lab from above, as it is now. Errors as `state`."""
    return _ask(folder, "overview", answers.overview)


def move(folder: LabFolder, robot: str, to: Destination) -> Vector:
    """Put a robot elsewhere and return where its antenna is then. Errors as `state`.

    Raises:
        ConfigurationError: There is no such robot, or no such place.
    """
    return _ask(folder, f"move {robot} {answers.pack_destination(to)}", answers.place_m)


def end(folder: LabFolder) -> None:
    """End the lab's process and return when it is gone, its robots with it.

    Raises:
        NoLabError: No lab is up.
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


def _ask(folder: LabFolder, request: str, read: Callable[[bytes], Answer]) -> Answer:
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
