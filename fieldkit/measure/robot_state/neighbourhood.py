"""Channel of a robot's radio before and after an attempt, with other networks and airtime of others on this channel.

`iw dev INTERFACE scan freq MHZ passive` lists the networks that the radio receives on its channel (scan.c of iw),
without sending packets. A network with the state `associated` or `joined`, or with the address of the radio, is the
robots' network, and is not counted. `iw dev INTERFACE survey dump` is run twice, 0.5 s apart, while the robots send
nothing for the attempt. The time in which the channel was busy, minus the radio's transmissions, is the airtime of
others; it includes beacons of the robots' network. If a driver resets its counters, there is no value.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from fieldkit.core.columns import Measured, Value
from fieldkit.core.model import Role
from fieldkit.measure.robot_state.marks import RepeatMark
from fieldkit.measure.robot_state.snapshots import Snapshot

INFO_NAME: Final = "iw-info"
"""Name of the source with the output of `iw dev INTERFACE info`."""
REGULATORY_NAME: Final = "iw-reg"
"""Name of the source with the output of `iw reg get`."""
SCAN_NAME: Final = "iw-scan"
"""Name of the source with the networks on the channel."""
SURVEY_NAME: Final = "iw-survey"
"""Name of the source with two outputs of `iw dev INTERFACE survey dump`."""

SETTINGS: Final = ("channel", "regulatory_domain")
"""Settings of a radio that must not change during a trial."""

BUSY_CHANNEL: Final = "busy channel"
"""Name of a mark."""
BUSY_SHARE: Final = 0.2
"""A repeat is marked if others use more than this share of the airtime."""

_CHANNEL: Final = re.compile(
    r"^[ \t]*channel ([0-9]{1,3}) \(([0-9]{4,5})(?:\.[0-9])? MHz\), width: ([0-9]{1,3}) MHz(?: \(no HT\))?"
    r"(?:, center1: ([0-9]{4,5}))?",
    re.MULTILINE | re.ASCII,
)
_ADDRESS: Final = re.compile(r"^[ \t]*addr ([0-9a-f:]{17})$", re.MULTILINE | re.ASCII)
_COUNTRY: Final = re.compile(r"^country ([A-Z0-9]{2}): ", re.MULTILINE | re.ASCII)
_NETWORK: Final = re.compile(
    r"^BSS ([0-9a-f:]{17}) ?\(on [^)\n]{1,20}\)(?: -- ([a-z ]{1,20}))?$", re.MULTILINE | re.ASCII
)
_FREQUENCY: Final = re.compile(r"^[ \t]*freq: ([0-9]{4,5})(?:\.[0-9])?$", re.MULTILINE | re.ASCII)
_SIGNAL: Final = re.compile(r"^[ \t]*signal: (-[0-9]{1,3}(?:\.[0-9]{1,2})?) dBm$", re.MULTILINE | re.ASCII)
_LAST_SEEN: Final = re.compile(r"^[ \t]*last seen: ([0-9]{1,9}) ms ago$", re.MULTILINE | re.ASCII)
_SURVEY: Final = re.compile(r"^Survey data from ", re.MULTILINE)
_TIME: Final = re.compile(
    r"^[ \t]*channel (active|busy|transmit) time:[ \t]*([0-9]{1,15}) ms$", re.MULTILINE | re.ASCII
)
_IN_USE: Final = "[in use]"
_SEPARATOR: Final = "=="
"""Line between the two outputs of the survey."""
_STALE_MS: Final = 5000
"""A network of this age or more in the list was received before this scan."""
_HALF_WIDTH_MHZ: Final = 10.0
"""Half of the width of the 20 MHz channel on which a network sends its beacons."""


@dataclass(frozen=True)
class WifiChannel:
    """Channel of a radio.

    Attributes:
        number: Channel number.
        frequency_mhz: Centre frequency of the primary channel of 20 MHz.
        width_mhz: Channel width.
        centre_mhz: Centre frequency of the whole channel.
    """

    number: int
    frequency_mhz: int
    width_mhz: int
    centre_mhz: int

    def __str__(self) -> str:
        return f"{self.number} ({self.frequency_mhz} MHz), width {self.width_mhz} MHz"

    def overlaps(self, frequency_mhz: float) -> bool:
        """Return True if the beacons of a network at this frequency overlap with the channel."""
        return abs(frequency_mhz - self.centre_mhz) < self.width_mhz / 2 + _HALF_WIDTH_MHZ


@dataclass(frozen=True)
class RadioState:
    """State of a radio and its channel at one time. Unknown attributes are None.

    Attributes:
        channel: Channel of the radio.
        country: Regulatory domain: two-letter country code, or `00` (world).
        signals_dbm: Received power of each other network on the channel; None for a power that is not reported.
        others_share: Share of the airtime in which the channel was busy, minus the radio's transmissions.
    """

    channel: WifiChannel | None = None
    country: str | None = None
    signals_dbm: tuple[float | None, ...] | None = None
    others_share: float | None = None

    @property
    def settings(self) -> Mapping[str, str]:
        """The known settings of the radio, by the names in `SETTINGS`."""
        values = (str(self.channel or ""), self.country or "")
        return {name: value for name, value in zip(SETTINGS, values, strict=True) if value}


def parse(snapshot: Snapshot) -> RadioState:
    """Return the state in a snapshot."""
    info, regulatory, scan, survey = (
        "" if (output := snapshot.get(name)) is None or output.failure else output.text
        for name in (INFO_NAME, REGULATORY_NAME, SCAN_NAME, SURVEY_NAME)
    )
    channel = _channel(info)
    own_address = _ADDRESS.search(info)
    has_scan = (output := snapshot.get(SCAN_NAME)) is not None and output.failure is None and channel is not None
    country = _COUNTRY.search(regulatory)
    return RadioState(
        channel,
        country[1] if country else None,
        _signals(scan, channel, own_address[1] if own_address else "") if has_scan and channel is not None else None,
        _others_share(survey),
    )


def _channel(info: str) -> WifiChannel | None:
    match = _CHANNEL.search(info)
    if match is None:
        return None
    frequency_mhz = int(match[2])
    return WifiChannel(int(match[1]), frequency_mhz, int(match[3]), int(match[4] or frequency_mhz))


def _signals(scan: str, channel: WifiChannel, own_address: str) -> tuple[float | None, ...]:
    """Return the received power of each other network that was received on a channel; None if it is not reported."""
    parts = _NETWORK.split(scan)
    signals: dict[str, float | None] = {}
    for address, state, body in zip(parts[1::3], parts[2::3], parts[3::3], strict=True):
        frequency, signal, last_seen = (pattern.search(body) for pattern in (_FREQUENCY, _SIGNAL, _LAST_SEEN))
        is_stale = last_seen is not None and int(last_seen[1]) >= _STALE_MS
        if state or address == own_address or is_stale or frequency is None:
            continue
        if channel.overlaps(float(frequency[1])):
            signals[address] = None if signal is None else float(signal[1])
    return tuple(signals.values())


def _others_share(survey: str) -> float | None:
    first, _, second = survey.partition(f"{_SEPARATOR}\n")
    before, after = _times_ms(first), _times_ms(second)
    if before is None or after is None:
        return None
    active, busy, transmit = (after[name] - before[name] for name in ("active", "busy", "transmit"))
    if active <= 0 or not 0 <= transmit <= busy:
        return None
    return min((busy - transmit) / active, 1.0)


def _times_ms(survey: str) -> Mapping[str, int] | None:
    """Return the times of the channel in use, or None if the active or busy time is missing."""
    for section in _SURVEY.split(survey)[1:]:
        if _IN_USE in section:
            times = {name: int(value) for name, value in _TIME.findall(section)}
            return {"transmit": 0, **times} if {"active", "busy"} <= times.keys() else None
    return None


def measure(role: Role, states: Sequence[RadioState]) -> Measured:
    """Return the columns of one robot's channel and of its other users.

    Each number is the largest value in the states.
    """
    channels = list(dict.fromkeys(str(state.channel) for state in states if state.channel))
    countries = list(dict.fromkeys(state.country for state in states if state.country))
    counts = [len(state.signals_dbm) for state in states if state.signals_dbm is not None]
    signals = [signal for state in states for signal in state.signals_dbm or () if signal is not None]
    shares = [state.others_share for state in states if state.others_share is not None]
    values: dict[str, Value | None] = {
        "channel": ", then ".join(channels) or None,
        "regulatory_domain": ", then ".join(countries) or None,
        "other_networks": max(counts, default=None),
        "other_networks_max_dbm": max(signals, default=None),
        "others_airtime_share": max(shares, default=None),
    }
    prefixed = {f"{role}_{name}": value for name, value in values.items()}
    return Measured.from_optional(prefixed, "the robot's radio does not report it, or received no network of others")


def setting_problem(states: Sequence[RadioState], at_start: Mapping[str, str]) -> str | None:
    """Return a sentence if a setting of a radio changed, or None.

    Args:
        states: The radio before and after an attempt.
        at_start: Settings of the radio at the start of the trial; a missing setting is not compared.
    """
    for name in SETTINGS:
        label = name.replace("_", " ")
        values = list(dict.fromkeys(state.settings[name] for state in states if name in state.settings))
        if len(values) > 1:
            return f"the {label} of its radio changed during the repeat, from {values[0]} to {values[1]}"
        if values and values[0] != at_start.get(name, values[0]):
            return f"the {label} of its radio is {values[0]}, but it was {at_start[name]} at the start of the trial"
    return None


def marks(names: Mapping[Role, str], states_by_role: Mapping[Role, Sequence[RadioState]]) -> Iterator[RepeatMark]:
    """Yield a mark for each robot if others use more than `BUSY_SHARE` of the airtime on its channel."""
    for role, states in states_by_role.items():
        share = max((state.others_share or 0.0 for state in states), default=0.0)
        if share > BUSY_SHARE:
            channel = next((f" on channel {state.channel.number}" for state in states if state.channel), "")
            yield RepeatMark(BUSY_CHANNEL, f"{names[role]}: others use {100 * share:.0f} % of the airtime{channel}")
