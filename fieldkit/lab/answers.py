"""The messages between the lab's process and other commands: one JSON document each way."""

import json
from dataclasses import dataclass
from typing import Final

from fieldkit.config.schema import Codec
from fieldkit.core.errors import ConfigurationError, FieldkitError, LinkError
from fieldkit.core.model import Vector
from fieldkit.lab.protocol import Destination, Overview

_FAMILIES: Final = {family.__name__: family for family in (ConfigurationError, LinkError)}


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
        up_s: Time since it has been up.
        robots: Its robots.
    """

    pid: int
    up_s: float
    robots: tuple[RobotState, ...]


@dataclass(frozen=True)
class _Place:
    place_m: Vector


@dataclass(frozen=True)
class _Refusal:
    error: str
    what: str
    remedy: str


_STATE: Final = Codec(LabState)
_OVERVIEW: Final = Codec(Overview)
_DESTINATION: Final = Codec(Destination)
_PLACE: Final = Codec(_Place)
_REFUSAL: Final = Codec(_Refusal)


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
    """Return an error as JSON, which the client raises."""
    family = type(error).__name__ if type(error).__name__ in _FAMILIES else LinkError.__name__
    return json.dumps(_REFUSAL.dump(_Refusal(family, error.what, error.remedy))).encode()


def state(answer: bytes) -> LabState:
    """Return the state in an answer.

    Raises:
        FieldkitError: The answer is an error.
        ValueError: The answer is invalid.
    """
    return _STATE.parse(_read(answer))


def place_m(answer: bytes) -> Vector:
    """Return the position in an answer; raises as `state`."""
    return _PLACE.parse(_read(answer)).place_m


def overview(answer: bytes) -> Overview:
    """Return the plan view of the lab in an answer; raises as `state`."""
    return _OVERVIEW.parse(_read(answer))


def destination(request: str) -> Destination:
    """Return the destination in a request.

    Raises:
        ValueError: The request is invalid.
    """
    return _DESTINATION.parse(json.loads(request))


def _read(answer: bytes) -> object:
    content = json.loads(answer)
    if isinstance(content, dict) and "error" in content:
        refusal = _REFUSAL.parse(content)
        raise _FAMILIES.get(refusal.error, LinkError)(refusal.what, remedy=refusal.remedy)
    return content
