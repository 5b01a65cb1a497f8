"""Parsers for the output of `iw` and for /proc/net/wireless: stations and channel of a Wi-Fi link.

The lines are those of iw's station.c, link.c and survey.c, equal in versions 3 to 6 except for later additions.
Drivers omit values that they do not support. A received power of 0 dBm or more is invalid: some drivers print 0, or a
percentage.
"""

import re
from collections.abc import Callable, Mapping
from typing import Final, TypeVar

from fieldkit.core.model import StationSample

T = TypeVar("T")

_STATION: Final = re.compile(r"^Station (\S{1,40}) \(on ", re.MULTILINE)
_CONNECTED: Final = re.compile(r"^Connected to (\S{1,40}) \(on ", re.MULTILINE)
_SURVEY: Final = re.compile(r"^Survey data from ", re.MULTILINE)
# Uses [ \t] instead of `\s`, which would also match line feeds.
_LINE: Final = re.compile(r"^[ \t]*([A-Za-z ]{1,30}):[ \t]*(\S[^\n]{0,200})$", re.MULTILINE)
_COUNT: Final = re.compile(r"([0-9]{1,18})\b", re.ASCII)
_POWER: Final = re.compile(r"(-[0-9]{1,3})(?:\.[0-9]{1,2})?\b(?: \[[^\]\n]{0,60}\])? ?dBm", re.ASCII)
_RATE: Final = re.compile(r"([0-9]{1,6}(?:\.[0-9]{1,2})?) MBit/s", re.ASCII)
_LINK_PACKETS: Final = re.compile(r"[0-9]{1,18} bytes \(([0-9]{1,18}) packets\)", re.ASCII)
_WIRELESS_LINE: Final = re.compile(r"[0-9a-f]{4} +-?[0-9]{1,4}\.? +(-[0-9]{1,3})\.? +(-?[0-9]{1,4})\.? ", re.ASCII)
_UNKNOWN_NOISE: Final = -256.0
_MS: Final = 1_000_000


def stations(text: str) -> tuple[StationSample, ...]:
    """Return the stations in the output of `iw dev INTERFACE station dump` or `station get`."""
    parts = _STATION.split(text)
    return tuple(_station(name, _lines(section)) for name, section in zip(parts[1::2], parts[2::2], strict=True))


def _station(name: str, lines: Mapping[str, str]) -> StationSample:
    return StationSample(
        station=name.lower(),
        signal_dbm=_parse_value(_POWER, lines, "signal", float),
        tx_rate_bit_s=_rate_bit_s(lines, "tx bitrate"),
        rx_rate_bit_s=_rate_bit_s(lines, "rx bitrate"),
        tx_packets=_parse_value(_COUNT, lines, "tx packets", int),
        rx_packets=_parse_value(_COUNT, lines, "rx packets", int),
        tx_retries=_parse_value(_COUNT, lines, "tx retries", int),
        tx_failures=_parse_value(_COUNT, lines, "tx failed", int),
        beacon_losses=_parse_value(_COUNT, lines, "beacon loss", int),
    )


def cell(text: str) -> StationSample | None:
    """Return the associated access point in the output of `iw dev INTERFACE link`; None if not associated."""
    if (connected := _CONNECTED.search(text)) is None:
        return None
    lines = _lines(text[connected.end() :])
    return StationSample(
        station=connected[1].lower(),
        signal_dbm=_parse_value(_POWER, lines, "signal", float),
        tx_rate_bit_s=_rate_bit_s(lines, "tx bitrate"),
        rx_rate_bit_s=_rate_bit_s(lines, "rx bitrate"),
        tx_packets=_parse_value(_LINK_PACKETS, lines, "TX", int),
        rx_packets=_parse_value(_LINK_PACKETS, lines, "RX", int),
    )


def channel(text: str) -> tuple[float | None, int | None, int | None]:
    """Return noise in dBm, active time in ns and busy time in ns of the channel in use; None if not reported.

    Args:
        text: Output of `iw dev INTERFACE survey dump`.
    """
    for section in _SURVEY.split(text)[1:]:
        lines = _lines(section)
        if "[in use]" in lines.get("frequency", ""):
            active_ms = _parse_value(_COUNT, lines, "channel active time", int)
            busy_ms = _parse_value(_COUNT, lines, "channel busy time", int)
            times = (None, None) if active_ms is None or busy_ms is None else (active_ms * _MS, busy_ms * _MS)
            return _parse_value(_POWER, lines, "noise", float), *times
    return None, None, None


def wireless(line: str) -> tuple[float | None, float | None]:
    """Return signal and noise in dBm from a line of /proc/net/wireless without the interface's name."""
    match = _WIRELESS_LINE.match(line)
    if match is None:
        return None, None
    signal_dbm, noise_dbm = float(match[1]), float(match[2])
    return signal_dbm, noise_dbm if _UNKNOWN_NOISE < noise_dbm < 0 else None


def _lines(text: str) -> dict[str, str]:
    """Return the values of lines `NAME: VALUE` by name, the first of each name; later ones are of single antennas."""
    lines: dict[str, str] = {}
    for name, value in _LINE.findall(text):
        lines.setdefault(name, value)
    return lines


def _parse_value(pattern: re.Pattern[str], lines: Mapping[str, str], name: str, kind: Callable[[str], T]) -> T | None:
    match = pattern.match(lines.get(name, ""))
    return None if match is None else kind(match[1])


def _rate_bit_s(lines: Mapping[str, str], name: str) -> float | None:
    rate = _parse_value(_RATE, lines, name, float)
    return rate * 1e6 if rate else None
