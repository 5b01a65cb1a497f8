"""Steps that can last as long as the way along which a robot moves meanwhile."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, Self

from typing_extensions import override

from fieldkit.backends.protocols import Cast
from fieldkit.config import schema
from fieldkit.config.schema import Bool, Field
from fieldkit.steps.base import Step
from fieldkit.steps.nest import Nest


class AlongStep(Step):
    """A step that can.

    Attributes:
        lasts_by: The key that says otherwise how long it lasts.
        along: Whether the step lasts as long as the motion of the `move` or `fly` around it, in place of its own
            duration or count.
    """

    lasts_by: ClassVar[str] = "duration"

    along: Bool = Field(default=False, exclude_if=schema.is_empty)

    @schema.model_validator(mode="after")
    def _lasts_one_time(self) -> Self:
        if self.along and self.lasts_by in self.model_fields_set:
            raise schema.complaint(f"it lasts along a way, or as {self.lasts_by} says; leave one out", self.lasts_by)
        return self

    @schema.model_serializer(mode="wrap")
    def _written(self, written: schema.SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Write what says how long it lasts, and no default beside `along`."""
        found: dict[str, Any] = written(self)
        return {key: value for key, value in found.items() if not (self.along and key == self.lasts_by)}

    @abstractmethod
    def lasting(self, seconds: float) -> Self:
        """Return this step with its own key saying that it lasts so long."""

    @override
    def resolved(self, cast: Cast, way_s: float | None = None) -> Self:
        if not self.along or way_s is None:
            return self
        return self.lasting(way_s).model_copy(update={"along": False})

    @override
    def placement_error(self, earlier: Sequence[Step], within: Sequence[Nest]) -> str | None:
        if self.along and not any(nest.leads for nest in within):
            return (
                f"nothing moves around it, so it lasts along no way; say its {self.lasts_by}, or put it into a move"
            )
        return None
