"""Columns of the link of a robot whose profile has telemetry sources.

The columns of a source replace the columns of `iw` or of the testbed, because the source reports the radio under
test. If the source failed, its columns are empty. All other columns remain.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import median
from typing import Final

from fieldkit.core.columns import BACKGROUND, Column, Figure, Kind, Measured, Value, cell_text, columns
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.evidence import link, link_samples
from fieldkit.telemetry import source_readings
from fieldkit.telemetry.source_readings import SourceReadings
from fieldkit.telemetry.telemetry_section import TelemetrySection, TelemetrySource

_MAX_TEXTS: Final = 4
"""Maximum number of different texts in a value; the number of further texts is appended."""


def _role_columns(role: Role) -> tuple[Column, ...]:
    return columns(
        150,
        (
            f"{role}_link_source",
            "text",
            (
                f"Telemetry sources of the {role}'s profile that gave values: NAME (KIND): VALUES. `others` "
                "names the source of the other columns of its radio: `iw`, or `testbed` for an emulated robot."
            ),
            Figure(f"link source, {role}", Kind.WORDS, rank=BACKGROUND),
        ),
        (
            f"{role}_sinr_median_db",
            "dB",
            f"Median over the repeat of the ratio of signal to interference and noise at the {role}'s radio.",
            Figure(f"SINR, {role}", Kind.MEDIAN, rank=BACKGROUND),
            (-100.0, 200.0),
        ),
        (f"{role}_sinr_min_db", "dB", f"Smallest such ratio at the {role}'s radio.", (-100.0, 200.0)),
        (
            f"{role}_band",
            "text",
            f"Access technology, band or channel of the {role}'s radio; several if it changed, in their order.",
            Figure(f"band, {role}", Kind.WORDS, rank=BACKGROUND + 4),
        ),
        (
            f"{role}_cell",
            "text",
            f"Cell or access point of the {role}'s radio; several if it changed, in their order.",
        ),
        (
            f"{role}_neighbours_min",
            "count",
            f"Smallest number of other cells, stations or mesh nodes that the {role}'s radio received.",
            Figure(f"neighbours, {role}", Kind.MEDIAN, rank=BACKGROUND + 4),
        ),
        (f"{role}_telemetry_samples", "count", f"Answers of the {role}'s telemetry sources that gave a value."),
    )


_COLUMNS: Final = {role: _role_columns(role) for role in link.ROLES}
COLUMNS: Final = tuple(column for role_columns in _COLUMNS.values() for column in role_columns)
_COLUMNS_BY_NAME: Final = {column.name: column for column in (*link.COLUMNS, *COLUMNS)}


def of_role(role: Role) -> tuple[Column, ...]:
    """Return the columns of a role that a trial has only if a profile has telemetry sources."""
    return _COLUMNS[role]


@dataclass(frozen=True)
class TelemetryResult:
    """Columns of a robot's link, and the failures of its sources.

    Attributes:
        measured: Columns of `link` with the values of the sources, and the columns of `of_role`.
        notes: A sentence for each source that gave no value, or not all values that the profile locates.
    """

    measured: Measured
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Series:
    """Values of one quantity in the order of time, and the reason why some or all are missing."""

    values: Sequence[float | str]
    reason: str


def measure(role: Role, telemetry: TelemetrySection, evidence: AttemptEvidence, base: Measured) -> TelemetryResult:
    """Return the columns of one robot.

    Args:
        role: One of `link.ROLES`.
        telemetry: The section of its profile.
        evidence: The attempt.
        base: Columns from the robot's `iw` or from the testbed.
    """
    series: dict[str, _Series] = {}
    source_texts: list[str] = []
    notes: list[str] = []
    samples = 0
    for name, source in telemetry.sources.items():
        readings, reason = _read(evidence, role, name, source)
        samples += len(readings.values)
        # Only the first source that declares a quantity is used for it.
        source_series = {
            quantity: _Series(
                [values[quantity] for values in readings.values if quantity in values],
                f"telemetry {name}: {reason or 'it does not report it'}",
            )
            for quantity in source.quantities
            if quantity not in series
        }
        series |= source_series
        if measured_quantities := [
            quantity for quantity, quantity_series in source_series.items() if quantity_series.values
        ]:
            wired_text = f", queries on the interface under test to {source.address}" if source.wired else ""
            source_texts.append(f"{name} ({source.kind}{wired_text}): {' '.join(measured_quantities)}")
        if not readings.values:
            notes.append(f"telemetry {name} of the {role} gave no value: {reason or 'no query ended'}")
        elif absent := source.absent_quantities(readings.values):
            notes.append(f"telemetry {name} of the {role} gave no possible value of {', '.join(absent)}")
    source_columns = _measured(role, series)
    # The columns of the sources, with or without a value, replace those of `base`.
    remaining = base.without(dict.fromkeys(source_columns.values, "") | dict(source_columns.missing))
    if remaining.values:
        source_texts.append(f"others: {'testbed' if evidence.has(link_samples.FILE) else 'iw'}")
    role_columns = Measured.from_optional(
        {f"{role}_link_source": "; ".join(source_texts) or None, f"{role}_telemetry_samples": samples},
        "no source gave a value",
    )
    missing_columns = Measured.all_missing(of_role(role), "no telemetry source of the profile gives it")
    return TelemetryResult(source_columns | role_columns | remaining | missing_columns, tuple(notes))


def _measured(role: Role, series: Mapping[str, _Series]) -> Measured:
    """Return the columns of the sources' values; an impossible value is missing."""
    values: dict[str, Value] = {}
    missing: dict[str, str] = {}
    for quantity, quantity_series in series.items():
        for column, value in _columns(quantity, quantity_series.values).items():
            name = f"{role}_{column}"
            if value is None:
                missing[name] = quantity_series.reason
            elif _COLUMNS_BY_NAME[name].invalid_value_reason(cell_text(value)):
                missing[name] = (
                    f"{quantity_series.reason.partition(':')[0]}: its value {cell_text(value)} is impossible"
                )
            else:
                values[name] = value
    return Measured(values, missing)


