"""Headline figures of a report: what is missing first, then each quantity with its worst condition first."""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

from fieldkit.analysis.cells import Cell, Estimate
from fieldkit.analysis.quantities import Quantity, alike
from fieldkit.analysis.wording import measured
from fieldkit.core.columns import plain_name
from fieldkit.core.units import format_count
from fieldkit.report import coverage, wording
from fieldkit.report.coverage import Absence
from fieldkit.report.evidence import Evidence
from fieldkit.report.ranking import Ranking

_OF_PROTOCOLS: Final = {"udp": ("datagram_loss", "rtt_median_s"), "tcp": ("tcp_byte_loss", "rtt_median_s")}
_OF_TOPICS: Final = ("topic_loss", "topic_delay_median_s")
"""Of trials that stream topics, beside which pings and transfers are there for clocks and load."""
_MOST_FIRST: Final = 6
"""Headlines of expected quantities and of a lab's own."""
_MOST_PLACES: Final = 3
_FATES: Final = {
    "silent": "nothing arrived in {}",
    "failed": "{} failed",
    "void": "{} void",
    "missing": "{} not run",
}
"""Counts of repeats that a headline names, as it does."""


@dataclass(frozen=True)
class Extreme:
    """One line of a headline.

    Attributes:
        which: `least`, `most`; empty if there is one condition, or nothing to compare.
        value: The figure with its unit, or what is missing.
        interval: Its 95 % interval and how many repeats have it, if not all; empty without either.
        place: The condition.
        is_missing: Whether it says that something is missing or lost.
    """

    which: str
    value: str
    interval: str
    place: str
    is_missing: bool = False


@dataclass(frozen=True)
class Headline:
    """A quantity that matters most, or what became of the repeats.

    Attributes:
        subject: What it is.
        ends: Its lines, the worst first.
    """

    subject: str
    ends: Sequence[Extreme]


def headlines(cells: Sequence[Cell], evidence: Evidence, unmeasured: Sequence[str] = ()) -> Iterator[Headline]:
    """Yield what became of the repeats, then quantities: expected ones, the lab's own, those of each protocol.

    Steps that only their names distinguish share a headline: the step is part of the condition there.

    Args:
        cells: Conditions.
        evidence: The table and what is at hand beside it.
        unmeasured: Planned conditions without any attempt, in words.
    """
    writer = _HeadlineWriter(evidence, Ranking(evidence), wording.differing(cells))
    yield writer.repeats(cells, unmeasured)
    first = writer.ranking.first(measured(cells))[:_MOST_FIRST]
    for quantity in first:
        protocols = {cell.key["protocol"] for cell in cells if quantity.name in cell.estimates}
        mine = [cell for cell in cells if cell.key["protocol"] in protocols]
        yield from writer.quantity(quantity.label, [quantity], mine)
    for protocol, names in _OF_PROTOCOLS.items():
        of_protocol = [cell for cell in cells if cell.key["protocol"] == protocol]
        with_topics = [cell for cell in of_protocol if alike(measured([cell]), _OF_TOPICS[0])]
        others = [cell for cell in of_protocol if cell not in with_topics]
        for mine, wanted in ((with_topics, _OF_TOPICS), (others, names)):
            for same in _chosen(measured(mine), wanted):
                if same[0] not in first:
                    yield from writer.quantity(_subject(same, protocol, mine is with_topics), same, mine)


