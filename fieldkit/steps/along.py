"""Steps that can take their duration from the motion of a `move` around them (`along: true`)."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, Self

from typing_extensions import override

from fieldkit.backends.protocols import Cast
from fieldkit.config import schema
from fieldkit.config.schema import Bool, Field
from fieldkit.steps.base import Step
from fieldkit.steps.capabilities import ChecksPlacement, DependsOnCast
from fieldkit.steps.surroundings import EarlierStep, EnclosingStep


class AlongStep(Step, DependsOnCast, ChecksPlacement):
    """A step that can last as long as the motion around it.

    Attributes:
        duration_key: The key that sets its duration without `along`: `duration` or `count`.
        along: Whether the step lasts as long as the path of the `move` that contains it, instead of its duration or
            count. It cannot be used inside `fly`.
    """

    duration_key: ClassVar[str] = "duration"

    along: Bool = Field(default=False, exclude_if=schema.is_empty)

    @schema.model_validator(mode="after")
    def _has_one_duration(self) -> Self:
        if self.along and self.duration_key in self.model_fields_set:
            raise schema.validation_error(
                f"along and {self.duration_key} exclude each other; leave one out", self.duration_key
            )
        return self

    @schema.model_serializer(mode="wrap")
    def _serialize(self, serialize: schema.SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Omit the default of `duration_key` if `along` is set."""
        fields: dict[str, Any] = serialize(self)
        return {key: value for key, value in fields.items() if not (self.along and key == self.duration_key)}

    @abstractmethod
    def with_duration(self, seconds: float) -> Self:
        """Return this step with the value of `duration_key` that corresponds to this duration."""

    @override
    def resolved(self, cast: Cast, path_s: float | None = None) -> Self:
        if not self.along or path_s is None:
            return self
        return self.with_duration(path_s).model_copy(update={"along": False})

    @override
    def placement_error(self, earlier: Sequence[EarlierStep], within: Sequence[EnclosingStep]) -> str | None:
        if self.along and not any(nest.has_path for nest in within):
            return (
                "along: true is allowed only inside a move: "
                f"put the step into the move, or replace along by {self.duration_key}"
            )
        return None
