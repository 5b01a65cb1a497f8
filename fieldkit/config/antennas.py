"""Antenna of a robot's radio, for the emulated radio: the keys of `radio.antenna`."""

from itertools import pairwise
from typing import Annotated, Final, Literal

from fieldkit.config import schema
from fieldkit.config.schema import Field, Int, Number, Strict

_Number = Number | Int
_Angle = Annotated[_Number, Field(ge=-360, le=360)]
_Gain = Annotated[_Number, Field(ge=-100, le=60)]

_KEYS: Final = {
    "dipole": ("axis",),
    "table": ("elevations_deg", "azimuths_deg", "gains_dbi", "orientation_deg"),
}
"""Keys of each pattern, which other patterns do not have."""


class AntennaOptions(Strict):
    """The antenna of a radio: its gain depends on the direction and on the attitude of the robot.

    Directions are relative to the robot's body: forward, left, up.

    Attributes:
        pattern: `isotropic`: 0 dBi in all directions. `dipole`: a half-wave dipole, whose gain is at least -30 dBi
            (an assumption: reflections at the robot fill the nulls). `table`: measured gains.
        axis: Pattern `dipole`: direction of its wire, forward, left, up.
        elevations_deg: Pattern `table`: elevations of the rows, ascending, -90 (down) to 90 (up).
        azimuths_deg: Pattern `table`: azimuths of the columns, ascending within one turn, from forward to the left.
            The default is one column for all azimuths.
        gains_dbi: Pattern `table`: a row for each elevation with a gain in dBi for each azimuth. Gains between them
            are interpolated.
        orientation_deg: Pattern `table`: roll (left side up), pitch (nose down) and yaw (to the left) of the antenna
            relative to the body.
    """

    pattern: Literal["isotropic", "dipole", "table"] = "isotropic"
    axis: tuple[_Number, _Number, _Number] = (0, 0, 1)
    elevations_deg: tuple[Annotated[_Number, Field(ge=-90, le=90)], ...] = ()
    azimuths_deg: Annotated[tuple[_Angle, ...], Field(min_length=1)] = (0,)
    gains_dbi: tuple[tuple[_Gain, ...], ...] = ()
    orientation_deg: tuple[_Angle, _Angle, _Angle] = (0, 0, 0)

    @schema.model_validator(mode="after")
    def _check_keys(self) -> "AntennaOptions":
        for pattern, keys in _KEYS.items():
            for key in keys:
                # Stored profiles contain all keys, so a default is valid with every pattern.
                if pattern != self.pattern and getattr(self, key) != type(self).model_fields[key].default:
                    raise schema.validation_error(
                        f"the pattern {self.pattern} has no {key}; write pattern: {pattern}, or remove {key}", key
                    )
        if not any(self.axis):
            raise schema.validation_error("the axis has no direction; write for example [0, 0, 1]", "axis")
        if self.pattern == "table":
            self._check_table()
        return self

    def _check_table(self) -> None:
        for key in ("elevations_deg", "azimuths_deg"):
            if any(later <= angle for angle, later in pairwise(getattr(self, key))):
                raise schema.validation_error(f"{key} must be ascending", key)
        if self.azimuths_deg[-1] - self.azimuths_deg[0] >= 360:
            raise schema.validation_error(
                "azimuths_deg must be within one turn; remove the last one, because the gains repeat", "azimuths_deg"
            )
        if not self.elevations_deg:
            raise schema.validation_error("the pattern table needs elevations_deg and gains_dbi", "pattern")
        rows, columns = len(self.elevations_deg), len(self.azimuths_deg)
        if len(self.gains_dbi) != rows or any(len(row) != columns for row in self.gains_dbi):
            raise schema.validation_error(
                f"gains_dbi needs {rows} rows (elevations_deg) with {columns} gains each (azimuths_deg)", "gains_dbi"
            )
