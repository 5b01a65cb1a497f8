"""The order of quantities, and whether larger or smaller values are worse."""

from collections.abc import Iterable, Iterator
from typing import Final

from fieldkit.analysis.expectations import Expectation
from fieldkit.analysis.quantities import LOSSES, Quantity
from fieldkit.core.columns import Kind, plain_name
from fieldkit.report.evidence import Evidence
from fieldkit.trial.plan import Plan

_LAB_KINDS: Final = frozenset(("ask", "run"))
"""Kinds of step whose columns a lab declares."""
_MORE_IS_BETTER: Final = frozenset(("bit/s", "dBm", "dB"))
_LOSSES: Final = frozenset((*LOSSES, "topic_loss", "iperf3_loss", "iperf3_captured_loss"))


class Ranking:
    """The order of quantities: those with an expectation, those that a lab declares, then the others.

    Args:
        evidence: The available plans, which contain the expectations and the columns of a lab.
    """

    def __init__(self, evidence: Evidence) -> None:
        plans = list({id(plan): plan for plan in evidence.plans.values()}.values())
        expectations = [each for plan in plans for each in plan.procedure.expectations]
        self._expected: dict[str, Expectation] = {}
        for expectation in expectations:
            self._expected.setdefault(expectation.quantity, expectation)
        self._lab_columns = dict.fromkeys(name for plan in plans for name in _lab_columns(plan))

    def first(self, quantities: Iterable[Quantity]) -> list[Quantity]:
        """Return the expected quantities, then those that a lab declares, without the others."""
        by_name = {quantity.name: quantity for quantity in quantities}
        return [by_name[name] for name in dict.fromkeys((*self._expected, *self._lab_columns)) if name in by_name]

    def is_own(self, name: str) -> bool:
        """Return True if a lab declares this column."""
        return name in self._lab_columns

    def more_is_worse(self, quantity: Quantity) -> bool | None:
        """Return True if larger values are worse, by the expectation or else by unit; None if both are unknown."""
        if (expectation := self._expected.get(quantity.name)) is not None:
            return expectation.is_below
        if quantity.name in self._lab_columns or quantity.kind is Kind.FLAG:
            return None
        if quantity.unit in _MORE_IS_BETTER:
            return False
        return True if quantity.unit == "s" or plain_name(quantity.name) in _LOSSES else None


def _lab_columns(plan: Plan) -> Iterator[str]:
    for placed in plan.procedure.walk():
        if placed.kind in _LAB_KINDS:
            yield from (column.name for column in placed.step.output_columns())
