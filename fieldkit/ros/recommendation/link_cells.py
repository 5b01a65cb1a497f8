"""The criterion that a middleware must meet on a link, and the repeats measured with one sample size at one place."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fieldkit.analysis.cells import Cell, Estimate, aggregate
from fieldkit.analysis.expectations import Expectation, Scope
from fieldkit.analysis.quantities import Quantity
from fieldkit.analysis.repeats import SOURCE, Repeats
from fieldkit.core.columns import Kind, step_prefixed

MIN_REPEATS: Final = 5
"""Default number of valid repeats that a cell needs. Losses over TCP may be bimodal
(docs/studies/middleware-link.md): a smaller number of repeats may all be in the same mode."""
_BOUND_DECIMALS: Final = 12
"""Decimals to which a bound is rounded. In binary floating point 2.9 % is slightly less than 0.029; without rounding,
a loss of 29 of 1,000 samples would exceed it."""
_INTENDED: Final = "topic_intended"
_CELL: Final = "cell"
_LOSS: Final = Quantity(
    "loss",
    "loss, including samples that were never sent",
    Kind.COUNTED,
    "share",
    "topic_received",
    _INTENDED,
    (0.0, 1.0),
)
_DELAY: Final = Quantity(
    "topic_delay_p95_s",
    "delay, 95 %",
    Kind.MEDIAN,
    "s",
    possible_range=(0.0, math.inf),
    of_sent="topic_delay_p95_sent_s",
)


@dataclass(frozen=True)
class LinkCriterion:
    """The requirements that a middleware must meet on the link, in each repeat or in a share of all repeats.

    Attributes:
        max_loss: Share of the samples that may be lost, 0 to 1; samples that were never sent count as lost.
        max_delay_s: Limit for the delay of 95 % of all samples sent; None without a limit.
        size_bytes: Only samples of this size are considered; None for all sizes.
        repeats: Number of valid repeats that a cell needs.
        share: Share of repeats that must meet the limits, with 95 % confidence; None if every repeat must meet them.
    """

    max_loss: float
    max_delay_s: float | None = None
    size_bytes: float | None = None
    repeats: int = MIN_REPEATS
    share: float | None = None

    def __str__(self) -> str:
        delay = "" if self.max_delay_s is None else f", 95 % of those sent within {self.max_delay_s:g} s"
        scope = (
            "each repeat" if self.share is None else f"{100 * self.share:g} % of all repeats, with 95 % confidence"
        )
        return f"loss at most {100 * self.max_loss:g} %{delay}, in {scope}"

    @property
    def expectations(self) -> tuple[Expectation, ...]:
        """The criterion in the form that `fieldkit.analysis` judges."""
        bounds = [
            (_LOSS, round(self.max_loss, _BOUND_DECIMALS)),
            *([] if self.max_delay_s is None else [(_DELAY, self.max_delay_s)]),
        ]
        return tuple(
            Expectation(
                f"{quantity.name} <= {bound:g}",
                quantity.name,
                is_below=True,
                bound=bound,
                is_inclusive=True,
                scope=Scope.EVERY if self.share is None else Scope.SHARE,
                share=self.share,
            )
            for quantity, bound in bounds
        )


@dataclass(frozen=True)
class LinkCell:
    """The measurements of a candidate with one sample size at one place.

    Attributes:
        place: Description of the place.
        size_bytes: Data bytes per sample.
        sources: Folders of the trials.
        cell: Its repeats, with the estimates of loss and delay.
    """

    place: str
    size_bytes: float
    sources: tuple[str, ...]
    cell: Cell

    @property
    def loss(self) -> Estimate | None:
        """The loss; None if no valid repeat has one."""
        return self.cell.estimates.get(_LOSS.name)

    @property
    def delay(self) -> Estimate | None:
        """The 95th percentile of the sample delay; None if no valid repeat has one."""
        return self.cell.estimates.get(_DELAY.name)

    @property
    def attempts(self) -> int:
        """Number of attempts, valid or not."""
        return self.cell.n_valid + self.cell.n_void + self.cell.n_failed

    @property
    def largest_delay_s(self) -> float:
        """Maximum over all repeats of the delay of 95 % of the samples sent; infinity if one is missing."""
        if self.delay is None or self.delay.sample is None or self.delay.missing:
            return math.inf
        return float(self.delay.sample.high.max())

    def __str__(self) -> str:
        return f"{self.place}, {self.size_bytes:g} B"


def topic_columns(rows: Repeats, prefix: str) -> Repeats:
    """Return the columns of one topic that `link_cell` needs, without the prefix of its step; missing ones are NaN.

    Args:
        rows: Attempts of a trial.
        prefix: Prefix of the step's columns.
    """
    all_missing = np.full(len(rows), np.nan)

    def values(name: str) -> NDArray[np.float64]:
        return np.asarray(rows.numbers.get(step_prefixed(prefix, name), all_missing), dtype=np.float64)

    names = ("topic_sent", "topic_refused", "topic_skipped", "topic_received", _DELAY.name, _DELAY.of_sent or "")
    texts = {"status": rows.texts["status"], SOURCE: rows.texts[SOURCE]}
    return Repeats({name: values(name) for name in names}, texts, ())


def link_cell(place: str, size_bytes: float, tables: Sequence[Repeats]) -> LinkCell:
    """Return the estimates of one candidate, size and place.

    Args:
        place: Description of the place.
        size_bytes: Data bytes per sample.
        tables: Attempts, as `topic_columns` returns them.
    """
    numbers = {name: np.concatenate([table.numbers[name] for table in tables]) for name in tables[0].numbers}
    texts = {name: np.concatenate([table.texts[name] for table in tables]) for name in tables[0].texts}
    intended_samples = numbers["topic_sent"] + numbers["topic_refused"] + numbers["topic_skipped"]
    # The loss of a repeat in which no sample was due is undefined, so it has no value.
    numbers[_INTENDED] = np.where(intended_samples > 0, intended_samples, np.nan)
    numbers[_LOSS.name] = (numbers[_INTENDED] - numbers["topic_received"]) / numbers[_INTENDED]
    texts[_CELL] = np.full(len(intended_samples), place, dtype=np.object_)
    (cell,) = aggregate(Repeats(numbers, texts, ()), (_CELL,), quantities=(_LOSS, _DELAY), words=())
    return LinkCell(place, size_bytes, tuple(dict.fromkeys(map(str, texts[SOURCE]))), cell)


def estimate_text(estimate: Estimate | None, factor: float) -> str:
    """Return an estimate with its 95 % interval and the values of the repeats, times `factor`; `unknown` for None."""
    if estimate is None or estimate.sample is None:
        return "unknown"
    low, high = (f"{factor * end:.2f}" if end is not None else "unknown" for end in (estimate.low, estimate.high))
    # A repeat whose value is only a lower bound is shown with this bound.
    repeats = ", ".join(f"{factor * value:.1f}" for value in estimate.sample.low.tolist())
    missing = f", unknown in {estimate.missing}" if estimate.missing else ""
    return f"{factor * estimate.value:.2f} [{low}, {high}], by repeat {repeats}{missing}"
