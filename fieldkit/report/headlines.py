"""Headlines of a report: first the outcomes of the repeats, then the quantities, each with its worst value first.

A cell contains the repeats under one condition, and their estimates.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

from fieldkit.analysis.cells import Cell, Estimate
from fieldkit.analysis.expectations import Expectation
from fieldkit.analysis.quantities import LOSSES, Quantity, with_plain_name
from fieldkit.analysis.wording import measured
from fieldkit.core.columns import Kind, plain_name
from fieldkit.core.units import format_count
from fieldkit.report import coverage, wording
from fieldkit.report.coverage import Absence
from fieldkit.report.trial_folders import Evidence
from fieldkit.trial.columns import columns_of_step
from fieldkit.trial.plan import Plan

_USER_DEFINED_KINDS: Final = frozenset(("ask", "run"))
"""Kinds of step whose columns are defined by the user in the procedure."""
_MORE_IS_BETTER_UNITS: Final = frozenset(("bit/s", "dBm", "dB"))
_LOSSES: Final = frozenset((*LOSSES, "topic_loss", "video_loss", "iperf3_loss", "iperf3_captured_loss"))


class Ranking:
    """The order of quantities: quantities with an expectation, then user-defined quantities, then the others.

    Args:
        evidence: The available plans, which contain the expectations and the user-defined columns.
    """

    def __init__(self, evidence: Evidence) -> None:
        plans = list({id(plan): plan for plan in evidence.plans.values()}.values())
        expectations = [expectation for plan in plans for expectation in plan.procedure.expectations]
        self._expected: dict[str, Expectation] = {}
        for expectation in expectations:
            self._expected.setdefault(expectation.quantity, expectation)
        self._user_defined_columns = dict.fromkeys(name for plan in plans for name in _user_defined_columns(plan))

    def first_quantities(self, quantities: Iterable[Quantity]) -> list[Quantity]:
        """Return the expected quantities, then user-defined quantities; others are omitted."""
        by_name = {quantity.name: quantity for quantity in quantities}
        return [
            by_name[name] for name in dict.fromkeys((*self._expected, *self._user_defined_columns)) if name in by_name
        ]

    def is_user_defined(self, name: str) -> bool:
        """Return True if the user defined this column in a step `ask` or `run`."""
        return name in self._user_defined_columns

    def more_is_worse(self, quantity: Quantity) -> bool | None:
        """Return True if larger values are worse, False if they are better, or None if that is unknown.

        The expectation on the quantity determines the result. Without an expectation, the unit or the name does,
        except for flags and user-defined quantities, for which the result is None.
        """
        if (expectation := self._expected.get(quantity.name)) is not None:
            return expectation.is_below
        if quantity.name in self._user_defined_columns or quantity.kind is Kind.FLAG:
            return None
        if quantity.unit in _MORE_IS_BETTER_UNITS:
            return False
        return True if quantity.unit == "s" or plain_name(quantity.name) in _LOSSES else None


def _user_defined_columns(plan: Plan) -> Iterator[str]:
    for placed in plan.procedure.walk():
        if placed.kind in _USER_DEFINED_KINDS:
            yield from (column.name for column in columns_of_step(placed.step))


_PROTOCOL_QUANTITIES: Final = {"udp": ("datagram_loss", "rtt_median_s"), "tcp": ("tcp_byte_loss", "rtt_median_s")}
_TOPIC_QUANTITIES: Final = ("topic_loss", "topic_delay_median_s", "video_loss", "used_age_p95_s", "seen_age_p95_s")
"""Quantities of trials that stream topics or video.

