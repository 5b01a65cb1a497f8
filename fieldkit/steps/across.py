"""Flows that run across a fault: inside it, or around it. No step runs beside one."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, ClassVar, Protocol, runtime_checkable

from fieldkit.core.columns import Column, Measured, named
from fieldkit.core.model import Fault, Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.transfers.fault_times import FaultTimes
from fieldkit.steps.base import Step
from fieldkit.steps.nest import Nest
from fieldkit.steps.view import View

if TYPE_CHECKING:
    from fieldkit.measure.transfers.deliveries import Delivery


@runtime_checkable
class SendsFlow(Protocol):
    """A step that sends payload of which the receiver's evidence shows when it arrived.

    Attributes:
        flow_kind: What its columns begin with.
    """

    flow_kind: ClassVar[str]

    @property
    def destination(self) -> Role:
        """Role of the robot that receives."""
        ...

    def deliveries(self, view: View) -> "Sequence[Delivery]":
        """Return the deliveries of each of its streams.

        Raises:
            EvidenceError: The evidence does not show them.
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
        """Return when it was; None if that was not noted."""
        ...


@dataclass(frozen=True)
class _Pair:
    """A fault, a flow that may run across it, and the steps that the flow is inside, from the fault on."""

    fault: Step
    flow: Step
    within: tuple[Nest, ...]

    def prefixes(self, nest: Nest) -> tuple[str, ...]:
        """Return the names of both steps, the flow's first; that of `nest` its columns get anyway."""
        return tuple(step.prefix for step in (self.flow, self.fault) if step is not nest)


def declared(nest: Nest) -> tuple[Column, ...]:
    """Return the columns of the recoveries that a step knows of, without its own name."""
    from fieldkit.measure.transfers import recoveries  # noqa: PLC0415 (numpy, which most commands do not need)

    found: list[Column] = []
    for pair in _pairs(nest):
        if isinstance(pair.flow, SendsFlow) and isinstance(pair.fault, CausesFault):
            columns = recoveries.declared(pair.flow.flow_kind, pair.fault.cause.kind)
            for prefix in pair.prefixes(nest):
                columns = tuple(named(prefix, column) for column in columns)
            found += columns
    return tuple(found)


def measure(nest: Nest, view: View) -> Measured:
    """Return the values of `declared`."""
    from fieldkit.measure.transfers import recoveries  # noqa: PLC0415 (as above)

    found = Measured()
    for pair in _pairs(nest):
        if isinstance(pair.flow, SendsFlow) and isinstance(pair.fault, CausesFault):
            inside = View(view.scene, view.evidence, (*view.within, *pair.within))
            kind, times = pair.fault.cause.kind, pair.fault.times(view.evidence)
            deliveries = partial(pair.flow.deliveries, inside)
            own = recoveries.measure(pair.flow.flow_kind, kind, deliveries, times, pair.flow.destination)
            for prefix in pair.prefixes(nest):
                own = own.named(prefix)
            found |= own
    return found


def _pairs(nest: Nest) -> Iterator[_Pair]:
    """Yield the flows that run across this step, which is a fault, and the faults in it, which is a flow."""
    inside = [found for entry in nest.during for found in _walk(entry.step, (nest,))]
    if isinstance(nest, CausesFault):
        yield from (_Pair(nest, step, within) for step, within in inside if isinstance(step, SendsFlow))
    if isinstance(nest, SendsFlow):
        yield from (_Pair(step, nest, ()) for step, _ in inside if isinstance(step, CausesFault))


def _walk(step: Step, within: tuple[Nest, ...]) -> Iterator[tuple[Step, tuple[Nest, ...]]]:
    """Yield a step and those inside it, each with what it is inside."""
    yield step, within
    if isinstance(step, Nest):
        for entry in step.during:
            yield from _walk(entry.step, (*within, step))
