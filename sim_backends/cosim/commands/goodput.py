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

_NUMBERS: Final = {"signal_dbm": (-200.0, 100.0), "phy_rate_bit_s": (0.0, 1e12), "goodput_bit_s": (0.0, 1e12)}
"""Smallest and largest valid number of each column."""
_INTEGERS: Final = {"width_mhz": (1, 1000), "streams": (1, 16), "guard_interval_ns": (1, 10_000), "mcs": (0, 100)}
"""Smallest and largest valid integer of each column."""
_TEXTS: Final = ("standard", "protocol")
_SMALLEST_GOODPUT_BIT_S: Final = 1e-3
"""Smaller goodputs are 0: they have no relative error."""
_SHOWN_LINKS: Final = 30
"""Largest number of links that are printed one by one as a table."""
_MAX_SHOWN: Final = 40
"""Largest number of characters of a cell in a message."""
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

    Other columns are ignored; an empty cell has the default of `LoggedLink`. Signals are rounded. The file can begin
    with a byte order mark, and names of columns can be surrounded by spaces.

    Raises:
        ConfigurationError: The file cannot be read, has no column `signal_dbm` or two of them, a row has more or
            fewer cells than the header, or it contains an invalid number.
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file)
            names = [name.strip() for name in next(reader, [])]
            _check_names(names, path)
            rows = []
            for cells in reader:
                where = f"{path}:{reader.line_num}"
                if not cells:
                    continue  # an empty line
                if len(cells) != len(names):
                    raise ConfigurationError(
                        f"{len(cells)} cells in a table of {len(names)} columns",
                        where=where,
                        remedy="write points in numbers, not commas, and a cell for each column",
                    )
                rows.append(_read_row(dict(zip(names, cells, strict=True)), where, reader.line_num))
            return rows
    except OSError as error:
        raise ConfigurationError(f"the log cannot be read: {error.strerror}", where=str(path)) from error
    except UnicodeDecodeError as error:
        raise ConfigurationError("the log is not UTF-8", where=str(path), remedy="save it as UTF-8") from error
    except csv.Error as error:
        raise ConfigurationError(f"the log is not a CSV file: {error}", where=str(path)) from error


def _check_names(names: Sequence[str], path: Path) -> None:
    """Raise ConfigurationError if the signal is missing, or a column that is used occurs twice."""
    used_names = (*_NUMBERS, *_INTEGERS, *_TEXTS)
    if repeated := next((name for name in used_names if names.count(name) > 1), None):
        raise ConfigurationError(
            f"two columns have the name {repeated}", where=str(path), remedy="remove or rename one of them"
        )
    if "signal_dbm" not in names:
        remedy = f"the columns are {', '.join(used_names)}; the first is required"
        if any(separator in name for name in names for separator in ";\t"):
            remedy = "separate the cells by commas, and write points in numbers"
        raise ConfigurationError("there is no column signal_dbm", where=str(path), remedy=remedy)


def _read_row(cells: Mapping[str, str], where: str, line: int) -> _Row:
    values: dict[str, Any] = {}
    for name in (*_NUMBERS, *_INTEGERS, *_TEXTS):
        text = cells.get(name, "").strip()
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
    low, high = (_NUMBERS | _INTEGERS)[name]
    if not low <= value <= high or (name in _INTEGERS and not value.is_integer()):
        kind = "an integer" if name in _INTEGERS else "a number"
        raise ConfigurationError(
            f"{name} is {text[:_MAX_SHOWN]!r}",
            where=where,
            remedy=f"write {kind} from {low:g} to {high:g}, or leave the cell empty",
        )
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
        has_error = row.measured_bit_s >= _SMALLEST_GOODPUT_BIT_S
        error = predicted_bit_s / row.measured_bit_s - 1 if has_error else math.nan
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
    mean_bit_s = float(measured_bit_s.mean())
    yield mean_bit_s
    yield float(predicted_bit_s.mean())
    yield float(predicted_bit_s.mean()) / mean_bit_s - 1 if mean_bit_s >= _SMALLEST_GOODPUT_BIT_S else math.nan
    positive = measured_bit_s >= _SMALLEST_GOODPUT_BIT_S
    errors = np.abs(predicted_bit_s[positive] / measured_bit_s[positive] - 1)
    yield from (float(np.quantile(errors, share)) if len(errors) else math.nan for share in (0.5, 0.9))
