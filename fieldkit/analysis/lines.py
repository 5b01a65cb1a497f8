"""Lines of tables: which quantities a table shows, under which labels, and how a cell's figure is written."""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Final

from fieldkit.analysis import wording
from fieldkit.analysis.cells import Cell, Estimate
from fieldkit.analysis.quantities import Quantity, in_order
from fieldkit.core.columns import plain_name, prefixed

_RADIO: Final = ("ip_loss", "tcp_byte_loss")
"""What the radio lost, per protocol: IP packets of UDP; bytes of TCP, which TCP then repaired."""

_OPERATOR: Final = (
    "file_loss",
    *_RADIO,
    "topic_loss",
    "iperf3_loss",
    "mavlink_loss",
    "rtt_loss",
    "rtt_median_s",
    "topic_discovered",
    "topic_delay_median_s",
    "goodput_bit_s",
    "iperf3_throughput_bit_s",
    "sender_signal_median_dbm",
    "receiver_signal_median_dbm",
)
"""What an operator looks at beside the antenna, in this order."""

_FAULT_ENDINGS: Final = ("_recovered", "_recovery_s")

_SENT: Final[Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {
        "packets sent": ("ip_loss", "paper_loss"),
        "topic samples sent": ("topic_loss",),
        "iperf3 datagrams sent": ("iperf3_loss",),
    }
)
"""Counts, and the counted losses that say of how many they are; the first that a cell has."""


@dataclass(frozen=True)
class TableLine:
    """A row or a column of figures in a table.

    Attributes:
        label: What it is.
        quantities: Of these a cell shows the first that it has.
        payload_bytes: ICMP payload sizes of the cells in this line; None for all cells.
    """

    label: str
    quantities: tuple[Quantity, ...]
    payload_bytes: tuple[int, ...] | None = None

    def estimate(self, cell: Cell) -> Estimate | None:
        """Return a cell's figure, None if it has none in this line."""
        if not self._covers(cell):
            return None
        return next((cell.estimates[one.name] for one in self.quantities if one.name in cell.estimates), None)

    def is_lacking(self, cell: Cell) -> bool:
        """Return whether no valid repeat of a cell has the figure, though each was measured for it."""
        return (
            self._covers(cell)
            and self.estimate(cell) is None
            and any(one.name == missing.name for one in self.quantities for missing in cell.lacking)
        )

    def scale(self, cells: Sequence[Cell]) -> wording.Scale:
        """Return in what to write the figures of these cells."""
        estimates = [estimate for cell in cells if (estimate := self.estimate(cell))]
        return wording.scale_of(self.quantities[0], [estimate.value for estimate in estimates])

    def number(self, cell: Cell, scale: wording.Scale) -> str:
        """Return a cell's figure without its unit, with its interval: `3.33 [1.10, 6.70] (4 of 5)`."""
        estimate = self.estimate(cell)
        if estimate is None:
            return self._none(cell)
        return wording.quoted(wording.number(scale, estimate), scale, estimate)

    def amount(self, cell: Cell, scale: wording.Scale, between: str = " ") -> str:
        """Return the same with its unit, and with `between` between the parts."""
        estimate = self.estimate(cell)
        if estimate is None:
            return self._none(cell)
        return wording.quoted(wording.amount(scale, estimate), scale, estimate, between)

    def _none(self, cell: Cell) -> str:
        return f"none, 0 of {cell.n_valid}" if self.is_lacking(cell) else ""

    def _covers(self, cell: Cell) -> bool:
        return self.payload_bytes is None or cell.payload_bytes.get(self.quantities[0].name, ()) == self.payload_bytes


def part_of(n: int, cell: Cell) -> str:
    """Return `4 of 5` where only some of a cell's valid repeats have a figure; empty where all have."""
    return f"{n} of {cell.n_valid}" if n < cell.n_valid else ""


def lines(cells: Sequence[Cell], quantities: Iterable[Quantity] | None = None) -> list[TableLine]:
    """Return a line per quantity that any of the cells has or lacks, in order; of an RTT one per payload size.

    Args:
        cells: What the table shows.
        quantities: Which quantities it shows; None for all.
    """
    # Not a set, whose order differs from run to run: quantities of equal rank keep the order of columns.
    there = dict.fromkeys(estimate.quantity for cell in cells for estimate in cell.estimates.values())
    there |= dict.fromkeys(quantity for cell in cells for quantity in cell.lacking)
    shown = in_order(there) if quantities is None else [one for one in quantities if one in there]
    return [line for quantity in shown for line in _lines_of(quantity, cells)]