In these trials pings serve only to measure the clock offset, and transfers only to generate load.
"""
_MAX_FIRST_HEADLINES: Final = 6
"""Maximum number of expected and user-defined quantities with headlines. An RTT has one per payload size."""
_MAX_PLACES: Final = 3
"""Maximum number of conditions that a line names."""
_COUNT_TEXTS: Final = {
    "all_lost": "nothing arrived in {}",
    "failed": "{} failed",
    "void": "{} void",
    "missing": "{} not run",
}
"""Texts about counts of repeats, by attribute of `RepeatCounts`."""


@dataclass(frozen=True)
class HeadlineLine:
    """One line of a headline.

    Attributes:
        extreme: `least` or `most`; if all values are equal, `in all conditions` or `in all others`; empty if there is
            nothing to compare.
        value: The value with its unit, the number of repeats with an outcome, or the reason for missing values.
        interval: The 95 % interval, and the number of repeats with a value if not all have one; empty if several
            conditions have the value.
        place: The conditions, at most three and the number of others; may be empty.
        is_missing: True if the line reports something missing or lost.
    """

    extreme: str
    value: str
    interval: str
    place: str
    is_missing: bool = False


@dataclass(frozen=True)
class Headline:
    """An important quantity, or the outcomes of the repeats.

    Attributes:
        subject: Its title.
        lines: Its lines: missing values, then the worst value, then the best.
    """

    subject: str
    lines: Sequence[HeadlineLine]


def headlines(cells: Sequence[Cell], evidence: Evidence, unmeasured: Sequence[str] = ()) -> Iterator[Headline]:
    """Yield the headline of the outcomes of repeats, then headlines of quantities.

    At most six quantities with an expectation or user-defined quantities come first, then the quantities of each
    protocol. The latter share a headline if several named steps measure the same one: the condition then names the
    step.

    Args:
        cells: Conditions.
        evidence: The table and the available evidence.
        unmeasured: Planned conditions without any attempt, in words.
    """
    writer = _HeadlineWriter(evidence, Ranking(evidence), wording.differing(cells))
    yield writer.repeats_headline(cells, unmeasured)
    first_quantities = writer.ranking.first_quantities(measured(cells))[:_MAX_FIRST_HEADLINES]
    for quantity in first_quantities:
        protocols = {cell.key["protocol"] for cell in cells if quantity.name in cell.estimates}
        group_cells = [cell for cell in cells if cell.key["protocol"] in protocols]
        yield from writer.quantity_headlines(quantity.label, [quantity], group_cells)
    for protocol, names in _PROTOCOL_QUANTITIES.items():
        protocol_cells = [cell for cell in cells if cell.key["protocol"] == protocol]
        topic_cells = [
            cell
            for cell in protocol_cells
            if any(with_plain_name(measured([cell]), name) for name in _TOPIC_QUANTITIES)
        ]
        other_cells = [cell for cell in protocol_cells if cell not in topic_cells]
        for group_cells, quantity_names in ((topic_cells, _TOPIC_QUANTITIES), (other_cells, names)):
            for quantities_of_name in _existing_quantities(measured(group_cells), quantity_names):
                if quantities_of_name[0] not in first_quantities:
                    yield from writer.quantity_headlines(
                        _subject(quantities_of_name, protocol, group_cells is topic_cells),
                        quantities_of_name,
                        group_cells,
                    )


@dataclass(frozen=True)
class _HeadlineWriter:
    """Writes the headlines of one report.

    Attributes:
        evidence: The table and the available evidence.
        ranking: Order of quantities and direction of worse values.
        differing: Columns that distinguish the conditions.
    """

    evidence: Evidence
    ranking: Ranking
    differing: Collection[str]

    def repeats_headline(self, cells: Sequence[Cell], unmeasured: Sequence[str]) -> Headline:
        """Return the headline of the numbers of repeats by outcome.

        Its first line is the number of valid repeats. The others name the conditions of repeats in which nothing
        arrived, that failed, are void or were not run, the largest share first.
        """
        all_lost = coverage.everything_lost(self.evidence.repeats)
        cell_counts = [(cell, coverage.repeat_counts(cell, self.evidence, all_lost)) for cell in cells]
        planned, valid = (sum(getattr(counts, name) for _, counts in cell_counts) for name in ("planned", "valid"))
        is_missing = valid < planned or bool(unmeasured)
        lines = [HeadlineLine("", wording.without_breaks(f"{valid} of {planned} valid"), "", "", is_missing)]
        for name, text in _COUNT_TEXTS.items():
            affected = [
                (cell, getattr(counts, name), counts.planned) for cell, counts in cell_counts if getattr(counts, name)
            ]
            affected.sort(key=lambda item: -item[1] / item[2])
            places = [
                f"{wording.condition(cell, differing=self.differing)} ({count} of {total_count})"
                for cell, count, total_count in affected
            ]
            if affected:
                total = format_count(sum(count for _, count, _ in affected), "repeat")
                lines.append(HeadlineLine("", text.format(total), "", _first_places(places), is_missing=True))
        if unmeasured:
            total = format_count(len(unmeasured), "condition")
            lines.append(HeadlineLine("", f"{total} not run", "", _first_places(unmeasured), is_missing=True))
        return Headline("Repeats", lines)

    def quantity_headlines(
        self, subject: str, variants: Sequence[Quantity], cells: Sequence[Cell]
    ) -> Iterator[Headline]:
        """Yield the headline of a quantity, or one headline of its variants in several steps.

        The median RTT of a single step has a headline for each payload size of its pings.
        """
        if len(variants) > 1 or plain_name(variants[0].name) != "rtt_median_s":
            sizes = {size: None for quantity in variants for size in self._sizes(quantity, cells)}
            yield self._headline(", ".join((subject, *sizes)), variants, cells)
            return
        step = variants[0].step
        for size in self._sizes(variants[0], cells) or [""]:
            protocols = {cell.key["protocol"] for cell in cells if self.evidence.payload(cell, step) == size}
            # The payload size of a cell without any reply is unknown. Such a cell belongs to each size that another
            # cell of its protocol has.
            matching = [
                cell
                for cell in cells
                if self.evidence.payload(cell, step) in {size, ""} and cell.key["protocol"] in protocols
            ]
            yield self._headline(", ".join(filter(None, (subject, size))), variants, matching)

    def _sizes(self, quantity: Quantity, cells: Sequence[Cell]) -> list[str]:
        is_rtt = plain_name(quantity.name) == "rtt_median_s"
        return self.evidence.payloads(cells, quantity.step) if is_rtt else []

    def _headline(self, subject: str, variants: Sequence[Quantity], cells: Sequence[Cell]) -> Headline:
        """Return the headline of a quantity in all its steps: missing values, then the worst and the best value."""
        values = [
            (cell, cell.estimates[quantity.name])
            for quantity in variants
            for cell in cells
            if quantity.name in cell.estimates
        ]
        values.sort(key=lambda pair: pair[1].value, reverse=self.ranking.more_is_worse(variants[0]) is not False)
        missing = [
            (quantity, absence)
            for quantity in variants
            for absence in coverage.absences(cells, quantity, self.evidence)
        ]
        has_protocols = len({cell.key["protocol"] for cell in cells}) > 1

        def place(cell: Cell, quantity: Quantity) -> str:
            describe = wording.condition if has_protocols else wording.place
            return ", ".join(
                filter(None, (quantity.step if len(variants) > 1 else "", describe(cell, differing=self.differing)))
            )

        return Headline(
            subject, [*_missing(missing, place), *_worst_and_best(values, place, has_all_values=not missing)]
        )


def _missing(
    absences: Sequence[tuple[Quantity, Absence]], place: Callable[[Cell, Quantity], str]
) -> Iterator[HeadlineLine]:
    """Yield a line per reason for missing values, with the conditions; conditions without any value come first."""
    ordered = sorted(absences, key=lambda pair: -pair[1].count / pair[1].total)
    for reason in dict.fromkeys(absence.reason for _, absence in ordered):
        places = [
            f"{place(absence.cell, quantity)} ({absence.share})"
            for quantity, absence in ordered
            if absence.reason == reason
        ]
        yield HeadlineLine("", reason, "", _first_places(places), is_missing=True)


def _worst_and_best(
    values: Sequence[tuple[Cell, Estimate]], place: Callable[[Cell, Quantity], str], *, has_all_values: bool
) -> list[HeadlineLine]:
    """Return the worst and the best of values that are sorted from worst to best; one line if both have one text."""
    worst, best = (wording.value(values[index][1]) for index in (0, -1))
    if worst == best and len(values) > 1:
        return [HeadlineLine("in all conditions" if has_all_values else "in all others", worst, "", "")]
    end_names = ("least", "most") if values[0][1].value < values[-1][1].value else ("most", "least")
    lines = [_line_of_value(values, text, place) for text in dict.fromkeys((worst, best))]
    return [
        replace(line, extreme=end_name if len(values) > 1 else "")
        for line, end_name in zip(lines, end_names, strict=False)
    ]


def _line_of_value(
    values: Sequence[tuple[Cell, Estimate]], text: str, place: Callable[[Cell, Quantity], str]
) -> HeadlineLine:
    """Return the line for a value, with all conditions that have this value.

    It contains the interval if there is only one such condition.
    """
    matching = [(cell, estimate) for cell, estimate in values if wording.value(estimate) == text]
    interval = wording.interval(matching[0][1]) if len(matching) == 1 else ""
    return HeadlineLine(
        "", text, interval, _first_places([place(cell, estimate.quantity) for cell, estimate in matching])
    )


def _first_places(places: Sequence[str]) -> str:
    """Return the first places, and the number of further ones."""
    more_count = len(places) - _MAX_PLACES
    return "; ".join((*places[:_MAX_PLACES], *([f"{more_count} more"] if more_count > 0 else [])))


def _subject(variants: Sequence[Quantity], protocol: str, has_topics: bool) -> str:
    """Return the title of a headline. The protocol is omitted for topics, and if the label starts with it."""
    first_variant = variants[0]
    label = first_variant.label if len(variants) == 1 else first_variant.plain_label
    omit_protocol = has_topics or first_variant.plain_label.startswith(protocol.upper())
    return label if omit_protocol else f"{label} with {protocol.upper()}"


def _existing_quantities(quantities: Sequence[Quantity], names: Sequence[str]) -> list[list[Quantity]]:
    """Return the quantity of each name, with its variants in other steps.

    Names that no quantity has are omitted. If no name exists, the first quantities are returned instead, at most as
    many as there are `names`.
    """
    existing = [matching for name in names if (matching := _quantities_named(quantities, name))]
    first_names = dict.fromkeys(plain_name(quantity.name) for quantity in quantities)
    return existing or [_quantities_named(quantities, name) for name in list(first_names)[: len(names)]]


def _quantities_named(quantities: Sequence[Quantity], name: str) -> list[Quantity]:
    """Return the quantity called `name` of the step without a name, or otherwise the quantities of named steps."""
    matching = with_plain_name(quantities, name)
    return matching[:1] if matching and not matching[0].step else matching
