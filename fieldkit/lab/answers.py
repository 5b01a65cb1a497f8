"""What the lab's process and other commands say to each other: one JSON document each way."""

import json
from dataclasses import asdict, dataclass
from typing import Any, Final

from fieldkit.core.errors import ConfigurationError, FieldkitError, LinkError
from fieldkit.core.geometry import Position
from fieldkit.lab.protocol import Destination, LabLink, Outline, Overview

_FAMILIES: Final = {family.__name__: family for family in (ConfigurationError, LinkError)}


@dataclass(frozen=True)
class RobotState:
    """What a robot of a lab is doing.

    Attributes:
        name: Its name.
        profile: Name of its profile.
        roles: What it plays in trials.
        address: Its address on the radio.
        place_m: Where its antenna is, metres east, north, up.
        programs: What runs on it; nothing when it has ended.
    """

    name: str
    profile: str
    roles: tuple[str, ...]
    address: str
    place_m: Position
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


def pack(what: LabState | Overview | Destination) -> bytes:
    """Return one of these as JSON."""
    return json.dumps(asdict(what)).encode()


def pack_place(place_m: Position) -> bytes:
    """Return a place as JSON."""
    return json.dumps({"place_m": place_m}).encode()


def pack_error(error: FieldkitError) -> bytes:
    """Return an error as JSON, for whoever asked to raise."""
    family = type(error).__name__ if type(error).__name__ in _FAMILIES else LinkError.__name__
    return json.dumps({"error": family, "what": error.what, "remedy": error.remedy}).encode()


def state(answer: bytes) -> LabState:
    """Return the state in an answer; raises as `place_m`."""
    found = _read(answer)
    robots = (
        RobotState(
            **row
            | {
                "roles": tuple(row["roles"]),
                "place_m": tuple(row["place_m"]),
                "programs": tuple(row["programs"]),
            }
        )
        for row in found["robots"]
    )
    return LabState(found["pid"], found["up_s"], tuple(robots))


def place_m(answer: bytes) -> Position:
    """Return the place in an answer.

    Raises:
        FieldkitError: The error that it has instead.
        ValueError: It is no such answer.
    """
    east_m, north_m, up_m = _read(answer)["place_m"]
    return east_m, north_m, up_m


def overview(answer: bytes) -> Overview:
    """Return the lab from above in an answer; raises as `place_m`."""
    found = _read(answer)
    return Overview(
        world=found["world"],
        area_m=tuple(found["area_m"]),
        outlines=[Outline(one["material"], tuple(map(tuple, one["corners"]))) for one in found["outlines"]],
        robots={name: tuple(place) for name, place in found["robots"].items()},
        links=[
            LabLink(tuple(one["ends"]), one["snr_db"], one["linked"], tuple(one["through"])) for one in found["links"]
        ],
    )


def destination(request: str) -> Destination:
    """Return the destination in a request.

    Raises:
        TypeError, ValueError: It is none.
    """
    return Destination(**json.loads(request))


def _read(answer: bytes) -> Any:  # noqa: ANN401 (JSON)
    found = json.loads(answer)
    if "error" in found:
        raise _FAMILIES[found["error"]](found["what"], remedy=found["remedy"])
    return found
