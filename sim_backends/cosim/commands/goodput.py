"""The command `fieldkit cosim goodput`: predictions of logged Wi-Fi links, and their errors."""

import argparse
import csv
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from fieldkit.cli.display import show_note, showing_progress
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.units import format_count
from sim_backends.cosim.commands import settings
from sim_backends.cosim.commands.settings import progress_reporter
from sim_backends.cosim.commands.sheets import Sheet, SheetColumn, SheetPart, show_all
from sim_backends.cosim.studies.link_goodput import SIGNAL_STEP_DB, LoggedLink, predict_goodputs_bit_s

_NUMBERS: Final = ("signal_dbm", "phy_rate_bit_s", "goodput_bit_s")
_INTEGERS: Final = ("width_mhz", "streams", "guard_interval_ns", "mcs")
_TEXTS: Final = ("standard", "protocol")
_SHOWN_LINKS: Final = 30
"""Largest number of links that are printed one by one as a table."""
_NO_SIGNAL: Final = "the log has no signal"


@dataclass(frozen=True)
class _Row:
    """A row of the log.

    Attributes:
        line: Its line in the file.
        link: The link; None without a signal.
        measured_bit_s: Measured goodput; nan if it is unknown.
    """

    line: int
    link: LoggedLink | None
    measured_bit_s: float


def run(arguments: argparse.Namespace) -> int:
    """Predict the goodput of each link, and print the predictions and their errors."""
    rows = read_log(arguments.log)
    links = list(dict.fromkeys(row.link for row in rows if row.link is not None))
    with showing_progress() as sink:
        progress = partial(progress_reporter(sink), "goodput", len(links))
        goodputs_bit_s = predict_goodputs_bit_s(
            links, settings.read_changes(arguments), workers=settings.read_workers(arguments), progress=progress
        )
    reasons = Counter(reason for row in rows if (reason := _reason(row, goodputs_bit_s)) is not None)
    if reasons.total() == len(rows):
        raise ConfigurationError(
            f"no goodput can be predicted: {reasons.most_common(1)[0][0]}" if rows else "the log has no rows",
            where=str(arguments.log),
        )
    sheets = {"links": _links_sheet(rows, goodputs_bit_s), "errors": _errors_sheet(rows, goodputs_bit_s)}
    if all(math.isnan(row.measured_bit_s) for row in rows):
        del sheets["errors"]
    elif arguments.format in {"table", "markdown"} and len(rows) > _SHOWN_LINKS:
        del sheets["links"]
        show_note("--format csv prints the prediction of each link")
    show_all(sheets, arguments.format)
    for reason, count in reasons.most_common():
        show_note(f"no prediction for {format_count(count, 'row')}: {reason}")
    if count := sum(_exceeds_phy_rate(row, goodputs_bit_s) for row in rows):
        show_note(
            f"the measured goodput of {format_count(count, 'row')} exceeds the PHY rate, so this rate was not logged "
            "during the measurement"
        )
    return 0


