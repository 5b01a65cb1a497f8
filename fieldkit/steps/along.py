"""Steps that can last as long as the way along which a robot moves meanwhile."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, Self

from fieldkit.backends.protocols import Cast
from fieldkit.config import schema
from fieldkit.config.schema import Bool, Field
from fieldkit.steps.base import Nest, Step


class AlongStep(Step):
    """A step that can.

    Attributes:
        lasts_by: The key that says otherwise how long it lasts.
        along: Whether it lasts as long as the way of the step around it.
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

    def fitted(self, cast: Cast, way_s: float | None = None) -> Self:  # noqa: ARG002 (see the base)
        """See `Step.fitted`."""
        if not self.along or way_s is None:
            return self
        return self.lasting(way_s).model_copy(update={"along": False})

    def misplaced(self, earlier: Sequence[Step], within: Sequence[Nest]) -> str | None:  # noqa: ARG002 (see the base)
        """See `Step.misplaced`."""
        if self.along and not any(nest.leads for nest in within):
            return (
                f"nothing moves around it, so it lasts along no way; say its {self.lasts_by}, or put it into a move"
            )
        return None
