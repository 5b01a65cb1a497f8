"""Output of `iw` and of the kernel about a Wi-Fi link: its stations and its channel.

iw's lines are those of its station.c, link.c and survey.c, the same in versions 3 to 6 but for lines that came later;
drivers leave out what they do not know. A power of 0 dBm or more is none that a radio receives: drivers that do
not know it print 0, or a share in per cent.
"""

import re
from collections.abc import Callable, Mapping
from typing import Final, TypeVar

from fieldkit.core.model import StationSample

T = TypeVar("T")

_STATION: Final = re.compile(r"^Station (\S{1,40}) \(on ", re.MULTILINE)
_CONNECTED: Final = re.compile(r"^Connected to (\S{1,40}) \(on ", re.MULTILINE)
_SURVEY: Final = re.compile(r"^Survey data from ", re.MULTILINE)
# Of a line each, never `\s`: that goes on through empty lines.
_LINE: Final = re.compile(r"^[ \t]*([A-Za-z ]{1,30}):[ \t]*(\S[^\n]{0,200})$", re.MULTILINE)
_COUNT: Final = re.compile(r"([0-9]{1,18})\b", re.ASCII)
_POWER: Final = re.compile(r"(-[0-9]{1,3})(?:\.[0-9]{1,2})?\b(?: \[[^\]\n]{0,60}\])? ?dBm", re.ASCII)
_RATE: Final = re.compile(r"([0-9]{1,6}(?:\.[0-9]{1,2})?) MBit/s", re.ASCII)
_LINK_PACKETS: Final = re.compile(r"[0-9]{1,18} bytes \(([0-9]{1,18}) packets\)", re.ASCII)
_WEXT: Final = re.compile(r"[0-9a-f]{4} +-?[0-9]{1,4}\.? +(-[0-9]{1,3})\.? +(-?[0-9]{1,4})\.? ", re.ASCII)
_NO_NOISE: Final = -256.0
_MS: Final = 1_000_000


def stations(text: str) -> tuple[StationSample, ...]:
    """Return what `iw dev INTERFACE station dump`, or `station get`, says."""
    parts = _STATION.split(text)
    return tuple(_station(name, _lines(said)) for name, said in zip(parts[1::2], parts[2::2], strict=True))


def _station(name: str, lines: Mapping[str, str]) -> StationSample:
    return StationSample(
        station=name.lower(),
        signal_dbm=_found(_POWER, lines, "signal", float),
        tx_rate_bit_s=_rate_bit_s(lines, "tx bitrate"),
        rx_rate_bit_s=_rate_bit_s(lines, "rx bitrate"),
        tx_packets=_found(_COUNT, lines, "tx packets", int),
        rx_packets=_found(_COUNT, lines, "rx packets", int),
        tx_retries=_found(_COUNT, lines, "tx retries", int),
        tx_failures=_found(_COUNT, lines, "tx failed", int),
        beacon_losses=_found(_COUNT, lines, "beacon loss", int),
    )


def cell(text: str) -> StationSample | None:
    """Return what `iw dev INTERFACE link` says of the access point that it is joined to; None without one."""
    if (joined := _CONNECTED.search(text)) is None:
        return None
    lines = _lines(text[joined.end() :])
    return StationSample(
        station=joined[1].lower(),
        signal_dbm=_found(_POWER, lines, "signal", float),
        tx_rate_bit_s=_rate_bit_s(lines, "tx bitrate"),
        rx_rate_bit_s=_rate_bit_s(lines, "rx bitrate"),
        tx_packets=_found(_LINK_PACKETS, lines, "TX", int),
        rx_packets=_found(_LINK_PACKETS, lines, "RX", int),
    )


def channel(text: str) -> tuple[float | None, int | None, int | None]:
    """Return noise in dBm, active and busy time in ns of the channel in use; None each, where they are not told."""
    for said in _SURVEY.split(text)[1:]:
        lines = _lines(said)
        if "[in use]" in lines.get("frequency", ""):
            active_ms = _found(_COUNT, lines, "channel active time", int)
            busy_ms = _found(_COUNT, lines, "channel busy time", int)
            times = (None, None) if active_ms is None or busy_ms is None else (active_ms * _MS, busy_ms * _MS)
            return _found(_POWER, lines, "noise", float), *times
    return None, None, None


def wireless(line: str) -> tuple[float | None, float | None]:
    """Return signal and noise in dBm as a line of /proc/net/wireless tells them behind the interface's name."""
    found = _WEXT.match(line)
    if found is None:
        return None, None
    signal_dbm, noise_dbm = float(found[1]), float(found[2])
    return signal_dbm, noise_dbm if _NO_NOISE < noise_dbm < 0 else None


def _lines(said: str) -> dict[str, str]:
    """Return lines `NAME: VALUE`; of several with a name, the first: those of single antennas and links follow."""
    lines: dict[str, str] = {}
    for name, value in _LINE.findall(said):
        lines.setdefault(name, value)
    return lines


def _found(pattern: re.Pattern[str], lines: Mapping[str, str], name: str, kind: Callable[[str], T]) -> T | None:
    match = pattern.match(lines.get(name, ""))
    return None if match is None else kind(match[1])


def _rate_bit_s(lines: Mapping[str, str], name: str) -> float | None:
    rate = _found(_RATE, lines, name, float)
    return rate * 1e6 if rate else None
