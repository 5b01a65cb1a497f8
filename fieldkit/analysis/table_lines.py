"""Lines of tables: the rows or columns that each show one quantity of several cells, as texts.

A cell has the estimates and counts of the repeats under one condition.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Final

from fieldkit.analysis import wording
from fieldkit.analysis.cells import Cell, Estimate
from fieldkit.analysis.quantities import Quantity, in_order
from fieldkit.core.columns import plain_name, step_prefixed

_RADIO: Final = ("ip_loss", "tcp_byte_loss")
"""Columns of the loss on the radio: lost IP packets for UDP, and lost bytes for TCP, which retransmits them."""

_OPERATOR: Final = (
    "file_loss",
    *_RADIO,
    "topic_loss",
    "video_loss",
    "iperf3_loss",
    "mavlink_loss",
    "rtt_loss",
    "rtt_median_s",
    "topic_discovered",
    "topic_delay_median_s",
    "used_age_p95_s",
    "seen_age_p95_s",
    "goodput_bit_s",
    "iperf3_throughput_bit_s",
    "sender_signal_median_dbm",
    "receiver_signal_median_dbm",
)
"""Quantities for an operator during a trial, in this order."""

_FAULT_ENDINGS: Final = ("_recovered", "_recovery_s")
"""Endings of the names of columns about the recovery from a fault, which are also shown to an operator."""

_SENT: Final[Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {
        "packets sent": ("ip_loss", "paper_loss"),
        "topic samples sent": ("topic_loss",),
        "frames sent": ("video_loss",),
        "iperf3 datagrams sent": ("iperf3_loss",),
    }
)
"""Labels of numbers of sent items, each with the losses of these items. The number is `Estimate.trials` of the first
of these losses for which a cell has it."""


@dataclass(frozen=True)
class TableLine:
    """A row or a column of figures in a table.

    Attributes:
        label: Label of the line.
        quantities: Quantities of the line; the first quantity that a cell has is shown.
        payload_bytes: ICMP payload sizes of the cells in this line; None if the line includes all cells.
    """

    label: str
    quantities: tuple[Quantity, ...]
    payload_bytes: tuple[int, ...] | None = None

    def estimate(self, cell: Cell) -> Estimate | None:
        """Return the estimate of a cell in this line, or None if the cell has no estimate."""
        if not self._includes(cell):
            return None
        names = (quantity.name for quantity in self.quantities)
        return next((cell.estimates[name] for name in names if name in cell.estimates), None)

    def lacks_value(self, cell: Cell) -> bool:
        """Return True if the quantity was measured in a cell, but no valid repeat has a value."""
        return (
            self._includes(cell)
            and self.estimate(cell) is None
            and any(
                quantity.name == missing.name
                for quantity in self.quantities
                for missing in cell.quantities_without_value
            )
        )

    def scale(self, cells: Sequence[Cell]) -> wording.Scale:
        """Return the scale for the figures of these cells."""
        estimates = [estimate for cell in cells if (estimate := self.estimate(cell))]
        return wording.scale_of(self.quantities[0], [estimate.value for estimate in estimates])

    def number(self, cell: Cell, scale: wording.Scale) -> str:
        """Return a cell's figure with its interval, without a unit, such as `3.33 [1.10, 6.70] (4 of 5)`."""
        estimate = self.estimate(cell)
        if estimate is None:
            return self._no_value(cell)
        return wording.with_interval(wording.number(scale, estimate), scale, estimate)

    def amount(self, cell: Cell, scale: wording.Scale, between: str = " ") -> str:
        """Return a cell's figure with its unit and interval; `between` separates the parts."""
        estimate = self.estimate(cell)
        if estimate is None:
            return self._no_value(cell)
        return wording.with_interval(wording.amount(scale, estimate), scale, estimate, between)

    def _no_value(self, cell: Cell) -> str:
        return f"none, 0 of {cell.n_valid}" if self.lacks_value(cell) else ""

    def _includes(self, cell: Cell) -> bool:
        return self.payload_bytes is None or cell.payload_bytes.get(self.quantities[0].name, ()) == self.payload_bytes


def partial_count(n: int, cell: Cell) -> str:
    """Return a text such as `4 of 5` if only some of a cell's valid repeats have a value, or else an empty string."""
    return f"{n} of {cell.n_valid}" if n < cell.n_valid else ""


