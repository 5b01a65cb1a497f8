"""Displacements in a procedure, such as `away: 5m`: segments of a path, and positions relative to another robot."""

import math
from typing import Annotated, ClassVar, Self

from fieldkit.config import schema
from fieldkit.config.schema import Field, Length, Strict
from fieldkit.core import model

_Distance = Annotated[Length, Field(gt=0)] | None


class PathLeg(Strict):
    """A straight segment of a path; several keys together are one diagonal segment.

    Attributes:
        away: Distance away from the robot at the other end of the link, along the line between them (for the
            relay: away from the sender).
        towards: Distance towards that robot.
        left: Distance to the left, seen by an observer who looks away from that robot. Combined with `away` or
            `towards` the segment is diagonal.
        right: Distance to the right.
        opposites: The keys in pairs of opposite directions.
        noun: The word for such a displacement in messages.
        split_hint: Remedy in the message about two keys of opposite directions; empty if there is none.
    """

    opposites: ClassVar[tuple[tuple[str, str], ...]] = (("away", "towards"), ("left", "right"))
    noun: ClassVar[str] = "segment"
    split_hint: ClassVar[str] = "; make two segments"

    away: _Distance = None
    towards: _Distance = None
    left: _Distance = None
    right: _Distance = None

    @schema.model_validator(mode="after")
    def _has_one_direction(self) -> Self:
        for key, opposite in self.opposites:
            if getattr(self, key) is not None and getattr(self, opposite) is not None:
                raise schema.validation_error(
                    f"a {self.noun} has {key} or {opposite}, not both{self.split_hint}", opposite
                )
        keys = [key for pair in self.opposites for key in pair]
        if not any(getattr(self, key) for key in keys):
            raise schema.validation_error(f"a {self.noun} needs a distance: {', '.join(keys[:-1])} or {keys[-1]}")
        return self

    @classmethod
    def of(cls, leg: model.Leg) -> "PathLeg | None":
        """Convert a testbed's leg to a segment, rounded down to centimetres; return None if its length is then 0."""
        keys = (("away", "towards", leg.away_m), ("left", "right", leg.left_m))
        lengths = {
            (key if metres > 0 else opposite): math.floor(100 * abs(metres)) / 100 for key, opposite, metres in keys
        }
        if not any(lengths.values()):
            return None
        return cls.defaults().model_copy(update={name: metres or None for name, metres in lengths.items()})

    @property
    def leg(self) -> model.Leg:
        """The segment in the form for the testbed."""
        return model.Leg((self.away or 0.0) - (self.towards or 0.0), (self.left or 0.0) - (self.right or 0.0))