def read_log(path: Path) -> list[_Row]:
    """Return the rows of a CSV file with the columns of `LoggedLink` and, if measured, `goodput_bit_s`.

    Other columns are ignored; an empty cell has the default of `LoggedLink`. Signals are rounded.

    Raises:
        ConfigurationError: The file cannot be read, has no column `signal_dbm`, or contains an invalid number.
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            reader = csv.DictReader(file)
            if "signal_dbm" not in (reader.fieldnames or ()):
                raise ConfigurationError(
                    "there is no column signal_dbm",
                    where=str(path),
                    remedy=f"the columns are {', '.join((*_NUMBERS, *_INTEGERS, *_TEXTS))}; the first is required",
                )
            return [_read_row(cells, f"{path}:{reader.line_num}", reader.line_num) for cells in reader]
    except OSError as error:
        raise ConfigurationError(f"the log cannot be read: {error.strerror}", where=str(path)) from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise ConfigurationError(f"the log is not a CSV file: {error}", where=str(path)) from error


def _read_row(cells: Mapping[str, str | None], where: str, line: int) -> _Row:
    values: dict[str, Any] = {}
    for name in (*_NUMBERS, *_INTEGERS, *_TEXTS):
        text = (cells.get(name) or "").strip()
        if text.lower() not in {"", "nan"}:
            values[name] = text if name in _TEXTS else _number(name, text, where)
    measured_bit_s = values.pop("goodput_bit_s", math.nan)
    if "signal_dbm" not in values:
        return _Row(line, None, measured_bit_s)
    values["signal_dbm"] = round(values["signal_dbm"] / SIGNAL_STEP_DB) * SIGNAL_STEP_DB
    return _Row(line, LoggedLink(**values), measured_bit_s)


def _number(name: str, text: str, where: str) -> float | int:
    """Return a number; programs such as pandas write integers of columns with empty cells as `7.0`."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or (name in _INTEGERS and not value.is_integer()):
        kind = "an integer" if name in _INTEGERS else "a number"
        raise ConfigurationError(f"{name} is {text!r}", where=where, remedy=f"write {kind}, or leave the cell empty")
    return int(value) if name in _INTEGERS else value


def _reason(row: _Row, goodputs_bit_s: Mapping[LoggedLink, float | ConfigurationError]) -> str | None:
    """Return the reason why a row has no prediction; None if it has one."""
    if row.link is None:
        return _NO_SIGNAL
    goodput_bit_s = goodputs_bit_s[row.link]
    return goodput_bit_s.what if isinstance(goodput_bit_s, ConfigurationError) else None


def _exceeds_phy_rate(row: _Row, goodputs_bit_s: Mapping[LoggedLink, float | ConfigurationError]) -> bool:
    """Return True if the measured goodput is impossible with the logged mode."""
    if row.link is None or _reason(row, goodputs_bit_s) is not None or (mode := row.link.mode()) is None:
        return False
    return row.measured_bit_s > mode.rate_bit_s


def _predicted_bit_s(row: _Row, goodputs_bit_s: Mapping[LoggedLink, float | ConfigurationError]) -> float:
    """Return the predicted goodput of a row; nan if it has none."""
    goodput_bit_s = math.nan if row.link is None else goodputs_bit_s[row.link]
    return goodput_bit_s if isinstance(goodput_bit_s, float) else math.nan


_MEASURED: Final = SheetColumn("goodput_bit_s", "measured (Mbit/s)", "", 1e-6)
_PREDICTED: Final = SheetColumn("predicted_goodput_bit_s", "predicted (Mbit/s)", "", 1e-6)
_LINK_COLUMNS: Final = (
    SheetColumn("line", "line", ""),
    SheetColumn("signal_dbm", "signal (dBm)", f"rounded to {SIGNAL_STEP_DB:g} dB"),
    SheetColumn("standard", "standard", ""),
    SheetColumn("width_mhz", "width (MHz)", ""),
    SheetColumn("mode", "mode", "mode of all frames; empty if minstrel_ht selects the modes"),
    SheetColumn("protocol", "protocol", ""),
    _MEASURED,
    _PREDICTED,
    SheetColumn("error", "error (%)", "predicted goodput relative to the measured one, minus 100 %", 100.0),
    SheetColumn("reason", "reason", "reason why there is no prediction"),
)
_ERROR_COLUMNS: Final = (
    SheetColumn("standard", "standard", ""),
    SheetColumn("width_mhz", "width (MHz)", ""),
    SheetColumn("protocol", "protocol", ""),
    SheetColumn("rows", "rows", ""),
    SheetColumn(
        "compared", "compared", "rows with a prediction and a measurement; all further columns use these rows"
    ),
    SheetColumn("mean_goodput_bit_s", "measured (Mbit/s)", "mean", 1e-6),
    SheetColumn("mean_predicted_bit_s", "predicted (Mbit/s)", "mean", 1e-6),
    SheetColumn("mean_error", "error of mean (%)", "mean prediction relative to the mean measurement", 100.0),
    SheetColumn("median_error", "median |error| (%)", "median of the magnitudes of the relative errors", 100.0),
    SheetColumn("p90_error", "90th percentile |error| (%)", "of these magnitudes", 100.0),
)


