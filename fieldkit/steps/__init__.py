"""The kinds of step that a procedure can name; to add one, write its module and name it in `Entry`."""

from fieldkit.config import schema
from fieldkit.config.schema import Strict
from fieldkit.steps.base import Step
from fieldkit.steps.capture import Capture
from fieldkit.steps.fault import Fault
from fieldkit.steps.move import Move
from fieldkit.steps.ping import Ping
from fieldkit.steps.record import Record
from fieldkit.steps.transfer import Transfer


class Entry(Strict):
    """One entry under `steps:`, a mapping with one key: the kind of step.

    Attributes:
        record: Record a ROS bag.
        capture: Capture packets while other steps run.
        transfer: Send a file.
        ping: Measure round-trip times.
        fault: Do something to a robot on purpose while other steps run.
        move: Let a robot move while other steps run.
    """

    record: Record | None = None
    capture: Capture | None = None
    transfer: Transfer | None = None
    ping: Ping | None = None
    fault: Fault | None = None
    move: Move | None = None

    @schema.model_validator(mode="after")
    def _one_kind(self) -> "Entry":
        if len(self._given()) != 1:
            raise schema.complaint(f"a step has one kind, one of: {', '.join(type(self).model_fields)}")
        return self

    def _given(self) -> list[str]:
        return [name for name in type(self).model_fields if getattr(self, name) is not None]

    @property
    def kind(self) -> str:
        """Its key."""
        return self._given()[0]

    @property
    def step(self) -> Step:
        """The step itself."""
        step: Step = getattr(self, self.kind)
        return step


Capture.model_rebuild()
Fault.model_rebuild()
Move.model_rebuild()
Entry.model_rebuild()