def _lines_of(quantity: Quantity, cells: Sequence[Cell]) -> Iterator[TableLine]:
    label = wording.label(quantity)
    having = [cell for cell in cells if quantity.name in cell.estimates or quantity in cell.lacking]
    sizes = sorted({cell.payload_bytes.get(quantity.name, ()) for cell in having})
    if not any(sizes):
        yield TableLine(label, (quantity,))
        return
    for size in sizes:
        yield TableLine(_with_payload(quantity, size), (quantity,), size)


def _with_payload(quantity: Quantity, sizes: Sequence[int]) -> str:
    """Return the label of round-trip times of pings of these sizes: `RTT, 8192-byte ping, median`."""
    size = f"{sizes[0]}" if len(sizes) == 1 else f"{sizes[0]}- to {sizes[-1]}" if sizes else "unknown"
    return wording.label(replace(quantity, label=f"{quantity.label}, {size}-byte ping"))


def of_operator(cells: Sequence[Cell], expected: Collection[str] = ()) -> list[TableLine]:
    """Return the lines that an operator looks at, in order; all lines where none of them is there.

    These are what arrived, how long it took and how strong the signal was; what is expected; and all that a procedure
    measures because its lab asks for it.

    Args:
        cells: What the table shows.
        expected: Names of quantities with an expectation.
    """
    every = lines(cells)
    chosen = [line for line in every if _is_for_operator(line.quantities[0], expected)]
    chosen.sort(key=lambda line: _place(line.quantities[0]))
    return chosen or every


def _is_for_operator(quantity: Quantity, expected: Collection[str]) -> bool:
    name = plain_name(quantity.name)
    return name in _OPERATOR or not quantity.is_own or name.endswith(_FAULT_ENDINGS) or quantity.name in expected


def _place(quantity: Quantity) -> int:
    name = plain_name(quantity.name)
    return _OPERATOR.index(name) if name in _OPERATOR else len(_OPERATOR)


def with_radio_loss(chosen: Sequence[TableLine], cells: Sequence[Cell]) -> list[TableLine]:
    """Return the lines, what the radio lost of UDP and of TCP in one per step, where no cell has both."""
    return list(_with_radio_loss(chosen, cells))


def _with_radio_loss(chosen: Sequence[TableLine], cells: Sequence[Cell]) -> Iterator[TableLine]:
    radio: dict[str, list[TableLine]] = {}
    for line in chosen:
        if plain_name(line.quantities[0].name) in _RADIO:
            radio.setdefault(line.quantities[0].step, []).append(line)
    for line in chosen:
        step = line.quantities[0].step
        same = radio.get(step, [])
        are_apart = all(sum(part.estimate(cell) is not None for part in same) < 2 for cell in cells)
        if line not in same or not are_apart:
            yield line
        elif line is same[0]:
            yield TableLine(_named(step, "radio loss"), tuple(one.quantities[0] for one in same))


def sent(cells: Sequence[Cell]) -> dict[str, list[str]]:
    """Return how much the valid repeats of each cell sent in all, by label; empty where a cell does not say."""
    steps = dict.fromkeys(estimate.quantity.step for cell in cells for estimate in cell.estimates.values())
    found: dict[str, list[str]] = {}
    for step in steps:
        for label, names in _SENT.items():
            counts = [_trials(cell, [prefixed(step, name) for name in names]) for cell in cells]
            if any(counts):
                found[_named(step, label)] = counts
    return found


def _trials(cell: Cell, names: Sequence[str]) -> str:
    """Return of how many the first of some counted quantities is that a cell has."""
    trials = (cell.estimates[name].trials for name in names if name in cell.estimates)
    return next((f"{count}" for count in trials if count is not None), "")


def _named(step: str, label: str) -> str:
    """Return a label with the name of its step before it, as `columns.named` does."""
    return f"{step}: {label}" if step else label
