"""Accounts of where robots were: who tells it of each, as `positions.json` of an attempt or of a whole trial says.

Steps that follow robots write the former, `fieldkit positions` the latter, which counts where both tell of one robot.
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
from fieldkit.measure.offsets import Offset
from fieldkit.measure.positions.samples import PLACED

FILE: Final = laptop_files.POSITIONS
Place = tuple[float, float, float | None]
"""Metres along three axes, or degrees north and east and metres up; None where no height is told."""
GAP_S: Final = 3.0
"""Between samples further apart nobody knows where a robot was, unless somebody says another bound: a receiver of
satellites that tells its place once a second has missed two."""


@dataclass(frozen=True)
class Account:
    """Who tells where one robot was: a place in which it stood, or a file.

    Attributes:
        place: Where it stood; None where a file tells.
        frame: What the place is in.
        file: Beside `positions.json`: a bag, GPX, or CSV.
        topic: In a bag, what tells.
        child: In a tree of transforms, the robot's frame.
        stamps: `header`, messages say when they were true; `received`, they were when the recorder had them.
        offset_s: Added to the times of the file it makes them the laptop's; of a bag the robot's clock tells.
        gap_s: Longest time between two samples in which the robot went straight.
        start: Of odometry, where the robot was when it began.
        heading_rad: And where it faced, from the frame's first axis towards its second; None where nobody says.
        began_utc_ns: And when that was, by the laptop's clock.
        clock: Role of the robot by whose clock the times are; empty for the robot itself.
        system: In a telemetry log, the system id of the autopilot that tells; 0 for the only one.
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
    def in_words(self) -> str:
        """Who tells it: `/odom`, `positions-receiver.gpx`, `48.1, 11.5 in WGS 84`, `as placed`."""
        if self.place is None:
            return self.topic or self.file
        return (
            self.frame
            if self.frame == PLACED
            else f"{', '.join(f'{metres:.9g}' for metres in self.place if metres is not None)} in {self.frame}"
        )


@dataclass(frozen=True)
class Accounts:
    """Accounts of robots.

    Attributes:
        robots: By role.
        clocks: How far clocks of robots were ahead of the laptop's, where that was asked.
        heights: Whether heights over the ellipsoid count; they are often wrong by 10 m.
    """

    robots: Mapping[Role, Account] = field(default_factory=lambda: MappingProxyType({}))
    clocks: Mapping[Role, Offset] = field(default_factory=lambda: MappingProxyType({}))
    heights: bool = False


def merged(one: Accounts, other: Accounts) -> Accounts:
    """Return both together; of a robot of which both tell, the plan's placement counts least, and `other` most."""
    robots = {**one.robots}
    for role, account in other.robots.items():
        if role not in robots or account.frame != PLACED or account.place is None:
            robots[role] = account
    return Accounts(robots, {**one.clocks, **other.clocks}, one.heights or other.heights)


def text(accounts: Accounts) -> str:
    """Return accounts as `read` reads them."""
    usual = asdict(Account())
    robots = {
        role: {name: value for name, value in asdict(account).items() if value != usual[name]}
        for role, account in accounts.robots.items()
    }
    clocks = {role: asdict(offset) for role, offset in accounts.clocks.items()}
    return json.dumps({"robots": robots, "clocks": clocks, "heights": accounts.heights}, indent=2) + "\n"


def read(path: Path) -> Accounts:
    """Return the accounts in a file.

    Raises:
        EvidenceError: It is missing, or not what `text` writes.
    """
    try:
        data = json.loads(reading.text(path))
        robots = {Role(role): _made(Account, account) for role, account in data.pop("robots").items()}
        clocks = {Role(role): _made(Offset, offset) for role, offset in data.pop("clocks").items()}
        heights = data.pop("heights")
    except JSON_ERRORS as error:
        raise EvidenceError("does not say who tells where robots were", where=str(path)) from error
    if data or not isinstance(heights, bool):
        raise EvidenceError("says more than who tells where robots were", where=str(path))
    return Accounts(robots, clocks, heights)


def _made(record: type[Any], values: Mapping[str, Any]) -> Any:  # noqa: ANN401 (an instance of the type)
    """Return a record of plain JSON values.

    Raises:
        ValueError: They are not its own.
        TypeError: They lack one.
    """
    made = {field.name: _value(field.type, values[field.name]) for field in fields(record) if field.name in values}
    parts = PurePosixPath(made.get("file", "")).parts  # of ROS 2, a bag is a folder
    if len(made) < len(values) or len(parts) > 2 or {"..", "/"} & {*parts}:
        raise ValueError
    if clock := made.get("clock"):
        Role(clock)  # or it raises
    return record(**made)


def _value(kind: Any, value: Any) -> Any:  # noqa: ANN401 (any JSON value)
    """Return a value of a type, or raise `ValueError`."""
    if kind is str and isinstance(value, str):
        return value
    if kind is int and type(value) is int and 0 <= value < 2**62:
        return value
    if kind in {float, float | None} and type(value) in {int, float} and math.isfinite(value) and abs(value) < 1e10:
        return float(value)
    if kind in {Vector, Place | None} and isinstance(value, list) and len(value) == 3:
        if value[2] is None and kind is not Vector:
            return (_value(float, value[0]), _value(float, value[1]), None)
        return tuple(_value(float, part) for part in value)
    raise ValueError
