"""Measure how data flows recover from faults, for a flow whose step contains the step of a fault, or vice versa."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, ClassVar, Protocol, runtime_checkable

from fieldkit.core.columns import Column, Measured, with_step_name
from fieldkit.core.model import Fault, Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.transfers.recoveries import FaultTimes
from fieldkit.steps.base import Step
from fieldkit.steps.nest import Nest
from fieldkit.steps.view import View

if TYPE_CHECKING:
    from fieldkit.measure.transfers.deliveries import StreamDeliveries


@runtime_checkable
class SendsFlow(Protocol):
    """A step that sends payload, and whose evidence contains the times at which the payload arrived.

    Attributes:
        flow_kind: Prefix of its columns.
    """

    flow_kind: ClassVar[str]

    @property
    def destination(self) -> Role:
        """Role of the receiving robot."""
        ...

    def deliveries(self, view: View) -> "Sequence[StreamDeliveries]":
        """Return the deliveries of each of its streams.

        Raises:
            EvidenceError: The evidence does not contain them.
        """
        ...


@runtime_checkable
class CausesFault(Protocol):
    """A step that causes a fault."""

    @property
    def cause(self) -> Fault:
        """The fault."""
        ...

    def times(self, evidence: AttemptEvidence) -> FaultTimes | None:
        """Return the times of the fault; None if they were not recorded."""
        ...


@dataclass(frozen=True)
class _Pair:
    """A fault, and a flow that may run during it.

    Attributes:
        fault: The step of the fault.
        flow: The step of the flow.
        within: The steps that contain the flow, from the fault inwards; empty if the flow contains the fault.
    """

    fault: Step
    flow: Step
    within: tuple[Nest, ...]

    def prefixes(self, nest: Nest) -> tuple[str, ...]:
        """Return the names of flow and fault, without the name of `nest`, which is added to the columns later."""
        return tuple(step.prefix for step in (self.flow, self.fault) if step is not nest)


def recovery_columns(nest: Nest) -> tuple[Column, ...]:
    """Return the columns of the recoveries in `nest`, without the prefix of its name.

    There is a recovery for each pair of a flow and a fault of which one is `nest` and the other is inside it.
    """
    from fieldkit.measure.transfers import recoveries  # noqa: PLC0415 (numpy, which most commands do not need)

    all_columns: list[Column] = []
    for pair in _pairs(nest):
        if isinstance(pair.flow, SendsFlow) and isinstance(pair.fault, CausesFault):
            columns = recoveries.declare_columns(pair.flow.flow_kind, pair.fault.cause.kind)
            for prefix in pair.prefixes(nest):
                columns = tuple(with_step_name(prefix, column) for column in columns)
            all_columns += columns
    return tuple(all_columns)


def measure(nest: Nest, view: View) -> Measured:
    """Return the values of `recovery_columns`."""
    from fieldkit.measure.transfers import recoveries  # noqa: PLC0415 (as above)

    measured = Measured()
    for pair in _pairs(nest):
        if isinstance(pair.flow, SendsFlow) and isinstance(pair.fault, CausesFault):
            inner_view = View(view.scene, view.evidence, (*view.within, *pair.within))
            kind, times = pair.fault.cause.kind, pair.fault.times(view.evidence)
            deliveries = partial(pair.flow.deliveries, inner_view)
            recovery = recoveries.measure(pair.flow.flow_kind, kind, deliveries, times, pair.flow.destination)
            for prefix in pair.prefixes(nest):
                recovery = recovery.with_step_name(prefix)
            measured |= recovery
    return measured


def _pairs(nest: Nest) -> Iterator[_Pair]:
    """Yield the pairs of a fault and a flow. One of them is `nest`, and the other is inside it."""
    inner_steps = [step_within for entry in nest.during for step_within in _walk(entry.step, (nest,))]
    if isinstance(nest, CausesFault):
        yield from (_Pair(nest, step, within) for step, within in inner_steps if isinstance(step, SendsFlow))
    if isinstance(nest, SendsFlow):
        yield from (_Pair(step, nest, ()) for step, _ in inner_steps if isinstance(step, CausesFault))


def _walk(step: Step, within: tuple[Nest, ...]) -> Iterator[tuple[Step, tuple[Nest, ...]]]:
    """Yield a step and all steps inside it, each with the steps around it."""
    yield step, within
    if isinstance(step, Nest):
        for entry in step.during:
            yield from _walk(entry.step, (*within, step))