def lines(cells: Sequence[Cell], quantities: Iterable[Quantity] | None = None) -> list[TableLine]:
    """Return a line for each quantity that was measured in a cell, even if it has no value, in order.

    A round-trip time has one line for the cells with equal payload sizes, because other sizes are not comparable.

    Args:
        cells: The cells of the table.
        quantities: The quantities to show; None for all.
    """
    # A dict preserves the order of columns for quantities of equal rank. The order of a set differs from run to run.
    available = dict.fromkeys(estimate.quantity for cell in cells for estimate in cell.estimates.values())
    available |= dict.fromkeys(quantity for cell in cells for quantity in cell.quantities_without_value)
    shown = (
        in_order(available) if quantities is None else [quantity for quantity in quantities if quantity in available]
    )
    return [line for quantity in shown for line in _quantity_lines(quantity, cells)]


def _quantity_lines(quantity: Quantity, cells: Sequence[Cell]) -> Iterator[TableLine]:
    """Yield the line of a quantity; for a round-trip time, one line for the cells with equal payload sizes."""
    label = wording.label(quantity)
    cells_with_quantity = [
        cell for cell in cells if quantity.name in cell.estimates or quantity in cell.quantities_without_value
    ]
    sizes_of_cells = sorted({cell.payload_bytes.get(quantity.name, ()) for cell in cells_with_quantity})
    if not any(sizes_of_cells):
        yield TableLine(label, (quantity,))
        return
    for sizes in sizes_of_cells:
        yield TableLine(_payload_label(quantity, sizes), (quantity,), sizes)


def _payload_label(quantity: Quantity, sizes: Sequence[int]) -> str:
    """Return the label of round-trip times for these payload sizes, such as `RTT, 8192-byte ping, median`."""
    size_text = f"{sizes[0]}" if len(sizes) == 1 else f"{sizes[0]}- to {sizes[-1]}" if sizes else "unknown"
    return wording.label(replace(quantity, label=f"{quantity.label}, {size_text}-byte ping"))


def operator_lines(cells: Sequence[Cell], expected: Collection[str] = ()) -> list[TableLine]:
    """Return the lines for an operator during a trial, in order, or all lines if there are no such lines.

    These are losses, delays, throughput and signal; the recovery from faults; quantities with an expectation; and
    quantities that a lab or another package declares.

    Args:
        cells: The cells of the table.
        expected: Names of quantities with an expectation.
    """
    all_lines = lines(cells)
    operator_lines = [line for line in all_lines if _is_for_operator(line.quantities[0], expected)]
    operator_lines.sort(key=lambda line: _operator_rank(line.quantities[0]))
    return operator_lines or all_lines


def _is_for_operator(quantity: Quantity, expected: Collection[str]) -> bool:
    name = plain_name(quantity.name)
    return name in _OPERATOR or not quantity.is_builtin or name.endswith(_FAULT_ENDINGS) or quantity.name in expected


def _operator_rank(quantity: Quantity) -> int:
    name = plain_name(quantity.name)
    return _OPERATOR.index(name) if name in _OPERATOR else len(_OPERATOR)


def with_radio_loss(lines: Sequence[TableLine], cells: Sequence[Cell]) -> list[TableLine]:
    """Return the lines, with one line per step for the radio losses of UDP and TCP if no cell has both losses."""
    return list(_with_radio_loss(lines, cells))


def _with_radio_loss(lines: Sequence[TableLine], cells: Sequence[Cell]) -> Iterator[TableLine]:
    radio_lines_by_step: dict[str, list[TableLine]] = {}
    for line in lines:
        if plain_name(line.quantities[0].name) in _RADIO:
            radio_lines_by_step.setdefault(line.quantities[0].step, []).append(line)
    for line in lines:
        step = line.quantities[0].step
        losses = radio_lines_by_step.get(step, [])
        can_merge = all(sum(loss.estimate(cell) is not None for loss in losses) < 2 for cell in cells)
        if line not in losses or not can_merge:
            yield line
        elif line is losses[0]:
            yield TableLine(_with_step(step, "radio loss"), tuple(loss.quantities[0] for loss in losses))


def sent_counts(cells: Sequence[Cell]) -> dict[str, list[str]]:
    """Return the number of items that the valid repeats of each cell sent, by label. An unknown number is empty."""
    steps = dict.fromkeys(estimate.quantity.step for cell in cells for estimate in cell.estimates.values())
    counts_by_label: dict[str, list[str]] = {}
    for step in steps:
        for label, names in _SENT.items():
            counts = [_sent_count(cell, [step_prefixed(step, name) for name in names]) for cell in cells]
            if any(counts):
                counts_by_label[_with_step(step, label)] = counts
    return counts_by_label


def _sent_count(cell: Cell, names: Sequence[str]) -> str:
    """Return the number of sent items of the first of these losses that a cell has, as text; empty without one."""
    trials = (cell.estimates[name].trials for name in names if name in cell.estimates)
    return next((f"{count}" for count in trials if count is not None), "")


def _with_step(step: str, label: str) -> str:
    """Return a label with the name of its step as a prefix, as in `columns.with_step_name`."""
    return f"{step}: {label}" if step else label