def _read(evidence: AttemptEvidence, role: Role, name: str, source: TelemetrySource) -> tuple[SourceReadings, str]:
    """Return the readings of a source, and the most frequent reason why runs gave no value."""
    try:
        readings = evidence.read(source_readings.read, "", role, name, source)
    except EvidenceError as error:
        return SourceReadings((), 0, Counter()), error.what
    return readings, readings.reason


def _columns(quantity: str, series: Sequence[float | str]) -> Mapping[str, Value | None]:
    """Return the columns of a quantity without the prefix of the role; None without a value."""
    numbers = [value for value in series if isinstance(value, float)]
    texts = [value for value in series if isinstance(value, str)]
    median_value, minimum = (median(numbers), min(numbers)) if numbers else (None, None)
    match quantity:
        case "signal_dbm":
            last = numbers[-1] if numbers else None
            return {"signal_median_dbm": median_value, "signal_min_dbm": minimum, "signal_last_dbm": last}
        case "sinr_db":
            return {"sinr_median_db": median_value, "sinr_min_db": minimum}
        case "cell":
            roams = sum(before != after for before, after in pairwise(texts)) if texts else None
            return {"cell": _join_distinct(texts), "roams": roams}
        case "band":
            return {"band": _join_distinct(texts)}
        case "neighbours":
            return {"neighbours_min": None if minimum is None else round(minimum)}
        case _:  # noise_dbm, tx_rate_bit_s, rx_rate_bit_s
            return {quantity: median_value}


def _join_distinct(texts: Sequence[str]) -> str | None:
    distinct = list(dict.fromkeys(texts))
    if not distinct:
        return None
    more_text = f" and {len(distinct) - _MAX_TEXTS} more" if len(distinct) > _MAX_TEXTS else ""
    return " / ".join(distinct[:_MAX_TEXTS]) + more_text
