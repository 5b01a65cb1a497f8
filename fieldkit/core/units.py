"""Parsing and formatting of quantities with units, such as `30ft`, `200ms` and `20Mbit/s`; values are in SI units."""

import re
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from typing import Final

from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Distance

# The foot is exact by definition (international yard and pound agreement, 1959).
METRES_PER_UNIT: Final = {"m": 1.0, "ft": 0.3048, "km": 1000.0, "cm": 0.01, "mm": 0.001}
SECONDS_PER_UNIT: Final = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0}
HERTZ_PER_UNIT: Final = {"Hz": 1.0, "kHz": 1e3}
METRES_PER_S_PER_UNIT: Final = {"m/s": 1.0, "km/h": 1 / 3.6, "ft/s": 0.3048, "cm/s": 0.01}
BITS_PER_S_PER_UNIT: Final = {"bit/s": 1.0, "kbit/s": 1e3, "Mbit/s": 1e6, "Gbit/s": 1e9}
BYTES_PER_UNIT: Final = {"B": 1.0, "kB": 1e3, "MB": 1e6, "GB": 1e9, "KiB": 1024.0, "MiB": 2.0**20, "GiB": 2.0**30}
FRACTION_PER_UNIT: Final = {"%": 0.01}

_MAX_VALUE: Final = 1e11
"""Upper bound of any quantity, in the unit whose factor is 1. Times above 3,000 years make timers overflow."""

_QUANTITY: Final = re.compile(
    # Possessive quantifiers prevent backtracking over long runs of blanks.
    r"\s*+(?P<number>\d{1,15}(?:\.\d{1,30})?|\.\d{1,30})\s*+(?P<unit>[A-Za-z%/]*+)\s*+\Z",
    re.ASCII,
)


def parse_quantity(text: str, units: dict[str, float], what: str) -> float:
    """Return `text`, a non-negative number with one of `units`, in the unit whose factor is 1.

    The value is the float nearest to the exact product, so `13ms` equals 0.013.

    Args:
        text: For example `15s`, `0.2 s`, `30ft`.
        units: Factor by unit symbol; the shortest decimal text of a factor is used as its exact value.
        what: The kind of quantity, or the command-line option, for the message.

    Raises:
        ConfigurationError: The number or the unit is missing, the unit is unknown, or the value exceeds `_MAX_VALUE`.
    """
    match = _QUANTITY.match(text)
    example = f"write for example {_example(match['number'] if match else '15', units)}; units are {', '.join(units)}"
    if match is None and text.lstrip().startswith("-"):
        raise ConfigurationError(f"{what} {text.strip()[:40]!r} is below zero", remedy=example)
    if match is None:
        raise ConfigurationError(f"{text[:40]!r} is not a {what}", remedy=example)
    if not match["unit"]:
        raise ConfigurationError(f"{what} {text!r} has no unit", remedy=example)
    if match["unit"] not in units:
        raise ConfigurationError(f"{what} {text!r} has the unknown unit {match['unit']!r}", remedy=example)
    value = float(Fraction(match["number"]) * Fraction(repr(units[match["unit"]])))
    if value > _MAX_VALUE:
        raise ConfigurationError(f"{what} {text[:40]!r} is too large", remedy="check the unit")
    return value


def _example(number: str, units: dict[str, float]) -> str:
    """Return the number with units, as a suggestion: `30m or 30ft`."""
    if next(iter(units)) == "%" and float(number) < 1:
        return f"{plain_number(100 * float(number), 6)}%"  # the number is probably a fraction
    return " or ".join(f"{number[:20]}{unit}" for unit in list(units)[:2])


def parse_distance(text: str) -> Distance:
    """Return a distance whose label is the operator's text without spaces.

    Raises:
        ConfigurationError: `text` is not a length with a unit, or not above zero.
    """
    metres = parse_quantity(text, METRES_PER_UNIT, "distance")
    if metres <= 0:
        raise ConfigurationError(f"distance {text!r} is not above zero", remedy="write for example 30ft or 9.1m")
    return Distance(metres=metres, label="".join(text.split()))


def parse_offset_m(text: str) -> float:
    """Return a length in metres that may be negative, `-30ft`. Raises the same errors as `parse_quantity`."""
    length_m = parse_quantity(text.removeprefix("-"), METRES_PER_UNIT, "length")
    return -length_m if text.startswith("-") else length_m


def plain_number(value: float, digits: int = 12) -> str:
    """Return a number without an exponent, as `parse_quantity` reads it: `0.0000002`, `1000000`.

    Args:
        value: The number.
        digits: Number of significant digits.
    """
    return f"{Decimal(f'{value:.{digits}g}'):f}"


def format_distance(distance: Distance) -> str:
    """Return a distance in the operator's unit, and also in metres if that is another unit: `40 ft (12.19 m)`."""
    label = re.sub(r"(?<=[\d.])(?=[a-z])", " ", distance.label)
    metres = f"{distance.metres:.2f} m"
    return label if label.endswith(" m") else f"{label} ({metres})"


def parse_duration_s(text: str, what: str = "duration") -> float:
    """Return a duration in seconds; see `parse_quantity` for `what` and the errors."""
    return parse_quantity(text, SECONDS_PER_UNIT, what)


def format_count(count: int, noun: str) -> str:
    """Return a count with its noun: `1 repeat`, `3 repeats`."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def format_duration(seconds: float) -> str:
    """Return a duration as text: `0.4 s`, `12 s`, `3 min 05 s`, `1 h 02 min`."""
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    whole_s = round(seconds)
    if whole_s < 60:
        return f"{whole_s} s"
    if whole_s < 3600:
        return f"{whole_s // 60} min {whole_s % 60:02d} s"
    return f"{whole_s // 3600} h {whole_s % 3600 // 60:02d} min"


_CERTAIN_RATIO: Final = 1.2
"""An upper estimate is shown if it is above this multiple of the likely duration."""


@dataclass(frozen=True)
class TimeEstimate:
    """Estimate of a duration.

    Attributes:
        likely_s: Expected duration.
        most_s: Upper estimate. It does not include repeats that must be run again.
    """

    likely_s: float
    most_s: float

    @property
    def is_certain(self) -> bool:
        """Whether the upper estimate is close to the expected duration."""
        return self.most_s <= _CERTAIN_RATIO * self.likely_s

    def __str__(self) -> str:
        """Return the duration as text: `4 min 00 s`, followed by `, up to 19 min 00 s` if that is clearly more."""
        upper_text = "" if self.is_certain else f", up to {format_duration(self.most_s)}"
        return f"{format_duration(self.likely_s)}{upper_text}"


def format_bytes(size_bytes: float) -> str:
    """Return a size as text: `0.2 kB`, `35 MB`, `1.2 GB`."""
    for unit in ("kB", "MB", "GB"):
        size_bytes /= 1000
        if size_bytes < 1000 or unit == "GB":
            break
    return f"{size_bytes:.1f} {unit}" if size_bytes < 10 else f"{size_bytes:.0f} {unit}"