def _links_sheet(rows: Sequence[_Row], goodputs_bit_s: Mapping[LoggedLink, float | ConfigurationError]) -> Sheet:
    values = []
    for row in rows:
        link, reason = row.link, _reason(row, goodputs_bit_s)
        predicted_bit_s = _predicted_bit_s(row, goodputs_bit_s)
        mode = None if link is None or reason is not None else link.mode()
        error = predicted_bit_s / row.measured_bit_s - 1 if row.measured_bit_s > 0 else math.nan
        values.append(
            (
                row.line,
                *((None,) * 3 if link is None else (link.signal_dbm, link.standard, link.width_mhz)),
                "" if mode is None else mode.name,
                None if link is None else link.protocol,
                row.measured_bit_s,
                predicted_bit_s,
                error,
                reason or "",
            )
        )
    cells_by_name = zip(_names(_LINK_COLUMNS), zip(*values, strict=True), strict=True)
    hidden = {"reason"} | {
        name for name, cells in cells_by_name if all(map(_is_empty, cells))
    }  # notes show the reasons
    if len({row.link.protocol for row in rows if row.link is not None}) == 1:
        hidden.add("protocol")
    if all(value[_names(_LINK_COLUMNS).index("mode")] for value in values):
        hidden.add("width_mhz")  # the modes contain it
    shown = [name for name in _names(_LINK_COLUMNS) if name not in hidden]
    return Sheet(_LINK_COLUMNS, values, [SheetPart("predicted goodput of each link", shown)])


def _names(columns: Sequence[SheetColumn]) -> list[str]:
    return [column.name for column in columns]


def _is_empty(value: object) -> bool:
    return value is None or value == "" or (isinstance(value, float) and math.isnan(value))


def _errors_sheet(rows: Sequence[_Row], goodputs_bit_s: Mapping[LoggedLink, float | ConfigurationError]) -> Sheet:
    """Return the errors of links with the same standard, width and protocol."""
    groups: dict[tuple[str, int, str], list[_Row]] = {}
    for row in rows:
        if row.link is not None:
            groups.setdefault((row.link.standard, row.link.width_mhz, row.link.protocol), []).append(row)
    values = [(*key, len(group), *_errors(group, goodputs_bit_s)) for key, group in sorted(groups.items())]
    title = "errors of the predictions"
    return Sheet(_ERROR_COLUMNS, values, [SheetPart(title, _names(_ERROR_COLUMNS))])


def _errors(
    group: Sequence[_Row], goodputs_bit_s: Mapping[LoggedLink, float | ConfigurationError]
) -> Iterator[float | int]:
    """Yield the values of the summary from `compared` on; a measurement of 0 has no relative error."""
    pairs = np.array([(row.measured_bit_s, _predicted_bit_s(row, goodputs_bit_s)) for row in group])
    measured_bit_s, predicted_bit_s = pairs[np.isfinite(pairs).all(axis=1)].T
    yield len(measured_bit_s)
    if not len(measured_bit_s):
        yield from (math.nan,) * 5
        return
    yield float(measured_bit_s.mean())
    yield float(predicted_bit_s.mean())
    yield float(predicted_bit_s.mean() / measured_bit_s.mean() - 1) if measured_bit_s.any() else math.nan
    positive = measured_bit_s > 0
    errors = np.abs(predicted_bit_s[positive] / measured_bit_s[positive] - 1)
    yield from (float(np.quantile(errors, share)) if len(errors) else math.nan for share in (0.5, 0.9))