@dataclass(frozen=True)
class _HeadlineWriter:
    """Writes the headlines of one report.

    Attributes:
        evidence: The table and what is at hand beside it.
        ranking: Which end of a quantity is the worse one.
        told: Columns that distinguish the conditions.
    """

    evidence: Evidence
    ranking: Ranking
    told: Collection[str]

    def repeats(self, cells: Sequence[Cell], unmeasured: Sequence[str]) -> Headline:
        """Return how many of all repeats are valid, and under which conditions the others are, the worst first."""
        silent = coverage.everything_lost(self.evidence.repeats)
        counted = [(cell, coverage.repeat_counts(cell, self.evidence, silent)) for cell in cells]
        planned, valid = (sum(getattr(counts, name) for _, counts in counted) for name in ("planned", "valid"))
        is_missing = valid < planned or bool(unmeasured)
        ends = [Extreme("", wording.unbroken(f"{valid} of {planned} valid"), "", "", is_missing)]
        for name, what in _FATES.items():
            some = [
                (cell, getattr(counts, name), counts.planned) for cell, counts in counted if getattr(counts, name)
            ]
            some.sort(key=lambda each: -each[1] / each[2])
            places = [f"{wording.condition(cell, told=self.told)} ({count} of {of})" for cell, count, of in some]
            if some:
                total = format_count(sum(count for _, count, _ in some), "repeat")
                ends.append(Extreme("", what.format(total), "", _some(places), is_missing=True))
        if unmeasured:
            total = format_count(len(unmeasured), "condition")
            ends.append(Extreme("", f"{total} not run", "", _some(unmeasured), is_missing=True))
        return Headline("Repeats", ends)

    def quantity(self, subject: str, same: Sequence[Quantity], cells: Sequence[Cell]) -> Iterator[Headline]:
        """Yield the headline of one quantity, or of the same one of several steps; of each size of pings its own."""
        if len(same) > 1 or plain_name(same[0].name) != "rtt_median_s":
            sizes = {size: None for one in same for size in self._sizes(one, cells)}
            yield self._headline(", ".join((subject, *sizes)), same, cells)
            return
        step = same[0].step
        for size in self._sizes(same[0], cells) or [""]:
            protocols = {cell.key["protocol"] for cell in cells if self.evidence.payload(cell, step) == size}
            # Without any reply no size is known, but the protocol is.
            alike_ = [
                cell
                for cell in cells
                if self.evidence.payload(cell, step) in {size, ""} and cell.key["protocol"] in protocols
            ]
            yield self._headline(", ".join(filter(None, (subject, size))), same, alike_)

    def _sizes(self, quantity: Quantity, cells: Sequence[Cell]) -> list[str]:
        is_rtt = plain_name(quantity.name) == "rtt_median_s"
        return self.evidence.payloads(cells, quantity.step) if is_rtt else []

    def _headline(self, subject: str, same: Sequence[Quantity], cells: Sequence[Cell]) -> Headline:
        values = [(cell, cell.estimates[one.name]) for one in same for cell in cells if one.name in cell.estimates]
        values.sort(key=lambda pair: pair[1].value, reverse=self.ranking.more_is_worse(same[0]) is not False)
        lacking = [(one, absence) for one in same for absence in coverage.absences(cells, one, self.evidence)]
        has_protocols = len({cell.key["protocol"] for cell in cells}) > 1

        def place(cell: Cell, quantity: Quantity) -> str:
            named = wording.condition if has_protocols else wording.place
            return ", ".join(filter(None, (quantity.step if len(same) > 1 else "", named(cell, told=self.told))))

        return Headline(subject, [*_missing(lacking, place), *_ends(values, place, is_whole=not lacking)])


def _missing(
    lacking: Sequence[tuple[Quantity, Absence]], place: Callable[[Cell, Quantity], str]
) -> Iterator[Extreme]:
    """Yield a line per reason for which values are missing, and where: conditions without any value come first."""
    ordered = sorted(lacking, key=lambda pair: -pair[1].count / pair[1].of)
    for reason in dict.fromkeys(absence.reason for _, absence in ordered):
        places = [
            f"{place(absence.cell, quantity)} ({absence.share})"
            for quantity, absence in ordered
            if absence.reason == reason
        ]
        yield Extreme("", reason, "", _some(places), is_missing=True)


def _ends(
    values: Sequence[tuple[Cell, Estimate]], place: Callable[[Cell, Quantity], str], *, is_whole: bool
) -> list[Extreme]:
    """Return the worst and the best of figures, which are sorted so, or the one that all have."""
    worst, best = (wording.value(values[index][1]) for index in (0, -1))
    if worst == best and len(values) > 1:
        return [Extreme("in all conditions" if is_whole else "in all others", worst, "", "")]
    which = ("least", "most") if values[0][1].value < values[-1][1].value else ("most", "least")
    lines = [_end(values, text, place) for text in dict.fromkeys((worst, best))]
    return [replace(line, which=end if len(values) > 1 else "") for line, end in zip(lines, which, strict=False)]


def _end(values: Sequence[tuple[Cell, Estimate]], text: str, place: Callable[[Cell, Quantity], str]) -> Extreme:
    """Return a figure with all conditions that have it, and its interval if only one has."""
    same = [(cell, estimate) for cell, estimate in values if wording.value(estimate) == text]
    interval = wording.interval(same[0][1]) if len(same) == 1 else ""
    return Extreme("", text, interval, _some([place(cell, estimate.quantity) for cell, estimate in same]))


def _some(places: Sequence[str]) -> str:
    """Return the first of some places, and how many more there are."""
    more = len(places) - _MOST_PLACES
    return "; ".join((*places[:_MOST_PLACES], *([f"{more} more"] if more > 0 else [])))


def _subject(same: Sequence[Quantity], protocol: str, has_topics: bool) -> str:
    first = same[0]
    label = first.label if len(same) == 1 else first.plain_label
    says_so = has_topics or first.plain_label.startswith(protocol.upper())
    return label if says_so else f"{label} with {protocol.upper()}"


def _chosen(found: Sequence[Quantity], names: Sequence[str]) -> list[list[Quantity]]:
    """Return the quantities called `names`, else the first that there are, each with its like of other steps."""
    chosen = [same for name in names if (same := _alike(found, name))]
    others = dict.fromkeys(plain_name(quantity.name) for quantity in found)
    return chosen or [_alike(found, name) for name in list(others)[: len(names)]]


def _alike(found: Sequence[Quantity], name: str) -> list[Quantity]:
    """Return the quantity of a name; of named steps where no other measures it."""
    same = alike(found, name)
    return same[:1] if same and not same[0].step else same
