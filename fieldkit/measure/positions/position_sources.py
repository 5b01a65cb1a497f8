"""Sources of robots' positions, as stored in `positions.json` of an attempt or of a whole trial.

Steps that record the positions of robots write the attempt's file; `fieldkit positions` writes the trial's file. If
both files have a source for the same robot, the source in the trial's file is used.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import Any, Final

from fieldkit.core import laptop_files
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Role, Vector
from fieldkit.core.text import JSON_ERRORS
from fieldkit.measure.evidence import reading
from fieldkit.measure.positions.samples import PLACED
from fieldkit.measure.robot_clock import Offset

FILE: Final = laptop_files.POSITIONS
Place = tuple[float, float, float | None]
"""Metres along three axes, or latitude and longitude in degrees and height in metres; the height may be None."""
GAP_S: Final = 3.0
"""Default of the longest time between two samples over which a position is interpolated. With a satellite receiver
that reports once a second, two consecutive positions may be missing."""


@dataclass(frozen=True)
class PositionSource:
    """Source of one robot's position: a fixed place or a file.

    Attributes:
        place: Fixed place; None if a file is the source.
        frame: Frame of the place.
        file: Path, relative to the folder of `positions.json`, of a bag, telemetry log, GPX or CSV file.
        topic: Topic in a bag, or message type in a telemetry log.
        child: Child frame of the robot in a tree of transforms.
        stamps: `header` for the time stamps in messages, `received` for the recorder's times of reception.
        offset_s: Offset that is added to the times of a GPX or CSV file to convert them to the laptop's clock. Times
            in a bag are by the robot's clock.
        gap_s: Longest time between two samples over which the position is interpolated.
        start: Place of the robot at the start of the odometry.
        heading_rad: Heading at the start of the odometry, from the frame's first axis towards its second; None if
            unknown.
        began_utc_ns: Start of the odometry by the laptop's clock, nanoseconds since 1970 UTC.
        clock: Role of the robot whose clock gives the times; empty if this robot's clock gives them.
        system: MAVLink system ID of the autopilot in a telemetry log; 0 if the log has only one.
    """

    place: Place | None = None
    frame: str = PLACED
    file: str = ""
    topic: str = ""
    child: str = ""
    stamps: str = "header"
    offset_s: float = 0.0
    gap_s: float = GAP_S
    start: Vector = (0.0, 0.0, 0.0)
    heading_rad: float | None = None
    began_utc_ns: int = 0
    clock: str = ""
    system: int = 0

    @property
    def description(self) -> str:
        """Short text for reports: `/odom`, `positions-receiver.gpx`, `48.1, 11.5 in WGS 84` or `as placed`."""
        if self.place is None:
            return self.topic or self.file
        return (
            self.frame
            if self.frame == PLACED
            else f"{', '.join(f'{number:.9g}' for number in self.place if number is not None)} in {self.frame}"
        )


@dataclass(frozen=True)
class PositionSources:
    """Sources of the positions of several robots.

    Attributes:
        robots: Sources by role.
        clocks: Offsets of the robots' clocks from the laptop's, if they were measured.
        heights: True if the heights of places in degrees are used. Their errors are often 10 m.
    """

    robots: Mapping[Role, PositionSource] = field(default_factory=lambda: MappingProxyType({}))
    clocks: Mapping[Role, Offset] = field(default_factory=lambda: MappingProxyType({}))
    heights: bool = False


def merge(base: PositionSources, override: PositionSources) -> PositionSources:
    """Combine two sets of sources.

    For a robot in both sets, the source of `override` is used, unless it is only the planned placement.
    """
    robots = {**base.robots}
    for role, position_source in override.robots.items():
        if role not in robots or position_source.frame != PLACED or position_source.place is None:
            robots[role] = position_source
    return PositionSources(robots, {**base.clocks, **override.clocks}, base.heights or override.heights)


def is_valid(position_source: PositionSource) -> bool:
    """Return True if `read` accepts a source. It does not accept a number of 1e10 or more."""
    try:
        _record_from_json(PositionSource, json.loads(json.dumps(_changed_values(position_source))))
    except JSON_ERRORS:
        return False
    return True


def _changed_values(position_source: PositionSource) -> dict[str, Any]:
    """Return the values that differ from the defaults."""
    defaults = asdict(PositionSource())
    return {name: value for name, value in asdict(position_source).items() if value != defaults[name]}


def text(position_sources: PositionSources) -> str:
    """Return the sources as JSON. `read` accepts it if each source is valid."""
    robots = {role: _changed_values(position_source) for role, position_source in position_sources.robots.items()}
    clocks = {role: asdict(offset) for role, offset in position_sources.clocks.items()}
    return json.dumps({"robots": robots, "clocks": clocks, "heights": position_sources.heights}, indent=2) + "\n"


def read(path: Path) -> PositionSources:
    """Return the sources in a file.

    Raises:
        EvidenceError: The file is missing or was not written by `text`.
    """
    try:
        data = json.loads(reading.text(path))
        robots = {
            Role(role): _record_from_json(PositionSource, position_source)
            for role, position_source in data.pop("robots").items()
        }
        clocks = {Role(role): _record_from_json(Offset, offset) for role, offset in data.pop("clocks").items()}
        heights = data.pop("heights")
    except JSON_ERRORS as error:
        raise EvidenceError("is not a valid list of position sources", where=str(path)) from error
    if data or not isinstance(heights, bool):
        reason = "it has unknown keys" if data else "heights is not a boolean"
        raise EvidenceError(f"is not a valid list of position sources: {reason}", where=str(path))
    return PositionSources(robots, clocks, heights)


def _record_from_json(record: type[Any], values: Mapping[str, Any]) -> Any:  # noqa: ANN401 (an instance of the type)
    """Return an instance of the data class `record` from JSON values.

    Raises:
        ValueError: A value or key is invalid.
        TypeError: A value is missing.
    """
    checked_values = {
        field.name: _typed_value(field.type, values[field.name]) for field in fields(record) if field.name in values
    }
    parts = PurePosixPath(checked_values.get("file", "")).parts  # two parts are allowed: a ROS 2 bag is a folder
    if len(checked_values) < len(values) or len(parts) > 2 or {"..", "/"} & {*parts}:
        raise ValueError
    if clock := checked_values.get("clock"):
        Role(clock)  # raises ValueError if it is not a role
    return record(**checked_values)


def _typed_value(kind: Any, value: Any) -> Any:  # noqa: ANN401 (any JSON value)
    """Return a JSON value converted to the type `kind`; raises `ValueError` if it has another type or is too big."""
    if kind is str and isinstance(value, str):
        return value
    if kind is int and type(value) is int and 0 <= value < 2**62:
        return value
    if kind in {float, float | None} and type(value) in {int, float} and math.isfinite(value) and abs(value) < 1e10:
        return float(value)
    if kind in {Vector, Place | None} and isinstance(value, list) and len(value) == 3:
        if value[2] is None and kind is not Vector:
            return (_typed_value(float, value[0]), _typed_value(float, value[1]), None)
        return tuple(_typed_value(float, part) for part in value)
    raise ValueError
