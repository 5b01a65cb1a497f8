"""Messages between the process of a lab and its client, and the client.

A request is a line of text, and its answer is one JSON document. The answer to the request `connect` of `connect.py`
is a socket instead, or the text of an error.
"""

import json
import os
import select
import signal
import socket
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final, TypeVar

from fieldkit.config.json_records import Codec
from fieldkit.core.errors import ConfigurationError, FieldkitError, LinkError
from fieldkit.core.model import Vector
from fieldkit.lab.folder import LabFolder
from fieldkit.lab.protocol import LabLateness, Overview
from fieldkit.lab.robots import Destination

_ERROR_CLASSES: Final = {error_class.__name__: error_class for error_class in (ConfigurationError, LinkError)}


@dataclass(frozen=True)
class RobotState:
    """State of a robot of a lab.

    Attributes:
        name: Its name.
        profile: Name of its profile.
        roles: Its roles in trials.
        address: Its address on the radio.
        place_m: Position of its antenna, metres east, north, up.
        programs: Names of the programs that run on it; empty if the robot has terminated.
    """

    name: str
    profile: str
    roles: tuple[str, ...]
    address: str
    place_m: Vector
    programs: tuple[str, ...]


@dataclass(frozen=True)
class LabState:
    """State of a lab.

    Attributes:
        pid: Process id.
        up_s: Time in seconds since the start of the lab was complete.
        robots: Its robots.
        lateness: Lateness of its co-simulation; None if the lab does not run on a co-simulation.
    """

    pid: int
    up_s: float
    robots: tuple[RobotState, ...]
    lateness: LabLateness | None = None


@dataclass(frozen=True)
class _Place:
    place_m: Vector


@dataclass(frozen=True)
class _ErrorAnswer:
    error: str
    what: str
    remedy: str


_STATE: Final = Codec(LabState)
_OVERVIEW: Final = Codec(Overview)
_DESTINATION: Final = Codec(Destination)
_PLACE: Final = Codec(_Place)
_ERROR_ANSWER: Final = Codec(_ErrorAnswer)


def pack_state(state: LabState) -> bytes:
    """Return the state of a lab as JSON."""
    return json.dumps(_STATE.dump(state)).encode()


def pack_overview(overview: Overview) -> bytes:
    """Return a plan view of a lab as JSON."""
    return json.dumps(_OVERVIEW.dump(overview)).encode()


def pack_destination(destination: Destination) -> str:
    """Return a destination as one line of JSON, for a request."""
    return json.dumps(_DESTINATION.dump(destination))


def pack_place(place_m: Vector) -> bytes:
    """Return a position as JSON."""
    return json.dumps(_PLACE.dump(_Place(place_m))).encode()


def pack_error(error: FieldkitError) -> bytes:
    """Return an error as JSON. The client raises it, as a `LinkError` if its class is not in `_ERROR_CLASSES`."""
    error_class = type(error).__name__ if type(error).__name__ in _ERROR_CLASSES else LinkError.__name__
    return json.dumps(_ERROR_ANSWER.dump(_ErrorAnswer(error_class, error.what, error.remedy))).encode()


def unpack_state(answer: bytes) -> LabState:
    """Return the state in an answer.

    Raises:
        FieldkitError: The answer is an error.
        ValueError: The answer is invalid.
    """
    return _STATE.parse(_parse_answer(answer))


def unpack_place_m(answer: bytes) -> Vector:
    """Return the position in an answer. Raises the same errors as `unpack_state`."""
    return _PLACE.parse(_parse_answer(answer)).place_m


def unpack_overview(answer: bytes) -> Overview:
    """Return the plan view of the lab in an answer. Raises the same errors as `unpack_state`."""
    return _OVERVIEW.parse(_parse_answer(answer))


def unpack_destination(request: str) -> Destination:
    """Return the destination in a request.

    Raises:
        ValueError: The request is invalid.
    """
    return _DESTINATION.parse(json.loads(request))


def _parse_answer(answer: bytes) -> object:
    """Return the JSON content of an answer, or raise the error that it contains."""
    content = json.loads(answer)
    if isinstance(content, dict) and "error" in content:
        error_answer = _ERROR_ANSWER.parse(content)
        raise _ERROR_CLASSES.get(error_answer.error, LinkError)(error_answer.what, remedy=error_answer.remedy)
    return content


Answer = TypeVar("Answer")

_REPLY_TIMEOUT_S: Final = 20.0
_EXIT_TIMEOUT_S: Final = 20.0
_NO_LAB: Final = "no lab is running in this directory"


class NoLabError(ConfigurationError):
    """No lab is running in the directory."""


def state(folder: LabFolder) -> LabState:
    """Return the state of the lab.

    Raises:
        NoLabError: The socket of a lab of this directory does not exist or does not accept connections, or the lab
            exited before it accepted this one.
        LinkError: The lab does not answer, its answer is invalid, or is another error than a `ConfigurationError`.
        ConfigurationError: The answer of the lab is this error.
    """
    return _request(folder, "state", unpack_state)


def overview(folder: LabFolder) -> Overview:
    """Return the current plan view of the lab; raises the same errors as `state`."""
    return _request(folder, "overview", unpack_overview)


def move(folder: LabFolder, robot: str, destination: Destination) -> Vector:
    """Move a robot instantly and return the new position of its antenna in metres.

    Raises:
        ConfigurationError: There is no such robot, or the destination is not in the world.
        FieldkitError: For the same reasons as `state`.
    """
    return _request(folder, f"move {robot} {pack_destination(destination)}", unpack_place_m)


def end(folder: LabFolder) -> None:
    """Terminate the lab's process with its robots; return when it has exited.

    If the process does not exit after SIGTERM, it is killed.

    Raises:
        NoLabError: No lab is running in this directory.
        LinkError: The process does not exit.
    """
    with _lab_connection(folder) as lab:
        # The kernel reports which process listens on the socket, so that no other process is killed.
        credentials = lab.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
        try:
            process = os.pidfd_open(struct.unpack("3i", credentials)[0])
        except ProcessLookupError as error:
            raise NoLabError(_NO_LAB, remedy="fieldkit lab up") from error
    try:
        for signal_number in (signal.SIGTERM, signal.SIGKILL):
            signal.pidfd_send_signal(process, signal_number)
            if select.select([process], [], [], _EXIT_TIMEOUT_S)[0]:
                return
    finally:
        os.close(process)
    raise LinkError("the lab does not exit, not even after SIGKILL", remedy="find the process that blocks it: ps axf")


def _request(folder: LabFolder, request: str, unpack: Callable[[bytes], Answer]) -> Answer:
    with _lab_connection(folder) as lab:
        try:
            lab.sendall(f"{request}\n".encode())
            # The lab closes the connection after its answer, so an empty chunk is the end.
            return unpack(b"".join(iter(lambda: lab.recv(1 << 16), b"")))
        except ConnectionError as error:
            # A lab reads each request before it closes the connection, so it exited before it accepted this one.
            raise NoLabError(_NO_LAB, remedy="fieldkit lab up") from error
        except (OSError, ValueError) as error:
            raise LinkError(f"the lab does not answer: {error}", remedy="fieldkit lab down") from error


@contextmanager
def _lab_connection(folder: LabFolder) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX) as lab:
        lab.settimeout(_REPLY_TIMEOUT_S)
        try:
            lab.connect(str(folder.socket))
        except OSError as error:
            raise NoLabError(_NO_LAB, remedy="fieldkit lab up") from error
        yield lab
